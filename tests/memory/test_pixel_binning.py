"""Pixels finer than voxels become one point, four at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.memory.back_projection import BackProjectionOptions, back_project
from gvtools.memory.store.voxel_index import VoxelLevels

FOCAL, NEAR, FAR = 50.0, 1.0, 4.0
# Keeps everything, steps too.
STEEP = BackProjectionOptions(edge=10.0, grazing=0.0)


def camera(width: int, height: int) -> Cameras:
    K = np.array([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1]])
    return Cameras(K[None], np.eye(4)[None], np.array([width]), np.array([height]), ("view",))


def blocks(width: float, footprints: float = 0.0) -> dict[str, Any]:
    """Blocks as wide as a voxel's edge."""
    return {"levels": VoxelLevels(width, footprints), "pixel_binning": 1.0}


def wall(width: int, height: int, z: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(width)
    rgb = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    return rgb, np.full((height, width), z, np.float32)


def test_a_binned_point_is_the_mean_of_its_four_pixels():
    rgb, depth = wall(8, 6, NEAR)
    every = back_project(rgb, depth, camera(8, 6))
    binned = back_project(rgb, depth, camera(8, 6), **blocks(2 * NEAR / FOCAL))
    assert len(every) == 48 and len(binned) == 12
    shape = (3, 2, 4, 2)
    for name in ("positions", "colors", "confidence", "spacing"):
        values = getattr(every, name).astype(np.float64)
        mean = values.reshape(*shape, -1).mean((1, 3)).reshape(12, -1)
        tolerance = 0.5 if name == "colors" else 1e-6
        found = getattr(binned, name).reshape(12, -1)
        np.testing.assert_allclose(found, mean, atol=tolerance)
    assert binned.dropped == every.dropped
    np.testing.assert_array_equal(binned.free_depth, every.free_depth)


def test_only_blocks_that_are_narrow_enough_are_binned():
    rgb, depth = wall(16, 8, NEAR)
    depth[:, 8:] = FAR
    between = back_project(rgb, depth, camera(16, 8), **blocks(3 * NEAR / FOCAL))
    near = between.positions[:, 2] == NEAR
    assert np.all(between.spacing == between.positions[:, 2] / np.float32(FOCAL))
    assert near.sum() < len(back_project(rgb, depth, camera(16, 8))) / 4
    every = back_project(rgb, depth, camera(16, 8))
    assert (~near).sum() == (every.positions[:, 2] == FAR).sum()


def test_far_blocks_are_binned_where_voxels_widen_with_them():
    rgb, depth = wall(16, 8, NEAR)
    depth[:, 8:] = FAR
    every = back_project(rgb, depth, camera(16, 8), options=STEEP)
    counts = [
        len(back_project(rgb, depth, camera(16, 8), options=STEEP, **blocks(*levels)))
        for levels in ((2 * NEAR / FOCAL, 0.0), (2 * NEAR / FOCAL, 2.0), (2 * NEAR / FOCAL, 1.0))
    ]
    # Far voxels of one footprint have no room for a block of two.
    assert counts == [len(every) * 5 // 8, len(every) // 4, len(every) * 5 // 8]


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 3), (5, 2), (7, 5)])
def test_what_is_not_whole_is_kept_pixel_by_pixel(width: int, height: int):
    rgb, depth = wall(width, height, NEAR)
    mask = np.ones(depth.shape, bool)
    mask[0, 0] = False
    lifted = len(back_project(rgb, depth, camera(width, height), mask=mask))
    binned = back_project(rgb, depth, camera(width, height), mask=mask, **blocks(1.0))
    # The corner's block is not whole, nor are those at an odd side's end.
    whole = max((width // 2) * (height // 2) - 1, 0)
    assert len(binned) == lifted - 3 * whole


def test_steep_surfaces_keep_their_points_and_nothing_is_binned_across_a_step():
    width, height, limit = 24, 16, 2.5 * NEAR / FOCAL
    x = (np.arange(width) + 0.5 - width / 2) / FOCAL
    rgb, _ = wall(width, height, NEAR)
    counts = []
    for slope in (0.5, 8.0):
        # The plane z = NEAR + slope x: pixels lie sqrt(1 + slope²) times as far apart along it.
        depth = np.tile((NEAR / (1 - slope * x)).astype(np.float32), (height, 1))
        depth[:, (depth[0] > 1.2) | (depth[0] < 0.8)] = 0
        every = back_project(rgb, depth, camera(width, height), options=STEEP)
        binned = back_project(rgb, depth, camera(width, height), options=STEEP, **blocks(limit))
        counts.append(len(binned) / len(every))
    assert counts[0] < 0.5 and counts[1] == 1
    _, step = wall(width, height, 2.0)
    step[:, 11:] = 2.6
    binned = back_project(
        rgb, step, camera(width, height), options=STEEP, **blocks(2.5 * 2.6 / FOCAL)
    )
    assert np.isin(binned.positions[:, 2], np.array([2.0, 2.6], np.float32)).all()
    assert len(binned) < width * height / 3


@pytest.mark.parametrize("confidence", [1e-45, 1.0, 3e38])
def test_any_confidence_is_kept(confidence):
    rgb, depth = wall(8, 6, NEAR)
    trust = np.full(depth.shape, confidence, np.float32)
    with np.errstate(all="raise"):
        binned = back_project(rgb, depth, camera(8, 6), confidence=trust, **blocks(1e300))
    assert len(binned) == 12 and np.isfinite(binned.confidence).all()
    assert (binned.confidence > 0).all()
