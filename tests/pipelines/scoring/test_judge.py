from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from command_line import refused
from PIL import Image

from gvtools.evaluation.images import FIGURES, psnr
from gvtools.runs.run import load_run
from pipelines.cli import main


def judge(*arguments: object) -> None:
    assert main(["judge", *map(str, arguments), "--quiet"]) == 0


def read(out) -> dict:
    return json.loads((out / "judge.json").read_text())


def truths(run) -> dict[str, np.ndarray]:
    """The true pictures of a run's targets by name."""
    targets = load_run(run).targets()
    return {files.name: truth.load().rgb for _, files, truth in targets if truth is not None}


def write_pictures(folder, pictures) -> None:
    for name, rgb in pictures.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rgb).save(path)


def noisy(run, seed: int, sigma: float = 8.0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        name: np.clip(rgb + rng.normal(0, sigma, rgb.shape), 0, 255).astype(np.uint8)
        for name, rgb in truths(run).items()
    }


@pytest.fixture(scope="module")
def judged(small_run, small_evaluation, tmp_path_factory):
    """The run itself, its pictures as a folder, and noisy truths, with evaluate's own figures."""
    root = tmp_path_factory.mktemp("judged")
    own = {f"generated_{f.name[:-4]}.png": f.picture for _, f, _ in load_run(small_run).targets()}
    write_pictures(root / "copied", own)
    write_pictures(root / "noisy", noisy(small_run, 0))
    judge(small_run, root / "copied", root / "noisy", "--against", small_run, "--out", root / "out")
    evaluation = json.loads((small_evaluation / "evaluation.json").read_text())
    return root / "out", read(root / "out"), evaluation["runs"][0]


def without_extras(images: dict) -> dict:
    """The images part with the figures of evaluate alone."""
    keep = {"name", "round", "coverage", "coverage_after", "observed", *FIGURES}
    return images | {
        "mean": {name: images["mean"][name] for name in FIGURES},
        "rounds": [{k: v for k, v in part.items() if k in keep} for part in images["rounds"]],
        "views": [{k: v for k, v in view.items() if k in keep} for view in images["views"]],
    }


def test_a_runs_own_pictures_have_the_figures_of_evaluate_to_the_bit(judged):
    _, figures, evaluation = judged
    own = figures["methods"][0]
    assert without_extras(own["images"]) == evaluation["images"]
    assert own["consistency"] == evaluation["consistency"]
    assert own["poses"] == evaluation["poses"]
    assert evaluation["images"]["mean"]["psnr"]["mean"] > 15


def test_the_same_pictures_from_a_plain_folder_differ_in_depth_alone(judged):
    _, figures, evaluation = judged
    copied = figures["methods"][1]
    assert copied["matched_by"] == "name"
    expected = evaluation["images"]["mean"]
    for name in FIGURES:
        if not name.startswith("depth"):
            assert copied["images"]["mean"][name] == expected[name]
    assert copied["images"]["mean"]["depth_rel_valid"]["mean"] is None
    assert copied["consistency"]["generated"]["depth_reprojection"]["status"].startswith("empty")
    assert copied["poses"] == evaluation["poses"]
    assert copied["consistency"]["generated"]["feature_consistency"]["score"]["n"] == 3
    assert copied["depth"] == "none; features are carried by the memory's"


def test_what_the_context_never_observed_is_one_region_for_all(judged, small_run):
    _, figures, _ = judged
    views = {view["name"]: view for view in figures["methods"][2]["images"]["views"]}
    pictures = noisy(small_run, 0)
    for _, files, truth in load_run(small_run).targets():
        assert truth is not None
        rgb = truth.load().rgb
        unseen, seen = (
            psnr(pictures[files.name], rgb, mask=mask) for mask in (~files.observed, files.observed)
        )
        assert views[files.name]["psnr_never_observed"] == pytest.approx(unseen)
        assert views[files.name]["psnr_valid"] == pytest.approx(seen)


def test_differences_are_paired_over_views(judged):
    _, figures, _ = judged
    found = {
        (entry["first"], entry["second"]): entry
        for entry in figures["differences"]
        if entry["figure"] == "psnr"
    }
    assert len(found) == 3
    entry = found["run", "noisy"]
    first, second = (
        [view["psnr"] for view in figures["methods"][i]["images"]["views"]] for i in (0, 2)
    )
    apart = np.subtract(first, second)
    assert entry["mean"] == pytest.approx(apart.mean())
    assert apart.min() <= entry["low"] <= entry["mean"] <= entry["high"] <= apart.max()
    assert entry["first_better"] == (apart > 0).mean()
    # Equal pictures: no difference in any resample.
    same = found["run", "copied"]
    assert (same["mean"], same["low"], same["high"]) == (0, 0, 0)


def test_tables_and_sheets_are_written(judged):
    out, figures, _ = judged
    page = (out / "judge.md").read_text()
    assert "| run | 4 of 4 | name |" in page
    assert "| true pictures | 4 of 4 |" in page
    assert "![Contact sheet 1](sheet_000.png)" in page
    rows = (out / "judge.csv").read_text().splitlines()
    psnrs = [row for row in rows if row.split(",")[1] == "psnr"]
    mean = figures["methods"][2]["images"]["mean"]["psnr"]["mean"]
    assert float(psnrs[2].split(",")[2]) == mean
    assert len((out / "views.csv").read_text().splitlines()) == 1 + 3 * 4
    with Image.open(out / "sheet_000.png") as sheet:
        # Four views of truth and three methods, 96 pixels wide, in two lines of 72.
        assert sheet.width >= 4 * 96
        assert sheet.height >= 4 * 2 * 72


def quickly(*arguments: object) -> dict:
    """Judge pictures alone; the last argument is the output folder."""
    judge(*arguments[:-1], "--parts", "images", "--sheet-views", 0, "--out", arguments[-1])
    return read(arguments[-1])


def test_missing_pictures_are_counted_and_the_others_compared(small_run, tmp_path, capsys):
    pictures = noisy(small_run, 1)
    names = list(pictures)
    write_pictures(tmp_path / "some", {name: pictures[name] for name in names[1:]})
    more = {f"more_{i}.png": pictures[names[0]] for i in range(2)}
    write_pictures(tmp_path / "some", more)
    found = quickly(tmp_path / "some", small_run, "--against", small_run, tmp_path / "out")
    some = found["methods"][0]
    assert (some["views"], some["missing"], some["left_over"]) == (3, names[:1], list(more))
    assert some["images"]["mean"]["psnr"]["n"] == 3
    assert {entry["n"] for entry in found["differences"] if entry["figure"] == "psnr"} == {3}
    assert "warning: some: no picture of 1 views" in capsys.readouterr().err
    page = (tmp_path / "out/judge.md").read_text()
    assert "no picture of 1 of 4 views, means are over the others and have no rank" in page


def test_smaller_pictures_are_resized_and_flagged(small_run, tmp_path, capsys):
    reduced = {
        name: np.asarray(Image.fromarray(rgb).resize((48, 36), Image.Resampling.BOX))
        for name, rgb in truths(small_run).items()
    }
    write_pictures(tmp_path / "half", reduced)
    found = quickly(tmp_path / "half", "--against", small_run, tmp_path / "out")
    method = found["methods"][0]
    assert method["resized"] == [{"from": [48, 36], "pictures": 4}]
    assert method["images"]["mean"]["psnr"]["mean"] > 25
    assert "4 pictures of 48x36 pixels resized" in capsys.readouterr().err


def test_pictures_named_as_the_views_before_them_are_warned_of(small_run, tmp_path, capsys):
    names, pictures = zip(*noisy(small_run, 1).items(), strict=True)
    write_pictures(tmp_path / "one off", dict(zip(names, pictures[-1:] + pictures, strict=False)))
    found = quickly(tmp_path / "one off", "--against", small_run, tmp_path / "out")
    said = f"4 of 4 pictures look like other views ({names[0]} stands for {names[0]} by its name"
    assert said in found["methods"][0]["reading"][0]
    assert f"warning: one off: {said}" in capsys.readouterr().err


def test_pictures_that_are_clear_or_to_be_read_otherwise_are_warned_of(small_run, tmp_path, capsys):
    clear = {}
    for name, rgb in noisy(small_run, 1).items():
        opaque = np.full((*rgb.shape[:2], 1), 255, np.uint8)
        opaque[:3] = 0
        clear[name] = np.concatenate([rgb[::-1], opaque], axis=-1)
    write_pictures(tmp_path / "clear", clear)
    found = quickly(tmp_path / "clear", "--against", small_run, tmp_path / "out")
    said = found["methods"][0]["reading"]
    assert "upside down" in said[0] and "4 of 4 pictures have transparent" in said[1]
    assert capsys.readouterr().err.count("warning: clear") == 2
    write_pictures(tmp_path / "turned", {k: np.rot90(v) for k, v in truths(small_run).items()})
    assert "orientation tag" in refused(
        capsys, "judge", tmp_path / "turned", "--against", small_run, "--out", tmp_path / "other"
    )


def gsplat_renders(folder, pictures, order) -> None:
    """The canvases of gsplat's trainer: truth and render of each view, by number."""
    for number, row in enumerate(order):
        rgb = list(pictures.values())[row]
        canvas = np.concatenate([rgb, 255 - rgb], axis=1)
        write_pictures(folder, {f"renders/val_step29999_{number:04d}.png": canvas})


def test_gsplats_renders_are_matched_by_order_and_checked_by_their_truths(
    small_run, tmp_path, capsys
):
    pictures = truths(small_run)
    gsplat_renders(tmp_path / "right", pictures, [0, 1, 2, 3])
    found = quickly(tmp_path / "right", "--against", small_run, tmp_path / "out")
    method = found["methods"][0]
    assert (method["layout"], method["matched_by"]) == ("gsplat", "order")
    view = method["images"]["views"][2]
    rgb = list(pictures.values())[2]
    assert view["psnr"] == pytest.approx(psnr(255 - rgb, rgb))
    gsplat_renders(tmp_path / "wrong", pictures, [1, 0, 2, 3])
    message = refused(
        capsys, "judge", tmp_path / "wrong", "--against", small_run, "--out", tmp_path / "out"
    )
    assert "but the truth beside it is frame-000005" in message


def test_a_project_is_judged_against_what_its_context_shows(small_run, small_scan, tmp_path):
    write_pictures(tmp_path / "pictures", noisy(small_run, 2))
    split = ("--context", "first:3", "--targets", "range:4-7")
    out = tmp_path / "out"
    found = quickly(tmp_path / "pictures", "--against", small_scan, *split, out)
    again = quickly(tmp_path / "pictures", "--against", small_scan, *split, out)
    assert again["methods"] == found["methods"]
    by_run = quickly(tmp_path / "pictures", "--against", small_run, tmp_path / "by_run")
    ours, theirs = (f["methods"][0]["images"]["views"] for f in (found, by_run))
    for one, other in zip(ours, theirs, strict=True):
        assert one["psnr"] == other["psnr"]
        assert one["observed"] == pytest.approx(other["observed"], abs=0.02)
    assert found["methods"][0]["images"]["mean"]["psnr_never_observed"]["n"] > 0


def test_pictures_from_cameras_of_ones_own_have_no_truth(small_run, small_scan, tmp_path):
    from tiny_scan import render, world_from_cam

    poses = [world_from_cam(i) for i in (0, 1, 2)]
    for pose in poses:
        pose[0, 3] += 0.1
    file = tmp_path / "path.txt"
    file.write_text("".join(" ".join(map(str, pose[:3].ravel())) + "\n" for pose in poses))
    shown = {f"{i}.png": render(pose)[0] for i, pose in enumerate(poses)}
    write_pictures(tmp_path / "own", shown)
    options = ("--cameras", file, "--sheet-views", 2)
    judge(tmp_path / "own", "--against", small_run, *options, "--out", tmp_path / "run")
    context = ("--context", "first:3")
    judge(tmp_path / "own", "--against", small_scan, *context, *options, "--out", tmp_path / "scan")
    for out in (tmp_path / "run", tmp_path / "scan"):
        found = read(out)
        method = found["methods"][0]
        assert found["with_truth"] == 0
        assert method["matched_by"] == "order"
        assert method["images"]["mean"]["psnr"]["mean"] is None
        assert method["images"]["views"][0]["observed"] > 0.9
        score = method["consistency"]["generated"]["feature_consistency"]
        assert score["score"]["mean"] < score["unrelated"]
        assert "true_pictures" not in method["consistency"]
        assert (out / "sheet_000.png").is_file()


def test_what_cannot_be_judged_is_refused(small_run, small_scan, tmp_path, capsys):
    out = ("--out", tmp_path / "out")
    twice = (small_run, small_run, "--against", small_run, *out)
    assert "called 'small0/run'" in refused(capsys, "judge", *twice).replace(
        small_run.parent.name, "small0"
    )
    assert "give one for each" in refused(capsys, "judge", *twice, "--name", "a")
    message = refused(capsys, "judge", small_run, "--against", small_scan, *out)
    assert "expected --context" in message
    message = refused(capsys, "judge", small_run, "--against", small_run, "--targets", "all", *out)
    assert "is a run, whose views are its own" in message
    pictures = truths(small_run)
    write_pictures(tmp_path / "some", pictures)
    inside = ("--against", small_run, "--out", tmp_path / "some/judged")
    assert "lies in the pictures" in refused(capsys, "judge", tmp_path / "some", *inside)
    assert not (tmp_path / "some/judged").exists()
    write_pictures(tmp_path / "cropped", {name: rgb[:, :80] for name, rgb in pictures.items()})
    message = refused(capsys, "judge", tmp_path / "cropped", "--against", small_run, *out)
    assert "80x72 pixels; expected 96x72" in message
    shutil.copytree(small_run, tmp_path / "begun")
    for folder in (tmp_path / "begun").glob("round_00[12]"):
        shutil.rmtree(folder)
    message = refused(capsys, "judge", small_run, "--against", tmp_path / "begun", *out)
    assert "no round of targets is done" in message
