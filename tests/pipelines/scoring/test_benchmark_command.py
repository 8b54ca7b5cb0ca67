from __future__ import annotations

import csv
import json
import re
import shutil

import numpy as np
import pytest
from command_line import refused
from PIL import Image
from tiny_scan import write_scan

from gvtools.evaluation import published
from gvtools.evaluation.images import psnr
from gvtools.evaluation.published import load_benchmark
from gvtools.scenes.project import open_project
from pipelines.cli import main
from pipelines.scoring import benchmark

pytestmark = pytest.mark.usefixtures("unpainted")

VIEWS = 12
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
    write_scan(root / "one", views=VIEWS)
    write_scan(root / "two", views=VIEWS)
    (root / "notes").mkdir()
    return root


def words(root, out, *more: object) -> list[str]:
    return ["benchmark", "few-view", "--root", str(root), "--out", str(out), "--quiet",
            "--views", "3", *map(str, more)]  # fmt: skip


def rows_of(path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_pictures(root, folder, *, noise: int) -> None:
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
    write_pictures(projects, renders, noise=8)
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
