from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import camera

from gvtools.cameras import Cameras
from gvtools.errors import ShapeError
from gvtools.memory.back_projection import FREE_CELL, BackProjectionOptions, back_project
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.voxel_index import VoxelLevels

KEEP_ALL = BackProjectionOptions(edge=1e9, grazing=0)
FOCAL, NEAR, FAR = 50.0, 1.0, 4.0
# Keeps everything, steps too.
STEEP = BackProjectionOptions(edge=10.0, grazing=0.0)


def _numbered(shape) -> np.ndarray:
    """Colours that name the pixel: row, column, 0."""
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return np.stack([rows, cols, 0 * rows], -1).astype(np.uint8)


def _plane_depth(source, normal, distance) -> np.ndarray:
    """Depth of the plane normal · X = distance of the camera's frame."""
    return (distance / (source.rays() @ np.asarray(normal))).astype(np.float32)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), far=st.sampled_from([0.0, 5e6]))
def test_projection_undoes_back_projection(seed, far):
    """Also for turned, skewed and georeferenced cameras: to a thousandth of a pixel."""
    rng = np.random.default_rng(seed)
    origin = far * rng.normal(0, 1, 3)
    source = camera(
        width=40, height=30, focal=35, skew=rng.uniform(-2, 2),
        rotation=rng.normal(0, 1, 3), center=origin + rng.normal(0, 2, 3),
    )  # fmt: skip
    depth = rng.uniform(1, 9, (30, 40)).astype(np.float32)
    depth[rng.random((30, 40)) < 0.2] = 0
    lifted = back_project(
        _numbered((30, 40)), depth, source, frame=LocalFrame.at(origin), options=KEEP_ALL
    )
    # The oracle's own rounding is that of coordinates of millions: look from near the origin.
    xy, z = source.project(lifted.positions.astype(float) + origin)
    rows, cols = lifted.colors[:, 0].astype(int), lifted.colors[:, 1].astype(int)
    np.testing.assert_allclose(xy[0, :, 0], cols + 0.5, atol=1e-3)
    np.testing.assert_allclose(xy[0, :, 1], rows + 0.5, atol=1e-3)
    np.testing.assert_allclose(z[0], depth[rows, cols], rtol=1e-5)
    assert len(lifted) + sum(lifted.dropped.values()) == 1200
    assert lifted.dropped["no depth"] == (depth == 0).sum()
    assert lifted.camera is source


def test_generated_depth_keeps_its_edges_with_little_confidence():
    source = camera(width=40, height=30, focal=35)
    depth = np.full((30, 40), 4, np.float32)
    depth[10:20, 10:30] = 2
    rgb = _numbered(depth.shape)
    measured = back_project(rgb, depth, source)
    made = back_project(rgb, depth, source, generated=True)
    assert measured.dropped["depth edge"] > 0
    assert (len(made), made.dropped["depth edge"]) == (depth.size, 0)
    kept = np.zeros(depth.shape, bool)
    kept[measured.colors[:, 0], measured.colors[:, 1]] = True
    at_edge = ~kept[made.colors[:, 0], made.colors[:, 1]]
    assert made.confidence[at_edge].max() < made.confidence[~at_edge].min() / 5
    np.testing.assert_array_equal(made.confidence[~at_edge], measured.confidence)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.5, 0, 1), (0.3, -0.6, 1), (0.9, 0.4, 1)])
def test_a_slanted_plane_is_kept_whole_with_its_cosine_and_spacing(normal):
    source = camera(width=120, height=90, focal=100)
    n = np.asarray(normal) / np.linalg.norm(normal)
    depth = _plane_depth(source, n, 3.0)
    assert depth.min() > 0
    lifted = back_project(_numbered(depth.shape), depth, source)
    assert len(lifted) == depth.size
    assert sum(lifted.dropped.values()) == 0
    rays = source.rays().reshape(-1, 3)
    cosine = rays @ n / np.linalg.norm(rays, axis=1)
    np.testing.assert_allclose(lifted.confidence, cosine, rtol=2e-3)
    np.testing.assert_allclose(lifted.spacing, depth.ravel() / 100, rtol=1e-6)
    np.testing.assert_allclose(lifted.positions.astype(float) @ n, 3.0, rtol=1e-6)


def test_a_step_loses_the_pixels_beside_it_and_no_others():
    source = camera(width=60, height=40, focal=50)
    depth = np.full((40, 60), 2, np.float32)
    depth[:, 30:] = 2.4
    lifted = back_project(_numbered(depth.shape), depth, source)
    kept = np.zeros(depth.shape, bool)
    kept[lifted.colors[:, 0], lifted.colors[:, 1]] = True
    np.testing.assert_array_equal(kept[:, [29, 30]], False)
    kept[:, [29, 30]] = True
    assert kept.all()
    assert lifted.dropped["depth edge"] == 80
    # A step below the tolerance is surface.
    depth[:, 30:] = 2.08
    assert len(back_project(_numbered(depth.shape), depth, source)) == depth.size


def test_grazing_surfaces_are_dropped():
    source = camera(width=60, height=40, focal=50)
    depth = _plane_depth(source, np.array((0, 0.8, 0.6)), 1.0)
    rays = source.rays()
    cosine = (rays @ (0, 0.8, 0.6)) / np.linalg.norm(rays, axis=-1)
    for grazing in (0.3, 0.5):
        options = BackProjectionOptions(edge=1, grazing=grazing)
        lifted = back_project(_numbered(depth.shape), depth, source, options=options)
        expected = (cosine >= grazing).sum()
        assert 0 < expected < depth.size
        assert abs(len(lifted) - expected) <= 2


def test_masks_confidence_and_the_farthest_depth_choose_pixels():
    rng = np.random.default_rng(0)
    source = camera(width=40, height=30, focal=30)
    depth = np.full((30, 40), 3, np.float32)
    depth[:, 20:] = 3.05
    depth[0, :5] = (np.nan, np.inf, -1, 0, -np.inf)
    mask = rng.random((30, 40)) < 0.7
    trust = rng.uniform(-0.5, 2, (30, 40)).astype(np.float32)
    lifted = back_project(
        _numbered((30, 40)), depth, source, mask=mask, confidence=trust,
        options=BackProjectionOptions(edge=1e9, grazing=0, depth_max=3.02),
    )  # fmt: skip
    usable = np.isfinite(depth) & (depth > 0) & (depth <= 3.02)
    expected = usable & mask & (trust > 0)
    rows, cols = lifted.colors[:, 0].astype(int), lifted.colors[:, 1].astype(int)
    found = np.zeros((30, 40), bool)
    found[rows, cols] = True
    np.testing.assert_array_equal(found[1:], expected[1:])
    assert lifted.dropped["masked"] == (usable & ~mask).sum()
    middle = (rows > 1) & (cols < 19)
    rays = source.rays()[rows, cols]
    cosine = 1 / np.linalg.norm(rays, axis=1)
    np.testing.assert_allclose(
        lifted.confidence[middle], (trust[rows, cols] * cosine)[middle], rtol=1e-4
    )


def test_the_free_space_grid_is_the_nearest_depth_of_whole_cells():
    rng = np.random.default_rng(1)
    source = camera(width=42, height=30, focal=30)
    depth = rng.uniform(1, 6, (30, 42)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.02] = 0
    mask = rng.random(depth.shape) < 0.99
    trust = (rng.random(depth.shape) < 0.99).astype(np.float32)
    lifted = back_project(
        _numbered(depth.shape), depth, source, mask=mask, confidence=trust,
        options=BackProjectionOptions(depth_max=3.0),
    )  # fmt: skip
    expected = np.zeros((8, 11), np.float32)
    for i in range(8):
        for j in range(11):
            cell = np.s_[i * FREE_CELL : (i + 1) * FREE_CELL, j * FREE_CELL : (j + 1) * FREE_CELL]
            if (depth[cell] > 0).all() and mask[cell].all() and (trust[cell] > 0).all():
                expected[i, j] = min(depth[cell].min(), 3.0)
    assert 0.3 < (expected > 0).mean() < 1
    np.testing.assert_array_equal(lifted.free_depth, expected)


def test_images_of_another_size_are_refused_with_both_sizes():
    source = camera(width=40, height=30)
    depth = np.ones((30, 40), np.float32)
    rgb = _numbered((30, 40))
    with pytest.raises(ShapeError, match=r"rgb has shape \(30, 39, 3\).*\(30, 40, 3\)"):
        back_project(rgb[:, :39], depth, source)
    for name in ("depth", "confidence", "mask"):
        images: dict[str, Any] = {
            "depth": depth,
            name: depth[:29] > 0 if name == "mask" else depth[:29],
        }
        with pytest.raises(ShapeError, match=f"{name} has shape"):
            back_project(rgb, camera=source, **images)


def pinhole(width: int, height: int) -> Cameras:
    return camera(width=width, height=height, focal=FOCAL)


def blocks(width: float, footprints: float = 0.0) -> dict[str, Any]:
    """Blocks as wide as a voxel's edge."""
    return {"levels": VoxelLevels(width, footprints), "pixel_binning": 1.0}


def wall(width: int, height: int, z: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(width)
    rgb = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    return rgb, np.full((height, width), z, np.float32)


def test_a_binned_point_is_the_mean_of_its_four_pixels():
    rgb, depth = wall(8, 6, NEAR)
    every = back_project(rgb, depth, pinhole(8, 6))
    binned = back_project(rgb, depth, pinhole(8, 6), **blocks(2 * NEAR / FOCAL))
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


def test_far_blocks_are_binned_where_voxels_widen_with_them():
    rgb, depth = wall(16, 8, NEAR)
    depth[:, 8:] = FAR
    every = back_project(rgb, depth, pinhole(16, 8), options=STEEP)
    counts = [
        len(back_project(rgb, depth, pinhole(16, 8), options=STEEP, **blocks(*levels)))
        for levels in ((2 * NEAR / FOCAL, 0.0), (2 * NEAR / FOCAL, 2.0), (2 * NEAR / FOCAL, 1.0))
    ]
    # Far voxels of one footprint have no room for a block of two.
    assert counts == [len(every) * 5 // 8, len(every) // 4, len(every) * 5 // 8]


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 3), (5, 2), (7, 5)])
def test_what_is_not_whole_is_kept_pixel_by_pixel(width: int, height: int):
    rgb, depth = wall(width, height, NEAR)
    mask = np.ones(depth.shape, bool)
    mask[0, 0] = False
    lifted = len(back_project(rgb, depth, pinhole(width, height), mask=mask))
    binned = back_project(rgb, depth, pinhole(width, height), mask=mask, **blocks(1.0))
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
        every = back_project(rgb, depth, pinhole(width, height), options=STEEP)
        binned = back_project(rgb, depth, pinhole(width, height), options=STEEP, **blocks(limit))
        counts.append(len(binned) / len(every))
    assert counts[0] < 0.5 and counts[1] == 1
    _, step = wall(width, height, 2.0)
    step[:, 11:] = 2.6
    binned = back_project(
        rgb, step, pinhole(width, height), options=STEEP, **blocks(2.5 * 2.6 / FOCAL)
    )
    assert np.isin(binned.positions[:, 2], np.array([2.0, 2.6], np.float32)).all()
    assert len(binned) < width * height / 3


@pytest.mark.parametrize("confidence", [1e-45, 1.0, 3e38])
def test_any_confidence_is_kept(confidence):
    rgb, depth = wall(8, 6, NEAR)
    trust = np.full(depth.shape, confidence, np.float32)
    with np.errstate(all="raise"):
        binned = back_project(rgb, depth, pinhole(8, 6), confidence=trust, **blocks(1e300))
    assert len(binned) == 12 and np.isfinite(binned.confidence).all()
    assert (binned.confidence > 0).all()
