"""How coarse a memory may be, told by views that are predicted from their neighbours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_scan import FOCAL, WALL, write_scan

from gvtools.errors import OptionError
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Scene
from gvtools.settings import with_texts
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.settings import RunSettings
from pipelines.reconstruction.voxel import NEIGHBOURS, SCALES, sufficient_scale

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


def test_too_few_views_tell_nothing(scan):
    scene = open_project(scan)
    few = scene.names[:NEIGHBOURS]
    assert sufficient_scale(scene, few, config=AT_FOOTPRINT, loss=9) == 1


def test_a_run_takes_the_measured_edge_unless_told_otherwise(scan):
    scene = open_project(scan)
    texts = ["context=not:first:1", "targets=first:1"]
    edges = {
        name: make_plan(scene, with_texts(RunSettings(), [*texts, *more])).config.voxel or 0
        for name, more in {
            "footprint": ["fusion.max_psnr_drop_db=none"],
            "balanced": [],
            "accurate": ["profile=accurate"],
            "any": ["fusion.max_psnr_drop_db=100"],
            "given": ["voxel=0.0123", "fusion.max_psnr_drop_db=100"],
        }.items()
    }
    assert edges["any"] == pytest.approx(SCALES[-1] * edges["footprint"], rel=0.01)
    wide = make_plan(
        scene, with_texts(RunSettings(), [*texts, "fusion.max_psnr_drop_db=100"])
    ).config
    assert (
        wide.memory.voxels_per_footprint == SCALES[-1] * RunSettings().memory.voxels_per_footprint
    )
    assert edges["accurate"] <= edges["balanced"] and edges["given"] == 0.0123
    with pytest.raises(OptionError, match=r"fusion\.max_psnr_drop_db"):
        with_texts(RunSettings(), ["fusion.max_psnr_drop_db=-1"])
