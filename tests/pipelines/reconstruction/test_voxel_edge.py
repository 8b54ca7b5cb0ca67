"""The automatic voxel edge against exact distances, and what is computed to find it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_scan import FOCAL, SQUARE, WALL, render, world_from_cam, write_colmap_scan, write_scan

from gvtools.depth.choice import choose_source
from gvtools.depth.source import DepthMap, MixedDepth, RecordedDepth
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
from gvtools.errors import DegenerateError, ProjectError
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.rgbd import SEVENSCENES
from gvtools.scenes.scene import Frame, Scene, View
from pipelines.cli import main
from pipelines.reconstruction.voxel import automatic_voxel

pytestmark = pytest.mark.usefixtures("unpainted")


class Never:
    """A source that must not be asked."""

    name = "never"

    def covers(self, view: View) -> bool:
        return True

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        raise AssertionError(f"asked for the depth of {view.name}")


class Lacking(Never):
    """One that finds nothing."""

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        raise DegenerateError("none shows what it does")


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    return write_colmap_scan(tmp_path_factory.mktemp("photographs") / "colmap", views=10)


@pytest.fixture
def swept(monkeypatch) -> list[PlaneSweepStereo]:
    """The sweeps that are asked for depth, once for each view."""
    asked: list[PlaneSweepStereo] = []
    depth = PlaneSweepStereo.depth

    def noted(self, scene, view, frame):
        asked.append(self)
        return depth(self, scene, view, frame)

    monkeypatch.setattr(PlaneSweepStereo, "depth", noted)
    return asked


def test_recorded_depth_tells(tmp_path):
    scene = SEVENSCENES.read(write_scan(tmp_path / "scan"))
    said: list[str] = []
    for percentile, distance in ((50, WALL), (1, SQUARE)):
        edge = automatic_voxel(
            scene, scene.names, RecordedDepth(), percentile=percentile, say=said.append
        )
        assert edge == pytest.approx(distance / FOCAL)
    assert not said


def test_where_some_views_tell_the_others_are_not_computed(tmp_path, photographs):
    scene = SEVENSCENES.read(write_scan(tmp_path / "scan"))
    bare = tuple(replace(view, has_depth=False) for view in scene.views[1:])
    mixed = replace(scene, views=(scene.views[0], *bare))
    source = MixedDepth(RecordedDepth(), Never())
    assert automatic_voxel(mixed, mixed.names, source, percentile=50) == pytest.approx(WALL / FOCAL)
    # Likewise with sparse points in one view alone.
    scene = read_colmap(photographs)
    assert scene.points is not None
    mine = scene.points.view_index == 3
    points = replace(
        scene.points,
        point_index=scene.points.point_index[mine],
        view_index=scene.points.view_index[mine],
        xy=scene.points.xy[mine],
    )
    exact = render(world_from_cam(3))[1][
        scene.points.xy[mine, 1].astype(int), scene.points.xy[mine, 0].astype(int)
    ]
    edge = automatic_voxel(replace(scene, points=points), scene.names, Never(), percentile=20)
    assert edge == pytest.approx(np.percentile(exact, 20) / FOCAL, rel=1e-5)


def test_photographs_with_points_sweep_nothing(photographs, swept, tmp_path, capsys):
    words = [
        "reconstruct",
        str(photographs),
        "--refine",
        "0",
        "--out",
        str(tmp_path / "run"),
        "--dry-run",
    ]
    assert main(words) == 0
    assert not swept
    assert "computed now" not in capsys.readouterr().out


def test_without_points_a_small_sweep_serves_and_is_said(photographs, swept):
    scene = replace(read_colmap(photographs), points=None)
    source = choose_source(scene, scene.names, "auto").source
    said: list[str] = []
    edge = automatic_voxel(scene, scene.names, source, percentile=50, say=said.append)
    assert edge == pytest.approx(WALL / FOCAL, rel=0.1)
    assert len(said) == 1
    assert "rough depth (plane-sweep) of 5 of 10 context views" in said[0]
    assert len(swept) == 5
    for stereo in swept:
        assert stereo is not source
        assert stereo.options.max_side <= 160
        # Posing looks at every view of the context.
        assert stereo.options.align is False


def test_a_dry_run_without_points_says_it_and_leaves_nothing(tmp_path, swept, capsys):
    folder = write_colmap_scan(tmp_path / "colmap", points=0)
    words = ["reconstruct", str(folder), "--refine", "0", "--out", str(tmp_path / "run")]
    assert main([*words, "--dry-run"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("no sparse points or recorded depth to go by")
    assert len(swept) == 6
    assert not (tmp_path / "run").exists()
    # With an edge, there is nothing to find out.
    swept.clear()
    assert main([*words, "--dry-run", "--voxel", "0.05"]) == 0
    assert not swept
    assert "computed now" not in capsys.readouterr().out


def test_no_depth_at_all_is_an_error_that_names_the_way_out(photographs, tmp_path):
    scene = replace(read_colmap(photographs), points=None)
    with pytest.raises(ProjectError, match=r"none shows what it does\); give --voxel"):
        automatic_voxel(scene, scene.names, Lacking(), percentile=50)
    blank = SEVENSCENES.read(write_scan(tmp_path / "scan"))
    views = tuple(
        replace(view, load=lambda: Frame(np.zeros((72, 96, 3), np.uint8), np.zeros((72, 96), "f4")))
        for view in blank.views
    )
    with pytest.raises(ProjectError, match="empty; see 'gvtools check'"):
        automatic_voxel(replace(blank, views=views), blank.names, RecordedDepth(), percentile=50)
