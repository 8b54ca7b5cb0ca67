from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skimage.data
from command_line import refused, run_command
from data_sets.miniature import miniatures
from PIL import Image
from scenes_workspace import HEIGHT as ROWS
from scenes_workspace import WIDTH as COLUMNS
from scenes_workspace import sevenscenes, workspace
from tiny_scan import FOCAL, WIDTH, render, world_from_cam, write_scan

import gvtools
from gvtools.errors import OptionError, ProjectError
from gvtools.runs.run import load_run
from gvtools.scenes.data_sets.catalogue import load_spec, spec_names
from gvtools.scenes.project import open_recorded
from gvtools.scenes.shards import open_shards
from pipelines.cli import main
from pipelines.data_sets import downloads
from pipelines.data_sets.downloads import LogHistogram


def check(*words: object) -> None:
    run_command("check", *words)


def test_a_good_project_is_ok_and_told_in_lines(tmp_path, capsys):
    sevenscenes(tmp_path)
    check(tmp_path)
    out = capsys.readouterr().out
    assert "ok: true" in out
    assert f"{COLUMNS}x{ROWS} (3 views)" in out
    assert "info: depth unit: 0.001 m" in out


def test_dropped_pictures_stand_beside_the_verdict(tmp_path, capsys):
    workspace(tmp_path)
    next((tmp_path / "images").rglob("*.png")).unlink()
    check(tmp_path)
    out = capsys.readouterr().out
    assert "3 (1 dropped)" in out and "ok: true (frames dropped: 1; warnings: 1)" in out


def test_json_holds_the_report(tmp_path):
    reconstruction = workspace(tmp_path / "project", "PINHOLE")
    check(tmp_path / "project", "--json", tmp_path / "report.json")
    data = report(tmp_path / "report.json")
    assert data["ok"] is True
    assert data["views"] == data["views_opened"] == reconstruction.num_reg_images()
    assert data["sparse_points"] == reconstruction.num_points3D()
    assert data["depth"] is None


def test_an_unreadable_picture_is_an_error_after_the_report(tmp_path, capsys):
    sevenscenes(tmp_path / "project")
    (tmp_path / "project" / "frame-000001.color.png").write_bytes(b"no picture")
    with pytest.raises(ProjectError, match=r"not ok: 1 errors, first: .*frame-000001"):
        check(tmp_path / "project")
    out = capsys.readouterr().out
    assert "ok: false" in out
    assert out.index("error: ") < out.index("info: ")
    with pytest.raises(ProjectError):
        check(tmp_path / "project", "--json", tmp_path / "report.json")
    data = report(tmp_path / "report.json")
    assert (data["ok"], data["views_opened"]) == (False, 2)
    # What cannot be opened is in the JSON, too.
    with pytest.raises(ProjectError, match="no such folder"):
        check(tmp_path / "absent", "--json", tmp_path / "report.json")
    data = report(tmp_path / "report.json")
    assert data["ok"] is False
    assert "no such folder" in data["findings"][0]["message"]


def test_poses_that_contradict_each_other_are_a_warning(tmp_path, capsys):
    sevenscenes(tmp_path, frames=4)
    pose = (tmp_path / "frame-000000.pose.txt").read_text()
    for i, name in enumerate(("astronaut", "astronaut", "coffee", "coffee")):
        picture = Image.fromarray(getattr(skimage.data, name)()).resize((COLUMNS, ROWS))
        picture.save(tmp_path / f"frame-{i:06d}.color.png")
        (tmp_path / f"frame-{i:06d}.pose.txt").write_text(pose)
    check(tmp_path)
    out = capsys.readouterr().out
    assert "warning: 4 pairs of views have nearly equal cameras but show different things" in out
    assert "ok: true" in out


FIRST, SECOND = "wall/seq-01", "wall/seq-02"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_scan(tmp_path / "7scenes" / FIRST)
    write_scan(tmp_path / "7scenes" / SECOND, views=12)
    return tmp_path / "7scenes"


def data(*arguments: object) -> int:
    return main(["data", *map(str, arguments)])


def report(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8")))


def test_the_list_has_a_row_for_each_data_set(capsys, tmp_path):
    assert data("list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + len(spec_names()) + 1
    assert "66,033" in next(line for line in lines if "RealEstate10K" in line)
    assert data("list", "--json", tmp_path / "sets.json") == 0
    found = report(tmp_path / "sets.json")["data_sets"]
    shares = {x["name"]: x["share"] for x in found if x["share"] is not None}
    assert len(shares) == 15
    assert sum(shares.values()) == pytest.approx(1)
    # Four times the images are twice the weight.
    images = {x["name"]: x["counts"]["images"] for x in found}
    ratio = images["RealEstate10K"] / images["Spring"]
    assert shares["RealEstate10K"] / shares["Spring"] == pytest.approx(np.sqrt(ratio))


def test_all_that_is_known_of_one_data_set_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    import yaml

    assert data("list", "Virtual KITTI") == 0
    text = capsys.readouterr().out
    spec = load_spec("virtualkitti")
    assert yaml.safe_load(text) == spec.model_dump(mode="json", exclude_none=True)
    assert "of a mixture of all training sets" in text
    assert "did you mean 'virtualkitti'" in refused(capsys, "data", "list", "virtual kity")


def test_each_scene_of_a_download_has_its_line(root, capsys, tmp_path):
    (root / SECOND / "frame-000003.depth.png").unlink()
    assert data("check", "7-Scenes", root, "--json", tmp_path / "check.json") == 0
    out = capsys.readouterr().out
    assert f"{FIRST}: 6 views of 96x72; 6 with depth; 1.8 to 3 m" in out
    assert f"{SECOND}: 12 views of 96x72; 11 with depth" in out
    # What both scenes have in common is said once.
    assert out.count("info: depth unit: 0.001 m") == 1
    assert "2 scenes, 18 views, 17 with depth (all of 7-Scenes: 7 scenes, 43,000 images)" in out
    scenes = report(tmp_path / "check.json")["scenes"]
    assert [scene["scene"] for scene in scenes] == [FIRST, SECOND]
    assert [scene["views"] for scene in scenes] == [6, 12]
    assert scenes[1]["views_opened"] == downloads.PROBES
    assert scenes[1]["depth"]["views"] == 11


def one_of_each_layout():
    """The others of a layout are slow: what reads them has tests of its own."""
    before = set()
    for miniature in miniatures():
        marks = [pytest.mark.slow] if miniature.layout in before else []
        before.add(miniature.layout)
        yield pytest.param(miniature, id=miniature.title, marks=marks)


@pytest.mark.parametrize("miniature", list(one_of_each_layout()))
def test_every_layout_can_be_checked_and_summed_up(miniature, tmp_path, capsys):
    name = next(x for x in spec_names() if load_spec(x).layout == miniature.layout)
    with miniature.within():
        expected = miniature.write(tmp_path / "root")
        assert data("check", name, tmp_path / "root") == 0
        out = capsys.readouterr().out
        assert f"{expected.scene}: {len(expected.cameras)} views of " in out
        assert data("stats", name, tmp_path / "root", "--json", tmp_path / "stats.json") == 0
    figures = report(tmp_path / "stats.json")
    assert figures["unit"] == ("m" if expected.metric else "scene units")
    steps = np.linalg.norm(np.diff(expected.cameras.centers, axis=0), axis=1)
    assert figures["baseline"]["max"] == pytest.approx(steps.max(), abs=1e-6)
    if expected.depth is None:
        assert figures["depth"] is None
    else:
        deepest = max(float(depth.max()) for depth in expected.depth)
        assert figures["depth"]["max"] == pytest.approx(
            deepest, abs=float(np.max(expected.depth_step)) + 1e-5
        )


def test_damaged_scenes_are_reported_after_the_others(root, capsys, tmp_path):
    (root / FIRST / "frame-000000.color.png").write_bytes(b"no picture")
    for path in (root / SECOND).glob("*.color.png"):
        path.unlink()
    write_scan(root / "wall" / "seq-03")
    line = refused(capsys, "data", "check", "7-Scenes", root, "--json", tmp_path / "check.json")
    assert f"2 of 3 scenes cannot be used, first {FIRST}: " in line
    scenes = report(tmp_path / "check.json")["scenes"]
    assert [scene["ok"] for scene in scenes] == [False, False, True]
    assert all(scene["problem"] for scene in scenes[:2])
    assert data("check", "7-Scenes", root, "--scene", "wall/seq-03") == 0
    # Figures are of what can be read.
    assert data("stats", "7-Scenes", root, "--json", tmp_path / "stats.json") == 0
    figures = report(tmp_path / "stats.json")
    assert (figures["scenes"], figures["skipped"]) == (2, 1)
    assert "1 of 3 scenes cannot be read, first wall/seq-02" in capsys.readouterr().err


@pytest.mark.parametrize("action", ["check", "stats"])
def test_bad_input_is_one_line(action, root, capsys, tmp_path):
    out = tmp_path / "out.json"
    cases = {
        ("7-Scene", root): "data set '7-Scene' is unknown; did you mean '7scenes'",
        ("7-Scenes", tmp_path / "nowhere"): "no such folder; expected SCENE/seq-NN/",
        ("7-Scenes", tmp_path): "no scene of 7-Scenes; expected SCENE/seq-NN/",
        ("7-Scenes", root, "--scene", "wall/seq-2"): "did you mean 'wall/seq-02'",
    }
    for arguments, message in cases.items():
        assert message in refused(capsys, "data", action, *arguments, "--json", out)
    assert not out.exists()
    shutil.rmtree(root / SECOND)
    for path in (root / FIRST).glob("*.color.png"):
        path.unlink()
    assert f"first {FIRST}: " in refused(capsys, "data", action, "7-Scenes", root)


def test_figures_are_those_of_the_files(root, capsys, tmp_path):
    assert data("stats", "7-Scenes", root, "--scene", FIRST, "--json", tmp_path / "s.json") == 0
    figures = report(tmp_path / "s.json")
    assert figures["unit"] == "m"
    assert figures["sizes"] == {"96x72": 6}
    assert figures["focal"]["p50"] == FOCAL
    assert figures["field_of_view"]["max"] == pytest.approx(
        np.degrees(2 * np.arctan(WIDTH / 2 / FOCAL))
    )
    assert figures["baseline"]["count"] == 5
    assert figures["baseline"]["p95"] == pytest.approx(0.2)
    assert figures["turn"]["max"] == pytest.approx(0, abs=1e-6)
    depth = np.concatenate([render(world_from_cam(i))[1].ravel() for i in range(6)])
    assert figures["depth"]["count"] == depth.size
    for name, percent in (("p5", 5), ("p50", 50), ("p95", 95)):
        assert figures["depth"][name] == pytest.approx(np.percentile(depth, percent), rel=6e-3)
    assert data("stats", "7-Scenes", root) == 0
    out = capsys.readouterr().out
    assert "2 scenes, 18 views, 18 with depth; depth of 14 sampled views" in out
    assert "baseline to the next view, m" in out


def test_percentiles_of_nothing_and_of_zeros():
    assert np.isnan(LogHistogram().percentile(50))
    zeros = LogHistogram()
    zeros.add([0.0, 0.0, 5.0])
    assert zeros.percentile(50) == 0
    assert zeros.percentile(90) == pytest.approx(5, rel=6e-3)


@pytest.fixture(scope="module")
def download(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("download")
    for name in ("chess/seq-01", "chess/seq-02", "fire/seq-01"):
        write_scan(root / name, views=4)
    return root


def test_a_data_set_is_converted_kept_and_verified(download, tmp_path, capsys):
    out = tmp_path / "shards"
    start = ("shards", "7-Scenes", "--root", download, "--out", out, "--size", 0.05)
    assert data(*start) == 0
    said = capsys.readouterr().out.splitlines()
    count = len(said) - 1
    assert said[-1].startswith(f"{out}: {count} shards of 3 scenes, 12 views, 12 with depth")
    assert data(*start) == 0
    again = capsys.readouterr().out.splitlines()
    assert [line.endswith("(complete before)") for line in again] == [True] * count + [False]
    assert data("verify", out) == 0
    assert "all as their checksums say" in capsys.readouterr().out
    assert open_shards(out).data_set == "7scenes"


def test_some_scenes_reduced(download, tmp_path):
    wanted = ("--scenes", "fire/seq-01", "chess/seq-02", "--max-side", 64, "--quiet")
    assert data("shards", "7-Scenes", "--root", download, "--out", tmp_path, *wanted) == 0
    opened = open_shards(tmp_path)
    assert opened.names == ("chess/seq-02", "fire/seq-01")
    assert opened.read("fire/seq-01").views[0].load().rgb.shape == (48, 64, 3)


def test_a_project_is_converted_and_what_is_damaged_warned_of(tmp_path, capsys):
    folder = write_scan(tmp_path / "kitchen", views=3)
    (folder / "frame-000001.color.png").write_bytes(b"\x89PNG")
    assert data("shards", folder, "--out", tmp_path / "shards") == 0
    found = capsys.readouterr()
    assert "1 scenes, 2 views" in found.out
    (line,) = found.err.splitlines()
    assert line.startswith("warning: left out: ") and "frame-000001.color.png" in line


def test_damaged_shards_are_lines_with_status_2(download, tmp_path, capsys):
    start = ("shards", "7-Scenes", "--root", download, "--out", tmp_path, "--size", 0.05, "--quiet")
    assert data(*start) == 0
    for name in ("shard-000000.tar", "shard-000001.tar"):
        content = np.fromfile(tmp_path / name, np.uint8)
        content[700] ^= 255
        content.tofile(tmp_path / name)
    assert data("verify", tmp_path) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and all("damaged" in line for line in lines)
    assert lines[-1].startswith("gvtools: 2 of ")
    assert data(*start) == 0 and data("verify", tmp_path) == 0


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("shards", "7-Scense", "--root", "ROOT", "--out", "OUT"), "did you mean '7scenes'?"),
        (("shards", "spec:7-Scenes", "--out", "OUT"), "lies is not said; give the folder"),
        (("shards", "ROOT/fire/seq-01", "--out", "OUT", "--max-side", "20"), "at least 64"),
        (("shards", "ROOT/fire/seq-01", "--out", "OUT", "--size", "0"), "more than 0"),
        (("verify", "ROOT"), "no index.json; expected complete shards"),
    ],
)
def test_shards_that_cannot_be_are_one_line(arguments, complaint, download, tmp_path, capsys):
    places = {"ROOT": str(download), "OUT": str(tmp_path / "out")}
    words = [
        next((word.replace(k, v) for k, v in places.items() if k in word), word)
        for word in arguments
    ]
    assert complaint in refused(capsys, "data", *words)


ADDRESS = "spec:7-Scenes:wall/seq-01"


def test_a_scene_of_a_data_set_is_a_project(root: Path) -> None:
    scene = gvtools.open_project(ADDRESS, root=root)
    assert len(scene) == 6
    assert scene.root == root / "wall" / "seq-01"
    assert scene.address == "spec:7scenes:wall/seq-01"
    assert scene.subset(scene.names[:2]).origin == scene.origin
    np.testing.assert_allclose(scene.cameras.world_from_cam[1], world_from_cam(1), atol=1e-9)
    other = gvtools.open_project("spec:7SCENES:wall/seq-01", root=root)
    assert other.address == scene.address
    # A plain folder is opened by itself.
    assert gvtools.open_project(scene.root).address == str(scene.root.resolve())


def test_what_is_not_said_or_not_there(root: Path) -> None:
    here: dict[str, Any] = {"root": root}
    for error, address, places, message in (
        (ProjectError, "spec:7-Scenes:wall/seq-1", here, "there; did you mean 'wall/seq-01'"),
        (ProjectError, "spec:7-Scenes", here, "2 scenes of 7-Scenes, first 'wall/seq-01'; say"),
        (ProjectError, "spec:7-Scenes:", here, "say which, as spec:NAME:SCENE"),
        (ProjectError, ADDRESS, {"root": root / "gone"}, "no such folder"),
        (OptionError, "spec:7-Scene:wall", here, "'7-Scene' is unknown; did you mean '7scenes'"),
        (OptionError, "spec::wall/seq-01", here, "names no data set; expected spec:NAME:SCENE"),
        (OptionError, ADDRESS, {}, r"where 7-Scenes lies is not said.*--root DIR"),
        (OptionError, ADDRESS, {**here, "images": root}, "expected no images"),
        (OptionError, root / FIRST, here, "expected no root"),
    ):
        with pytest.raises(error, match=message):
            gvtools.open_project(address, **places)


def test_commands_take_it(root: Path, tmp_path: Path, capsys) -> None:
    checked, figures = tmp_path / "check.json", tmp_path / "ate.json"
    assert main(["check", ADDRESS, "--root", str(root), "--json", str(checked)]) == 0
    assert report(checked)["views"] == 6
    words = [ADDRESS, str(root / FIRST), "--root", str(root), "--align", "none"]
    assert main(["trajectory", "ate", *words, "--json", str(figures)]) == 0
    assert json.loads(figures.read_text())["associated"] == 6
    capsys.readouterr()
    assert "is not said" in refused(capsys, "check", ADDRESS)
    plain = root / "wall" / "seq-01"
    assert "expected no root" in refused(capsys, "check", plain, "--root", root)
    line = refused(capsys, "trajectory", "ate", plain, plain, "--root", root)
    assert "belongs to spec:NAME:SCENE" in line
    line = refused(capsys, "train", "tune", "--scene", ADDRESS, "--out", tmp_path / "tuned")
    assert "is not said" in line
    line = refused(capsys, "train", "tiny", "--root", root, "--out", tmp_path / "trained")
    assert "--root: belongs to 'gvtools train tune'" in line


@pytest.mark.slow
def test_a_run_is_resumed_and_evaluated(root, tmp_path, monkeypatch, capsys):
    out = tmp_path / "run"
    options = ["--context", "every:2", "--targets", "every:2+1", "--views-per-round", "2"]
    options += ["--voxel", "0.05", "--refine", "0", "--out", str(out), "--quiet"]
    assert main(["reconstruct", ADDRESS, "--root", str(root), *options]) == 0
    record = json.loads((out / "run.json").read_text())
    assert record["project"] == "spec:7scenes:wall/seq-01"
    assert record["reading"] == {"root": str(root.resolve())}
    # The last round again, the project named in other words and from another folder.
    whole = (out / "round_002" / "report.json").read_text()
    shutil.rmtree(out / "round_002")
    monkeypatch.chdir(tmp_path)
    again = ["reconstruct", "spec:7scenes:wall/seq-01", "--root", "7scenes", *options]
    assert main([*again, "--resume"]) == 0
    resumed = (out / "round_002" / "report.json").read_text()
    assert json.loads(resumed)["points"] == json.loads(whole)["points"]
    # Another scene is another run.
    again[1] = "spec:7scenes:wall/seq-02"
    assert "belongs to another run (project" in refused(capsys, *again, "--resume")
    measure = ["evaluate", str(out), "--parts", "images", "--quiet", "--json"]
    assert main([*measure, str(tmp_path / "before.json")]) == 0
    # The download moves: its new folder is said as that of any project.
    moved = root.rename(tmp_path / "elsewhere")
    assert "gone" in refused(capsys, "refine", out, "--steps", 1)
    words = ["--project", str(moved)]
    assert main([*measure, str(tmp_path / "after.json"), *words]) == 0
    before, after = (json.loads((tmp_path / f"{x}.json").read_text()) for x in ("before", "after"))
    assert before["runs"][0]["images"] == after["runs"][0]["images"]
    assert before["runs"][0]["images"]["mean"]["psnr"]["mean"] > 15
    assert load_run(out, project=moved).scenes[0].root == moved / "wall" / "seq-01"


def test_targets_of_another_scene_of_the_download(root: Path, tmp_path: Path) -> None:
    run = gvtools.reconstruct(
        ADDRESS,
        tmp_path / "run",
        root=root,
        context="first:3",
        targets="spec:7-Scenes:wall/seq-02@frame-000003.color.png,frame-000004.color.png",
        completer="none",
        settings={"voxel": 0.05, "refine.seconds": 0.0},
    )
    assert run.record["targets_project"] == "spec:7scenes:wall/seq-02"
    scene, truths = run.scenes
    assert truths is not None and truths.root == root / "wall" / "seq-02"
    assert [truth is not None for _, _, truth in run.targets()] == [True, True]
    with pytest.raises(OptionError, match="none of a data set"):
        gvtools.reconstruct(
            scene.root, tmp_path / "other", targets="spec:7-Scenes:wall/seq-02", completer="none"
        )


def test_a_recorded_project_says_where_it_lies_now(root: Path) -> None:
    reading = {"root": "/nowhere"}
    scene = open_recorded(ADDRESS, reading, moved=root)
    assert int(scene.cameras.width[0]) == WIDTH
    # A plain folder takes the place of the data set's scene as well as of another folder.
    with pytest.raises(OptionError):
        open_recorded(str(scene.root), reading)
