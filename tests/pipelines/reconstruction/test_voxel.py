from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_scan import FOCAL, SQUARE, WALL, render, world_from_cam, write_colmap_scan, write_scan

from gvtools.depth.choice import choose_source
from gvtools.depth.source import DepthMap, MixedDepth, RecordedDepth
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
from gvtools.errors import DegenerateError, OptionError, ProjectError
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.project import open_project
from gvtools.scenes.rgbd_layouts import SEVENSCENES
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.settings import with_texts
from pipelines.cli import main
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.settings import RunSettings
from pipelines.reconstruction.voxel import SCALES, automatic_voxel, sufficient_scale


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
    tracks = {key: getattr(scene.points, key)[mine] for key in ("point_index", "view_index", "xy")}
    points = replace(scene.points, **tracks)
    column, row = points.xy.astype(int).T
    exact = render(world_from_cam(3))[1][row, column]
    edge = automatic_voxel(replace(scene, points=points), scene.names, Never(), percentile=20)
    assert edge == pytest.approx(np.percentile(exact, 20) / FOCAL, rel=1e-5)


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
    words = ["reconstruct", str(folder), "--refine", "0", "--out", str(tmp_path / "run"),
             "--set", "stereo.max_side=64"]  # fmt: skip
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


FOOTPRINT = WALL / FOCAL
AT_FOOTPRINT = RunSettings(voxel=FOOTPRINT)


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    return write_scan(tmp_path_factory.mktemp("scan"), views=7)


def repainted(scene: Scene, pattern) -> Scene:
    """The scene with colours that are a function of the point seen, (H, W, 3) of (H, W, 3)."""

    def painted(view):
        def load():
            frame = view.load()
            height, width = frame.depth.shape
            x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
            K = view.camera.K[0]
            rays = np.stack(((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)), -1)
            pose = view.camera.world_from_cam[0]
            points = (rays * frame.depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
            return replace(frame, rgb=np.rint(255 * pattern(points)).astype(np.uint8))

        return replace(view, load=load)

    return replace(scene, views=tuple(painted(view) for view in scene.views))


def smooth(points: np.ndarray) -> np.ndarray:
    return 0.5 + 0.3 * np.sin(points / 2)


def fine(points: np.ndarray) -> np.ndarray:
    """Checks of three footprints."""
    squares = np.floor(points[..., :2] / (3 * FOOTPRINT)).sum(-1) % 2
    return np.repeat(0.2 + 0.6 * squares[..., None], 3, -1)


def scale_of(scene: Scene, loss: float, said: list[str] | None = None) -> float:
    say = None if said is None else said.append
    return sufficient_scale(scene, scene.names, config=AT_FOOTPRINT, loss=loss, say=say)


def test_smooth_surfaces_take_coarse_voxels_and_detailed_ones_do_not(scan):
    scene = open_project(scan)
    said: list[str] = []
    # Finer than a pixel's footprint: several views together show more than one.
    assert scale_of(repainted(scene, fine), 0.05, said) < 1
    assert scale_of(repainted(scene, smooth), 1.0) >= 3
    assert "context views predicted from their neighbours" in said[0] and "dB" in said[0]


def test_a_greater_loss_is_never_a_finer_edge(scan):
    scene = open_project(scan)
    scales = [scale_of(scene, loss) for loss in (0.0, 0.1, 1.0, 100.0)]
    assert scales == sorted(scales) and scales[-1] == SCALES[-1]
    assert set(scales) <= set(SCALES)


def test_a_run_takes_the_measured_edge_unless_told_otherwise(scan):
    scene = open_project(scan)
    texts = ["context=not:first:1", "targets=first:1", "refine.poses=false"]
    configs = {
        name: make_plan(scene, with_texts(RunSettings(), [*texts, *more])).config
        for name, more in {
            "footprint": ["fusion.max_psnr_drop_db=none"],
            "balanced": [],
            "accurate": ["profile=accurate"],
            "any": ["fusion.max_psnr_drop_db=100"],
            "given": ["voxel=0.0123", "fusion.max_psnr_drop_db=100"],
        }.items()
    }
    edges = {name: config.voxel or 0 for name, config in configs.items()}
    assert edges["any"] == pytest.approx(SCALES[-1] * edges["footprint"], rel=0.01)
    wide = configs["any"].memory.voxels_per_footprint
    assert wide == SCALES[-1] * RunSettings().memory.voxels_per_footprint
    assert edges["accurate"] <= edges["balanced"] and edges["given"] == 0.0123
    with pytest.raises(OptionError, match=r"fusion\.max_psnr_drop_db"):
        with_texts(RunSettings(), ["fusion.max_psnr_drop_db=-1"])
