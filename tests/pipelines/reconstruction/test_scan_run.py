from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scan_files import FAR, write_las
from tiny_scan import FOCAL, HEIGHT, WIDTH, render, world_from_cam, write_scan

from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.runs.run import load_run
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("unpainted")

SCALE = 2.0


def far_scan(path: Path, *, colored: bool = False) -> Path:
    """What a scanner at the last view's place sees, twice as large and far away; red is blue."""
    positions, colors = [], []
    for index in (4, 5):
        pose = world_from_cam(index)
        rgb, depth = render(pose)
        colors.append(rgb.reshape(-1, 3)[:, ::-1])
        row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        rays = [(column - WIDTH / 2) / FOCAL, (row - HEIGHT / 2) / FOCAL, np.ones_like(row)]
        positions.append((np.stack(rays, -1) * depth[..., None]).reshape(-1, 3) + pose[:3, 3])
    count = sum(map(len, positions))
    return write_las(
        path,
        SCALE * np.concatenate(positions) + FAR,
        np.concatenate(colors) if colored else None,
        intensity=np.arange(count) % 999,
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """A folder with a project, a scan, and runs with and without it."""
    root = tmp_path_factory.mktemp("scanned")
    project, scan = write_scan(root / "project"), far_scan(root / "scan.laz")
    write_las(root / "few.las", np.eye(20, 3), None)
    matrix = np.diag([1 / SCALE] * 3 + [1.0])
    matrix[:3, 3] = -FAR / SCALE
    np.savetxt(root / "placement.txt", matrix, fmt="%.17g")
    options = ["--context", "first:1", "--targets", "range:4-5", "--refine", "0", "--quiet",
               "--set", "refine.poses=false"]  # fmt: skip
    given = ["--cloud", str(scan), "--cloud-placement", str(root / "placement.txt")]
    for name, more in (("with", given), ("without", [])):
        out = ["--out", str(root / name)]
        assert main(["reconstruct", str(project), *options, *out, *more]) == 0
    return root


def test_a_run_begins_with_the_scan_and_counts_it_apart(runs):
    run = load_run(runs / "with")
    first = run.rounds[0]
    memory = SpatialMemory.load(runs / "with" / "memory.npz")
    kept = memory.scanned & (memory.columns.round == 0)
    assert first["scanned"] == int(kept.sum()) > 0
    assert first["observed"] + first["scanned"] == first["points"]
    assert first["scan"]["stations"] == 1 and first["scan"]["colored_by"] == "intensity"
    assert first["scan"]["placement"]["scale"] == pytest.approx(1 / SCALE)
    covered = [load_run(runs / name).rounds[1]["coverage_before"] for name in ("with", "without")]
    assert covered[0] > 0.95 > covered[1] + 0.2
    # In its place: the depth that the target has.
    figures = json.loads((runs / "with" / "metrics.json").read_text())
    assert figures["depth_rel_valid"] < 0.01


def test_a_given_placement_that_the_photographs_contradict_is_said(runs, tmp_path, capsys):
    options = ["--context", "first:1", "--targets", "range:4-5", "--refine", "0", "--rounds", "0"]
    words = ["--cloud", str(runs / "scan.laz"), "--cloud-placement", "identity"]
    main(["reconstruct", str(runs / "project"), *options, *words, "--out", str(tmp_path / "run")])
    assert "of the same places: is the matrix of another unit" in capsys.readouterr().err


def test_colours_that_the_photographs_contradict_are_said(runs, tmp_path, capsys):
    scan = far_scan(tmp_path / "scan.las", colored=True)
    options = ["--context", "range:4-5", "--targets", "first:1", "--refine", "0", "--rounds", "0"]
    words = ["--cloud", str(scan), "--cloud-placement", str(runs / "placement.txt")]
    main(["reconstruct", str(runs / "project"), *options, *words, "--out", str(tmp_path / "run")])
    said = capsys.readouterr().err
    assert "red and blue are the other way round" in said and "as bright" not in said


def test_pages_and_pictures_name_what_is_scanned(runs):
    page = (runs / "with" / "report.html").read_text()
    assert "of them scanned" in page and "scan.laz" in page
    assert "of them scanned" not in (runs / "without" / "report.html").read_text()
    from PIL import Image

    levels = set()
    for path in (runs / "with" / "round_001").glob("valid_*.png"):
        levels |= set(np.unique(np.asarray(Image.open(path))).tolist())
    assert 192 in levels


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--cloud", "{root}/few.las"], "20 points of the scan"),
        (["--cloud", "{root}/none.laz"], "no such file"),
        (["--cloud", "{root}/scan.laz", "--cloud-placement", "1,2"], "12 or 16 numbers"),
        (["--cloud-placement", "identity"], "without a scan"),
        (
            ["--cloud", "{root}/scan.laz", "--cloud-placement", "1,0,0,1e9,0,1,0,0,0,0,1,0"],
            "points lie beyond",
        ),
    ],
)
def test_what_cannot_be_placed_is_refused_in_one_line(runs, tmp_path, capsys, options, said):
    options = [option.format(root=runs) for option in options]
    project, out = str(runs / "project"), str(tmp_path / "out")
    status = main(
        ["reconstruct", project, "--context", "first:2", "--refine", "0", "--out", out, *options]
    )
    lines = capsys.readouterr().err.strip().splitlines()
    assert status == 2 and said in lines[-1] and not (tmp_path / "out").exists()
