"""A photograph that memory explains takes its depth from there; any other is refused."""

from __future__ import annotations

import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.depth.options import StereoOptions
from gvtools.depth.shown import depth_from_memory
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.procedural.stereo_sample import write_motorcycle
from gvtools.scenes.project import open_project

SIZE = (60, 80)
CELLS = np.random.default_rng(3).integers(40, 200, (64, 64, 3), dtype=np.uint8)


def camera(x: float = 0.0) -> Cameras:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Cameras.pinhole(80, 60, focal=80, cam_from_world=pose, name="c")


def wall(x: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A slanted wall of coloured squares from a camera at x: its picture and its depth."""
    row, column = np.indices(SIZE) + 0.5
    ray = (column - 40) / 80
    # The plane z = 2 + 0.2 x in the world.
    depth = (2 + 0.2 * x) / (1 - 0.2 * ray)
    u, v = ray * depth + x, (row - 30) / 80 * depth
    rgb = CELLS[np.floor(8 * v).astype(int) % 64, np.floor(8 * u).astype(int) % 64]
    return rgb, depth.astype(np.float32)


@pytest.fixture
def memory() -> SpatialMemory:
    out = SpatialMemory(0.02)
    for x in (-0.2, 0.2):
        rgb, depth = wall(x)
        out.observe(rgb, depth, camera(x), round=0)
    return out


@pytest.mark.parametrize("gain", [1.0, 0.8, 1.2])
def test_a_view_between_two_is_explained_at_any_exposure(memory, gain):
    rgb, depth = wall()
    found = depth_from_memory(memory, camera(), (rgb * gain).astype(np.uint8), least=0.9)
    assert found is not None and found.source == "memory"
    known = found.depth > 0
    assert known.mean() > 0.95
    assert np.median(np.abs(found.depth[known] / depth[known] - 1)) < 0.003
    assert (found.confidence > 0).all() and (found.confidence <= 1).all()


@pytest.mark.parametrize("what", ["black", "noise", "mirrored", "checks"])
def test_a_dark_photograph_of_something_else_is_not_explained(what):
    """Over a memory without much contrast, which a dark picture is near to in absolute terms."""
    row, column = np.indices(SIZE)
    smooth = np.repeat((100 + 1.5 * column).astype(np.uint8)[..., None], 3, -1)
    depth = np.full(SIZE, 2, np.float32)
    known = SpatialMemory(0.02)
    known.observe(smooth, depth, camera(), round=0)
    pictures: dict[str, np.ndarray] = {
        "black": np.zeros_like(smooth),
        "noise": np.random.default_rng(0).integers(0, 50, smooth.shape),
        "mirrored": smooth[:, ::-1] // 3,
        "checks": np.where((row // 8 + column // 8) % 2, 80, 20)[..., None].repeat(3, -1),
    }
    rgb = pictures[what].astype(np.uint8)
    assert depth_from_memory(known, camera(), rgb, least=0.85) is None
    assert depth_from_memory(known, camera(), smooth // 3, least=0.85) is not None


def test_what_looks_different_is_not_explained(memory):
    rgb, _ = wall()
    rgb = rgb.copy()
    rgb[10:50, 30:60] = np.where(rgb[10:50, 30:60] > 120, 0, 255)
    assert depth_from_memory(memory, camera(), rgb, least=0.9) is None
    found = depth_from_memory(memory, camera(), rgb, least=0.5)
    assert found is not None
    assert (found.depth[14:46, 34:56] == 0).mean() > 0.9
    assert (found.depth[:, :26] > 0).mean() > 0.9


def test_a_view_of_elsewhere_is_not_explained(memory):
    rgb, _ = wall(1.0)
    assert depth_from_memory(memory, camera(1.0), rgb, least=0.9) is None
    assert depth_from_memory(SpatialMemory(0.02), camera(), rgb, least=0.1) is None


def test_what_was_generated_explains_nothing():
    memory = SpatialMemory(0.02)
    rgb, depth = wall()
    memory.observe(rgb, depth, camera(), round=1, generated=True)
    assert depth_from_memory(memory, camera(), rgb, least=0.1) is None


def test_the_motorcycle_pair_has_its_recorded_depth(tmp_path):
    write_motorcycle(tmp_path)
    scene = open_project(tmp_path)
    view = scene.views[0]
    frame = view.load()
    assert frame.depth is not None
    source = PlaneSweepStereo(scene, options=StereoOptions(), views=scene.names)
    found = source.depth(scene, view, frame).depth
    both = (found > 0) & (frame.depth > 0)
    error = np.abs(found[both] / frame.depth[both] - 1)
    assert both.sum() > 0.8 * (frame.depth > 0).sum()
    assert np.median(error) < 0.003 and (error > 0.1).mean() < 0.06
