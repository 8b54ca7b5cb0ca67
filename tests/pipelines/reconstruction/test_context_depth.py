"""Computed depth of the context: kept by round 0, read on resuming, checked against the points."""

from __future__ import annotations

import shutil
import threading
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from run_files import report_of
from tiny_scan import ExactDepth, render, world_from_cam, write_colmap_scan, write_scan

from gvtools.depth import choice
from gvtools.depth.source import DepthMap
from gvtools.errors import DegenerateError
from gvtools.prefetch import prefetch
from gvtools.runs.context_depth import off_scale
from gvtools.scenes.scene import Frame, Scene, View
from pipelines.cli import main

RUN = ("--targets", "range:3-4", "--views-per-round", "1", "--context", "first:3",
       "--refine", "0", "--set", "refine.poses=false",
       "--depth", "plane-sweep", "--quiet")  # fmt: skip
# Every view's depth is asked for, whatever memory explains.
ALL = ("--set", "savings.depth_from_memory=none")


@pytest.fixture
def scan(tmp_path, monkeypatch):
    """A recording whose context views have lost their depth maps; the source knows the depth."""
    folder = write_scan(tmp_path / "scan")
    for index in (0, 2):
        Image.fromarray(np.zeros((72, 96), np.uint16)).save(folder / f"frame-{index:06d}.depth.png")
    monkeypatch.setattr(choice, "_stereo", lambda *_: ExactDepth())
    ExactDepth.asked = 0
    return folder


def reconstruct(scan, out, *more: object) -> int:
    words = ("reconstruct", scan, "--out", out, *RUN, *more)
    return main([str(word) for word in words])


def test_depth_that_nothing_confirms_is_fused_as_generated(scan, tmp_path, monkeypatch):
    exact = ExactDepth.depth

    def half_guessed(self, scene, view, frame):
        found = exact(self, scene, view, frame)
        left = np.zeros(found.depth.shape, np.bool_)
        left[:, :48] = True
        return replace(found, guessed=left)

    counts = []
    for name in ("sure", "guessed"):
        if name == "guessed":
            monkeypatch.setattr(ExactDepth, "depth", half_guessed)
        assert reconstruct(scan, tmp_path / name, "--voxel", "0.03", *ALL) == 0
        report = report_of(tmp_path / name)
        counts.append((report["observed"], report["generated"], report["dropped"]["masked"]))
    (all_observed, none, masked), (observed, generated, masked_too) = counts
    assert none == 0 and masked_too == masked
    # A guess takes no voxel that another view sees for certain.
    assert 0.4 * all_observed < observed < 0.8 * all_observed
    assert 0 < generated < all_observed - observed + 500


def test_computed_depth_is_kept_and_asked_for_once(scan, tmp_path):
    out = tmp_path / "run"
    assert reconstruct(scan, out, "--voxel", "0.03", *ALL) == 0
    # Once a view, although round 0 lifts it and the completer looks at it in every round.
    assert ExactDepth.asked == 3
    kept = sorted((out / "round_000").glob("context_depth_*.npz"))
    assert len(kept) == 3
    with np.load(kept[0]) as stored:
        np.testing.assert_array_equal(
            stored["depth"], render(world_from_cam(0))[1].astype(np.float32)
        )
        assert str(stored["source"]) == "exact"
    assert kept[0].with_suffix(".png").is_file()
    report = report_of(out)
    assert [entry["source"] for entry in report["depth"]] == ["exact"] * 3
    assert report["depth"][0]["known"] == 1
    assert report["depth"][0]["scale"] is None


def test_a_view_that_memory_explains_needs_none_computed(scan, tmp_path):
    out = tmp_path / "run"
    assert reconstruct(scan, out, "--voxel", "0.03", "--set", "savings.depth_from_memory=0.8") == 0
    report = report_of(out)
    sources = [entry["source"] for entry in report["depth"]]
    assert sources[0] == "exact" and sources.count("memory") == 3 - ExactDepth.asked > 0
    row = sources.index("memory")
    assert report["depth"][row]["known"] >= 0.8
    kept = sorted((out / "round_000").glob("context_depth_*.npz"))
    with np.load(kept[row]) as stored:
        known = stored["depth"] > 0
        truth = render(world_from_cam(row))[1]
        assert np.median(np.abs(stored["depth"][known] / truth[known] - 1)) < 0.01


def test_a_resumed_run_reads_it_again(scan, tmp_path):
    out = tmp_path / "run"
    assert reconstruct(scan, out, "--voxel", "0.03") == 0
    whole = (out / "memory.npz").read_bytes()
    shutil.rmtree(out / "round_002")
    ExactDepth.asked = 0
    assert reconstruct(scan, out, "--voxel", "0.03", "--resume") == 0
    assert ExactDepth.asked == 0
    assert (out / "memory.npz").read_bytes() == whole
    shutil.rmtree(out / "round_002")
    next((out / "round_000").glob("context_depth_*.npz")).write_bytes(b"half")
    assert reconstruct(scan, out, "--voxel", "0.03", "--resume") == 2


def test_a_view_without_depth_does_not_stop_the_others(scan, tmp_path, monkeypatch, capsys):
    class Lacking(ExactDepth):
        def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
            if view.name.startswith("frame-000001") or Lacking.none:
                raise DegenerateError(f"none shows what {view.name} does")
            return super().depth(scene, view, frame)

        none = False

    monkeypatch.setattr(choice, "_stereo", lambda *_: Lacking())
    out = tmp_path / "run"
    assert reconstruct(scan, out, *ALL) == 0
    assert "1 of 3 views have no depth" in capsys.readouterr().err
    report = report_of(out)
    assert [entry["known"] for entry in report["depth"]] == [1, 0, 1]
    assert "frame-000001" in report["depth"][1]["failed"]
    Lacking.none = True
    assert reconstruct(scan, tmp_path / "none", "--voxel", "0.03") == 2
    assert "none shows what" in capsys.readouterr().err


def test_views_off_the_sparse_points_scale_are_reported_and_named(tmp_path, monkeypatch, capsys):
    wrong = (1, 4)

    class Scaled(ExactDepth):
        """Depth of some views is by a third too large."""

        def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
            index = int(view.name[5:-4])
            depth = render(world_from_cam(index))[1] * (4 / 3 if index in wrong else 1)
            return DepthMap(depth.astype(np.float32), np.ones(depth.shape, np.float32), "scaled")

    monkeypatch.setattr(choice, "_stereo", lambda *_: Scaled())
    scan, out = write_colmap_scan(tmp_path / "colmap", views=8), tmp_path / "run"
    options = ("--context", "not:first:1", "--targets", "first:1", "--completer", "none")
    words = ["reconstruct", str(scan), "--refine", "0", "--out", str(out), *options, *ALL]
    assert main([*words, "--quiet"]) == 0
    for entry in report_of(out)["depth"]:
        off, scale = int(entry["view"][5:-4]) in wrong, entry["scale"]
        assert scale["disagrees"] is off
        assert scale["scale"] == pytest.approx(0.75 if off else 1, rel=1e-3)
        assert scale["status"] == "aligned"
        assert scale["inliers"] > 40
        assert scale["residual"] < 1e-3
    last = capsys.readouterr().err.splitlines()[-1]
    assert "2 of 7 views is off the sparse points' scale: view_1.png, view_4.png;" in last
    assert str(out / "round_000" / "report.json") in last
    # A run that is taken up again says it as well.
    assert main([*words, "--quiet", "--resume"]) == 0
    assert "view_1.png, view_4.png;" in capsys.readouterr().err


def test_items_come_in_order_with_the_next_one_begun():
    begun: list[int] = []
    second = threading.Event()

    def load(item: int) -> int:
        begun.append(item)
        if item == 1:
            second.set()
        return 10 * item

    items = prefetch(load, range(4))
    assert next(items) == 0
    # Nobody has asked for it yet.
    assert second.wait(5) and 3 not in begun
    assert list(items) == [10, 20, 30]
    assert list(prefetch(load, [])) == []


def test_an_error_comes_where_its_item_would_have():
    def load(item: int) -> int:
        if item == 1:
            raise ValueError("broken")
        return item

    items = prefetch(load, range(3))
    assert next(items) == 0
    with pytest.raises(ValueError, match="broken"):
        next(items)


@pytest.mark.parametrize(("scale", "told"), [(1.08, "aligned, scale 1.08;"), (None, "aligned; l")])
def test_depth_off_the_points_is_told_with_its_scale_where_there_is_one(scale, told):
    odd = {"view": "a.png", "scale": {"disagrees": True, "status": "aligned", "scale": scale}}
    assert told in (off_scale([odd, {"view": "b.png", "scale": None}]) or "")
