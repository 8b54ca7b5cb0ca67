from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import is_running, refused
from PIL import Image
from tiny_scan import write_colmap_scan, write_scan

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.evaluation import published
from gvtools.evaluation.images import psnr, ssim
from gvtools.evaluation.published import load_benchmark
from gvtools.runs.run import Run
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.project import open_project
from pipelines.cli import main
from pipelines.scoring import benchmark
from pipelines.scoring.benchmark import BenchmarkCell, measure_apart, parse_methods, read_cell
from pipelines.scoring.benchmark_scenes import (
    at_benchmark_size,
    masked_figures,
    object_mask,
    open_benchmark_scene,
    picture_size,
    pictures_folder,
    reading_of,
    scene_names,
    split_of_scene,
)


def cell(root, out, **changes) -> BenchmarkCell:
    values = {"benchmark": "few-view", "root": root, "scene": "scan", "views": 3, "seconds": None,
              "method": parse_methods("fast")[0], "lpips": None, "out": out}  # fmt: skip
    return BenchmarkCell(**{**values, **changes})


def test_pictures_have_the_benchmarks_size_and_points_of_the_context_alone(tmp_path):
    scene = open_project(write_colmap_scan(tmp_path / "scan", views=12))
    few = load_benchmark("few-view").at(3)
    split = split_of_scene(few, scene)
    found = at_benchmark_size(scene, split, size=picture_size(few, scene))
    assert found[scene.names[0]].load().rgb.shape == (72, 96, 3)
    # Each point of this project is seen by one view alone.
    assert found.points is not None and len(found.points.positions) == 0
    assert picture_size(load_benchmark("llff").at(3), scene) == (504, 378)
    eighth = load_benchmark("mipnerf360-few").at(12)
    assert picture_size(eighth, scene) == (12, 9)
    assert picture_size(load_benchmark("mipnerf360-few").at(3), scene) is None
    found = at_benchmark_size(scene, split, size=(48, 48))
    assert found[scene.names[0]].load().rgb.shape == (48, 48, 3)


def test_methods_are_settings_of_runs(tmp_path):
    """The time of a fit is that of methods that fit."""
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"splat": {"nearest_views": 2}, "completer": "none"}))
    methods = parse_methods(f"default, fast, none, paper, mine={file}, paper-without-memory")
    found = {method.name: method.config(seconds=7) for method in methods}
    ablation = found.pop("paper-without-memory").completer_options
    assert ablation == found["paper"].completer_options | {"memory": False}
    seconds = {name: config.refine.seconds for name, config in found.items()}
    assert seconds == {"default": 7, "fast": None, "none": 7, "paper": None, "mine": 7}
    assert found["none"].completer == found["mine"].completer == "none"
    assert found["mine"].splat.nearest_views == 2
    assert (found["paper"].protocol, found["paper"].completer) == ("paper", "geoverse")
    assert methods[0].config(seconds=None).refine.seconds is None
    assert parse_methods(f"theirs={tmp_path}")[0].pictures == tmp_path.resolve()


def test_masked_figures_are_of_the_object_on_white(tmp_path):
    scene = open_project(write_scan(tmp_path / "scan", views=1))
    (name,) = scene.names
    truth = scene[name].load().rgb
    rng = np.random.default_rng(0)
    picture = np.clip(truth + rng.integers(-9, 9, truth.shape), 0, 255).astype(np.uint8)
    mask = np.zeros(truth.shape[:2], bool)
    mask[20:50, 30:70] = True
    found = masked_figures({name: picture}, scene, {name: mask}, lpips=None)
    error = (picture[mask].astype(float) - truth[mask]) / 255
    assert found["psnr_masked"] == pytest.approx(-10 * np.log10((error**2).mean()))
    ours, true = picture.copy(), truth.copy()
    ours[~mask] = true[~mask] = 255
    assert found["ssim_masked"] == pytest.approx(ssim(ours, true))
    whole = psnr(ours, true)
    assert whole is not None and found["psnr_masked"] is not None and found["psnr_masked"] < whole
    assert masked_figures({name: picture}, scene, {name: None}, lpips=None) == {}


def test_object_masks_are_white_and_lie_where_the_benchmark_says(tmp_path):
    dtu = load_benchmark("dtu")
    levels = np.zeros((60, 80, 3), np.uint8)
    levels[:, 40:] = 255
    levels[:, 38:40] = 250
    for place, index in (("scan8", 3), ("scan40/mask", 4)):
        folder = tmp_path / "idrmasks" / place
        folder.mkdir(parents=True)
        Image.fromarray(levels).save(folder / f"{index:03d}.png")
    for scene, index in (("scan8", 3), ("scan40", 4)):
        mask = object_mask(dtu, tmp_path, scene=scene, index=index, shape=(30, 40))
        assert mask is not None and mask.shape == (30, 40)
        assert mask[:, 20:].all() and not mask[:, :20].any()
    assert object_mask(dtu, tmp_path, scene="scan8", index=4, shape=(30, 40)) is None


def test_pictures_are_sought_by_scene_and_number_of_views(tmp_path):
    (tmp_path / "scan" / "3_views").mkdir(parents=True)
    found = [
        pictures_folder(tmp_path, scene, views=views).relative_to(tmp_path).as_posix()
        for scene, views in (("scan", 3), ("scan", 6), ("other", 3))
    ]
    assert found == ["scan/3_views", "scan", "."]


def test_a_cell_in_a_process_of_its_own_leaves_its_reason(tmp_path):
    """The scene is not there, so that nothing heavy is loaded."""
    one = cell(tmp_path, tmp_path / "out")
    measure_apart(one)
    found = read_cell(one)
    assert found is not None and found["status"] == "failed" and "no such folder" in found["reason"]


@pytest.mark.slow
def test_a_killed_benchmark_goes_on_with_the_same_command(projects, tmp_path):
    """Killed in its second cell; that one's process ends, too, and the first is kept."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "pipelines.cli", *words(projects, out, "--methods", "fast")]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    first = out / "cells/one/3_views/fast.json"
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    started: list[int] = []
    while process.poll() is None and not (first.is_file() and started):
        time.sleep(0.05)
        if first.is_file():
            started = [int(word) for word in children.read_text().split()]
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    before = first.read_bytes()
    assert not (out / "results.json").is_file() or started
    end = time.monotonic() + 20
    while any(is_running(pid) for pid in started) and time.monotonic() < end:
        time.sleep(0.1)
    assert not any(is_running(pid) for pid in started)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert first.read_bytes() == before
    results = json.loads((out / "results.json").read_text())["3_views"]["fast"]
    assert list(results["scenes"]) == ["one", "two"] and not results["failures"]


# Scenes of data sets.

VIEWS, FULL = 16, (160, 120)


def write_copies(scene: Path, *copies: int) -> None:
    """The scene's pictures, and those whose sides are divided."""
    for divided_by in copies:
        folder = scene / ("images" if divided_by == 1 else f"images_{divided_by}")
        folder.mkdir(parents=True)
        for i in range(VIEWS):
            size = FULL[0] // divided_by, FULL[1] // divided_by
            Image.new("RGB", size, (i, divided_by, 0)).save(folder / f"view_{i:02d}.png")


def cameras() -> Cameras:
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    poses[:, 0, 3] = -0.1 * np.arange(VIEWS)
    K = np.array([[150.0, 0, FULL[0] / 2], [0, 150, FULL[1] / 2], [0, 0, 1]])
    names = tuple(f"view_{i:02d}.png" for i in range(VIEWS))
    width, height = (np.full(VIEWS, side) for side in FULL)
    return Cameras(np.tile(K, (VIEWS, 1, 1)), poses, width, height, names)


def write_mipnerf360(root: Path, *copies: int) -> Path:
    write_copies(root / "garden", *copies)
    write_colmap(root / "garden/sparse/0", cameras())
    return root


def write_llff(root: Path, *copies: int) -> Path:
    write_copies(root / "fern", *copies)
    rows = []
    for pose in cameras().world_from_cam:
        right, down, forward = pose[:3, :3].T
        axes = np.stack([down, right, -forward, pose[:3, 3], [FULL[1], FULL[0], 150.0]])
        rows.append(np.concatenate([axes.T.ravel(), [0.5, 9.0]]))
    np.save(root / "fern/poses_bounds.npy", np.array(rows))
    return root


def size_of(camera: Cameras) -> tuple[int, int]:
    return int(camera.width[0]), int(camera.height[0])


@pytest.mark.parametrize(("copies", "read"), [((1, 8), 8), ((1, 2, 8), 8), ((8,), 8), ((1, 2), 1)])
def test_the_data_sets_own_reduced_pictures_are_read_where_they_are_there(tmp_path, copies, read):
    benchmark = load_benchmark("mipnerf360-few").at(12)
    scene = open_benchmark_scene(benchmark, "garden", write_mipnerf360(tmp_path, *copies))
    assert scene.views[3].load().rgb[0, 0].tolist() == [3, read, 0]
    split = split_of_scene(benchmark, scene)
    # 14 of 16 views are no targets, of which 12 at equal steps.
    assert [int(name[5:7]) for name in split.targets] == [0, 8]
    assert len(split.context) == 12
    size = picture_size(benchmark, scene)
    assert size == (None if read == 8 else (20, 15))
    assert size_of(at_benchmark_size(scene, split, size=size).views[0].camera) == (20, 15)


def test_copies_that_do_not_tell_the_recorded_size_are_refused(tmp_path):
    benchmark = load_benchmark("mipnerf360-few").at(12)
    with pytest.raises(ProjectError, match="neither images_8 nor images"):
        open_benchmark_scene(benchmark, "garden", write_mipnerf360(tmp_path, 2))


@pytest.mark.parametrize(("copies", "read"), [((1, 8), 8), ((1,), 1), ((4,), 4)])
def test_llff_has_one_size_and_its_runs_are_opened_again_with_it(tmp_path, copies, read):
    benchmark = load_benchmark("llff").at(3)
    root = write_llff(tmp_path, *copies)
    scene = open_benchmark_scene(benchmark, "fern", root)
    assert scene.views[3].load().rgb[0, 0].tolist() == [3, read, 0]
    split = split_of_scene(benchmark, scene)
    assert [int(name[5:7]) for name in split.context] == [1, 7, 15]
    size = picture_size(benchmark, scene)
    found = at_benchmark_size(scene, split, size=size)
    assert {size_of(view.camera) for view in found} == {(504, 378)}
    assert found.views[5].load().rgb.shape == (378, 504, 3)
    assert scene.origin is not None
    record: dict[str, Any] = {
        "project": scene.address,
        "reading": reading_of(scene, size),
        "settings": {}, "derived": {}, "targets": [], "targets_kind": "hold-out",
        "targets_project": None,
    }  # fmt: skip
    again, truths = Run(tmp_path, record, ()).scenes
    assert truths is again
    np.testing.assert_allclose(again.cameras.K, found.cameras.K)
    np.testing.assert_array_equal(again.views[5].load().rgb, found.views[5].load().rgb)


def test_scenes_that_a_benchmark_lists_are_its_scenes_also_where_they_are_absent(tmp_path):
    assert len(scene_names(load_benchmark("llff"), tmp_path)) == 8
    with pytest.raises(ProjectError, match="no such folder"):
        scene_names(load_benchmark("llff"), tmp_path / "gone")
    assert scene_names(load_benchmark("mipnerf360"), write_mipnerf360(tmp_path, 1)) == ("garden",)


# Of 12 views, 0 and 8 are targets; of the 10 others, places 0, 4.5 (to even) and 9.
CONTEXT = [f"frame-{i:06d}" for i in (1, 5, 11)]


@pytest.fixture
def in_process(monkeypatch):
    """Cells are measured here: a process each takes seconds to begin."""
    measured = []

    def measure(cell):
        measured.append((cell.scene, cell.views, cell.method.name))
        benchmark.measure_and_write(cell)

    monkeypatch.setattr(benchmark, "measure_apart", measure)
    return measured


@pytest.fixture(scope="module")
def projects(tmp_path_factory):
    root = tmp_path_factory.mktemp("projects")
    for name in ("one", "two"):
        write_scan(root / name, views=12)
    (root / "notes").mkdir()
    return root


def words(root, out, *more: object) -> list[str]:
    return ["benchmark", "few-view", "--root", str(root), "--out", str(out), "--quiet",
            "--views", "3", *map(str, more)]  # fmt: skip


def rows_of(path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_noisy_targets(root, folder, *, noise: int) -> None:
    """The photographs of the targets, with noise of some levels, as another method's pictures."""
    rng = np.random.default_rng(0)
    for project in ("one", "two"):
        scene = open_project(root / project)
        (folder / project).mkdir(parents=True)
        for name in (scene.names[0], scene.names[8]):
            rgb = scene[name].load().rgb.astype(int)
            made = np.clip(rgb + rng.integers(-noise, noise + 1, rgb.shape), 0, 255)
            stem = name.removesuffix(".png")
            Image.fromarray(made.astype(np.uint8)).save(folder / project / f"{stem}.png")


@pytest.mark.slow
def test_a_benchmark_runs_goes_on_and_writes_its_tables(projects, tmp_path, in_process, capsys):
    out, renders = tmp_path / "out", tmp_path / "renders"
    write_noisy_targets(projects, renders, noise=8)
    assert main(words(projects, out, "--methods", f"fast,noisy={renders}")) == 0
    assert in_process == [("one", 3, "fast"), ("one", 3, "noisy"),
                          ("two", 3, "fast"), ("two", 3, "noisy")]  # fmt: skip
    results = json.loads((out / "results.json").read_text())["3_views"]
    cell = json.loads((out / "cells/one/3_views/fast.json").read_text())
    assert [name.removesuffix(".color.png") for name in cell["split"]["context"]] == CONTEXT
    assert cell["resolution"] == [96, 72] and len(cell["views"]) == 2
    # The mean over scenes of the means over views, and its interval, which two scenes bound.
    of_scenes = [results["fast"]["scenes"][name]["psnr"] for name in ("one", "two")]
    interval = results["fast"]["intervals"]["psnr"]
    assert results["fast"]["mean"]["psnr"] == pytest.approx(np.mean(of_scenes))
    assert min(of_scenes) <= interval["low"] <= interval["high"] <= max(of_scenes)
    assert results["fast"]["seconds"] > 0 and results["fast"]["peak_bytes"] > 2**20
    # Another method's pictures are compared with the same photographs.
    scene = open_project(projects / "one")
    expected: list[float] = []
    for name in (scene.names[0], scene.names[8]):
        made = np.array(Image.open(renders / "one" / name))
        expected.append(psnr(made, scene[name].load().rgb) or 0.0)
    assert results["noisy"]["scenes"]["one"]["psnr"] == pytest.approx(np.mean(expected))
    # What the context observed is known by a memory of its own.
    assert results["noisy"]["mean"]["psnr_observed"] == pytest.approx(
        results["noisy"]["mean"]["psnr"], abs=1.0
    )
    assert results["noisy"]["seconds"] is None
    (fast, noisy) = rows_of(out / "3_views.csv")
    assert (fast["System"], noisy["System"]) == ("fast", "noisy")
    assert float(fast["PSNR (dB)"]) == pytest.approx(results["fast"]["mean"]["psnr"])
    assert len(rows_of(out / "scenes.csv")) == 4
    assert "PSNR" in (out / "3_views.md").read_text()
    assert r"\begin{tabular}" in (out / "3_views.tex").read_text()
    page = (out / "index.html").read_text()
    addresses = re.findall(r'(?:src|href)="([^"]*)"', page)
    # Of two scenes: given view, photograph, and picture and error of two methods.
    assert sum(address.startswith("data:image/jpeg") for address in addresses) == 2 * 6
    assert all(address.startswith(("data:", "#")) for address in addresses)
    assert page.count("<td") > 20

    # The same command again: runs are kept, pictures are looked at again.
    in_process.clear()
    before = (out / "cells/one/3_views/fast.json").read_bytes()
    assert main(words(projects, out, "--methods", f"fast,noisy={renders}")) == 0
    assert in_process == [("one", 3, "noisy"), ("two", 3, "noisy")]
    assert (out / "cells/one/3_views/fast.json").read_bytes() == before
    # A cell that is not there is measured; other settings are refused in one line.
    (out / "cells/two/3_views/fast.json").unlink()
    in_process.clear()
    assert main(words(projects, out, "--methods", "fast")) == 0
    assert in_process == [("two", 3, "fast")]
    line = refused(capsys, *words(projects, out, "--methods", "fast", "--seconds", 3))
    assert "measured with seconds None, now 3.0" in line and "--out" in line


def test_a_scene_that_fails_is_kept_with_its_reason_and_the_rest_goes_on(
    projects, tmp_path, in_process, capsys
):
    root, out = tmp_path / "projects", tmp_path / "out"
    shutil.copytree(projects / "one", root / "one")
    write_scan(root / "short", views=3)
    assert main(words(root, out, "--methods", "fast")) == 0
    assert in_process == [("one", 3, "fast"), ("short", 3, "fast")]
    assert "failed: 3 views" in capsys.readouterr().err
    results = json.loads((out / "results.json").read_text())["3_views"]["fast"]
    assert list(results["scenes"]) == ["one"]
    assert "expected at least 3" in results["failures"]["short"]
    assert results["setting"]["failed"] == 1
    (_, failed) = rows_of(out / "scenes.csv")
    assert failed["note"].startswith("failed: 3 views")
    # Without any figure it is no success, and what failed is tried again.
    shutil.rmtree(root / "one")
    message = refused(capsys, *words(root, tmp_path / "none", "--methods", "fast"))
    assert "none of 1 measurements succeeded, first 3 views" in message
    shutil.copytree(projects / "one", root / "one")
    in_process.clear()
    assert main(words(root, out, "--methods", "fast")) == 0
    assert in_process == [("short", 3, "fast")]


@pytest.mark.slow
def test_the_papers_protocol_runs_in_rounds_and_measures_poses(tmp_path, in_process, monkeypatch):
    """Three rounds of six targets on a recording that stands for a scene of ScanNet."""
    root, out = tmp_path / "scans", tmp_path / "out"
    write_scan(root / "scene0000_00", views=20)
    spec = load_benchmark("scannetv2")
    small = spec.model_copy(
        update={
            "resolution": (64, 64),
            "splits": (spec.splits[0].model_copy(update={"stride": 1}),),
            "data_set": spec.data_set.model_copy(update={"spec": ""}),
        }
    )
    monkeypatch.setattr(benchmark, "load_benchmark", lambda name: small)
    monkeypatch.setattr(published, "load_benchmark", lambda name: small)
    command = ["benchmark", "scannetv2", "--root", str(root), "--out", str(out), "--quiet"]
    assert main([*command, "--methods", "fast"]) == 0
    cell = json.loads((out / "cells/scene0000_00/2_views/fast.json").read_text())
    assert [len(names) for names in cell["split"]["rounds"]] == [6, 6, 6]
    assert cell["resolution"] == [64, 64]
    figures = cell["figures"]
    assert figures["psnr"] > 10 and figures["time"] > 0
    assert figures["reproj"] is None
    assert "located, share" in figures and "depth reprojection, pixels" in figures
    assert (figures["met3r"] is None) == (cell["met3r"] != "measured")
    row = rows_of(out / "2_views.csv")[-1]
    assert row["System"] == "fast" and row["Origin"] == "measured here" and not row["PSNR rank"]
    table = (out / "2_views.md").read_text()
    assert "fast, no rank in PSNR" in table and "resolution: 64x64" not in table
    intervals = {row["figure"] for row in rows_of(out / "intervals.csv")}
    assert {"psnr", "coverage", "located, share"} <= intervals


def test_wrong_options_are_refused(projects, tmp_path, capsys):
    out = tmp_path / "out"
    assert "did you mean 'few-view'" in refused(
        capsys, "benchmark", "few-vew", "--root", projects, "--out", out
    )
    assert "did you mean 'fast'" in refused(capsys, *words(projects, out, "--methods", "fats"))
    assert "each name once" in refused(capsys, *words(projects, out, "--methods", "fast,fast"))
    assert "expected a folder" in refused(capsys, *words(projects, out, "--methods", "a=gone"))
    dots = words(projects, out, "--methods", f"..={projects}")
    assert "the first a letter or a digit" in refused(capsys, *dots)
    assert "did you mean 'one'" in refused(capsys, *words(projects, out, "--scenes", "ones"))
    assert "--seconds 0" in refused(capsys, *words(projects, out, "--seconds", 0))
    assert "no project" in refused(capsys, *words(projects / "notes", out))
    assert "no such folder" in refused(capsys, *words(tmp_path / "gone", out))
    assert "expected one of 3, 6, 9" in refused(capsys, *words(projects, out, "--views", 4))
    assert not out.exists()
    out.mkdir()
    (out / "results.json").write_text('{"benchmark": "llff"}')
    assert "holds the results of 'llff'" in refused(capsys, *words(projects, out))
    assert [path.name for path in out.iterdir()] == ["results.json"]
