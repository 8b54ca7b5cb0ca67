from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import refused
from tiny_scan import WIDTH, world_from_cam, write_scan

import gvtools
from gvtools.errors import OptionError, ProjectError
from gvtools.runs.run import load_run
from gvtools.scenes.project import open_recorded
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("unpainted")

ADDRESS = "spec:7-Scenes:wall/seq-01"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two recordings of one place, in the layout of 7-Scenes."""
    write_scan(tmp_path / "7scenes" / "wall" / "seq-01")
    write_scan(tmp_path / "7scenes" / "wall" / "seq-02", views=5)
    return tmp_path / "7scenes"


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
    for address, message in (
        ("spec:7-Scenes:wall/seq-1", "no scene 'wall/seq-1' there; did you mean 'wall/seq-01'"),
        ("spec:7-Scenes", "holds 2 scenes of 7-Scenes, first 'wall/seq-01'; say which"),
        ("spec:7-Scenes:", "say which, as spec:NAME:SCENE"),
    ):
        with pytest.raises(ProjectError, match=message):
            gvtools.open_project(address, root=root)
    for address, message in (
        ("spec:7-Scene:wall", "data set '7-Scene' is unknown; did you mean '7scenes'"),
        ("spec::wall/seq-01", "names no data set; expected spec:NAME:SCENE"),
    ):
        with pytest.raises(OptionError, match=message):
            gvtools.open_project(address, root=root)
    with pytest.raises(OptionError, match=r"where 7-Scenes lies is not said.*--root DIR"):
        gvtools.open_project(ADDRESS)
    with pytest.raises(OptionError, match="expected no images"):
        gvtools.open_project(ADDRESS, root=root, images=root)
    with pytest.raises(OptionError, match="expected no root"):
        gvtools.open_project(root / "wall" / "seq-01", root=root)
    with pytest.raises(ProjectError, match="no such folder"):
        gvtools.open_project(ADDRESS, root=root / "gone")


def test_commands_take_it(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "check.json"
    assert main(["check", ADDRESS, "--root", str(root), "--json", str(report)]) == 0
    assert json.loads(report.read_text())["views"] == 6
    figures = tmp_path / "ate.json"
    words = [ADDRESS, str(root / "wall" / "seq-01"), "--root", str(root), "--align", "none"]
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
