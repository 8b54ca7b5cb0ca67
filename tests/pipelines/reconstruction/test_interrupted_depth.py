"""Depth that round 0 had computed when it was interrupted: taken over by the same run, by no other.

The pictures are of the tiny scan and the depth comes from the plane sweep itself.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from run_files import results, untimed
from tiny_scan import write_scan

from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
from gvtools.errors import DegenerateError
from pipelines.cli import main

RUN = ("--context", "every:2", "--targets", "range:1-1", "--completer", "none", "--refine", "0",
       "--set", "refine.poses=false", "--depth", "plane-sweep", "--set", "stereo.max_side=64",
       "--voxel", "0.03", "--quiet")  # fmt: skip
VIEWS = 4


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("scan") / "scan", views=2 * VIEWS)


@pytest.fixture(scope="module")
def whole(scan, tmp_path_factory):
    """An uninterrupted run."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert reconstruct(scan, out) == 0
    return out


def words(scan: Path, out: Path, *more: str) -> list[str]:
    return ["reconstruct", str(scan), "--out", str(out), *RUN, *more]


def reconstruct(scan: Path, out: Path, *more: str) -> int:
    return main(words(scan, out, *more))


@pytest.fixture
def asked(monkeypatch) -> list[str]:
    """Names of the views that the sweep is asked for, in order."""
    names: list[str] = []
    depth = PlaneSweepStereo.depth

    def noted(self, scene, view, frame):
        names.append(view.name)
        return depth(self, scene, view, frame)

    monkeypatch.setattr(PlaneSweepStereo, "depth", noted)
    return names


def interrupted(scan: Path, out: Path) -> None:
    """A run that is interrupted before its fourth and last view."""
    with pytest.MonkeyPatch.context() as patch:
        stop_before(patch, 6, KeyboardInterrupt())
        assert reconstruct(scan, out) == 1


def stop_before(monkeypatch, index: int, error: BaseException) -> None:
    """Let the sweep fail at the view of this index."""
    depth = PlaneSweepStereo.depth

    def failing(self, scene, view, frame):
        if view.name.startswith(f"frame-{index:06d}"):
            raise error
        return depth(self, scene, view, frame)

    monkeypatch.setattr(PlaneSweepStereo, "depth", failing)


def test_an_interrupt_keeps_what_is_whole_and_nothing_else(scan, whole, tmp_path, capsys):
    out = tmp_path / "run"
    interrupted(scan, out)
    part = out / ".round_000.part"
    assert len(list(part.glob("context_depth_*.npz"))) == 3
    assert {path.name[:14] for path in part.iterdir()} == {"context_depth_"}
    assert main([word for word in words(scan, out, "--resume") if word != "--quiet"]) == 0
    assert "taking over the depth of 3 of 4 context views" in capsys.readouterr().out
    assert results(out) == results(whole)


@pytest.mark.slow
@pytest.mark.parametrize("other", [("--set", "stereo.window=5"), ("--seed", "3")])
def test_another_run_computes_its_own(scan, tmp_path, monkeypatch, asked, other):
    out = tmp_path / "run"
    interrupted(scan, out)
    asked.clear()
    assert reconstruct(scan, out, *other, "--resume") == 0
    assert len(asked) == VIEWS
    alone = tmp_path / "alone"
    assert reconstruct(scan, alone, *other) == 0
    assert results(out) == results(alone)


def test_a_damaged_file_of_an_unfinished_round_is_computed_anew(
    scan, whole, tmp_path, monkeypatch, asked
):
    out = tmp_path / "run"
    interrupted(scan, out)
    asked.clear()
    kept = sorted((out / ".round_000.part").glob("context_depth_*.npz"))
    kept[0].write_bytes(kept[0].read_bytes()[:200])
    np.savez_compressed(kept[1], depth=np.zeros((2, 2)), confidence=0, source="", failed="")
    (kept[2].parent / f".{kept[2].name}.part").write_bytes(b"half")
    assert reconstruct(scan, out, "--resume") == 0
    assert len(asked) == VIEWS - 1
    assert results(out) == results(whole)


@pytest.mark.slow
def test_why_a_view_has_no_depth_outlasts_the_interrupt(scan, tmp_path, monkeypatch, capsys):
    out, straight = tmp_path / "run", tmp_path / "straight"
    with monkeypatch.context() as lacking:
        stop_before(lacking, 2, DegenerateError("none shows what frame-000002 does"))
        assert reconstruct(scan, straight) == 0
        with lacking.context() as patch:
            stop_before(patch, 6, KeyboardInterrupt())
            assert reconstruct(scan, out) == 1
    capsys.readouterr()
    # The reason comes from the file: the sweep itself would find depth now.
    assert reconstruct(scan, out, "--resume") == 0
    assert "1 of 4 views have no depth" in capsys.readouterr().err
    assert results(out) == results(straight)
    assert untimed(out) == untimed(straight)
