"""Borders and ties: points between two voxels or two pixels, equal depths, all in one pixel."""

from __future__ import annotations

import numpy as np
import pytest
from extreme_scenes import SIZE, finite, focal
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import camera, points, saved_bytes

from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.splat.one_pixel import project_nearest

EDGES = (0.1, 1 / 3, 0.02, 0.5, 1e-6, 7e5)
BACKENDS = ("cpu", "torch", "nearest")


def _cells(memory: SpatialMemory) -> np.ndarray:
    return np.floor(memory.columns.positions.astype(float) * (1.0 / memory.voxel))


@settings(max_examples=60, deadline=None)
@given(
    edge=st.sampled_from(EDGES),
    corner=st.tuples(*[st.integers(-300, 300)] * 3),
    steps=st.integers(1, 40),
)
def test_points_on_borders_belong_to_one_voxel_and_stay_there(edge, corner, steps):
    """Multiples of the edge and their two neighbours in float32, on either side of zero."""
    on = (np.arange(steps)[:, None] + corner).astype(np.float64) * edge
    on = on.astype(np.float32)
    sides = [on, np.nextafter(on, np.float32(np.inf)), np.nextafter(on, np.float32(-np.inf))]
    where = np.concatenate(sides)
    memory = SpatialMemory(edge)
    memory.fuse(points(where, spacing=edge), round=0)
    expected = np.unique(np.floor(where.astype(float) * (1.0 / edge)), axis=0)
    np.testing.assert_array_equal(np.unique(_cells(memory), axis=0), expected)
    assert memory.voxels == len(memory) == len(expected)
    # Neither a second arrival nor a rebuilt index finds another voxel.
    assert memory.fuse(points(where, spacing=edge), round=0).added == 0
    memory.whole.rebuild_index()
    assert memory.voxels == len(expected)
    assert memory.fuse(points(where, spacing=edge), round=0).added == 0
    np.testing.assert_array_equal(np.unique(_cells(memory), axis=0), expected)


@settings(max_examples=30, deadline=None)
@given(edge=st.sampled_from(EDGES), seed=st.integers(0, 2**32 - 1))
def test_averages_of_points_at_a_border_do_not_cross_it(edge, seed, tmp_path_factory):
    """The mean of two points just inside rounds onto the border; the index would lose it."""
    rng = np.random.default_rng(seed)
    border = (rng.integers(-1000, 1000, (40, 3)) * edge).astype(np.float32)
    inside = np.nextafter(border, np.float32(-np.inf))
    memory = SpatialMemory(edge)
    for _ in range(3):
        memory.fuse(points(np.concatenate([inside, border]), spacing=edge), round=0)
    voxels = memory.voxels
    assert len(np.unique(_cells(memory), axis=0)) == voxels
    folder = tmp_path_factory.mktemp("border")
    memory.save(folder / "m.npz")
    loaded = SpatialMemory.load(folder / "m.npz")
    assert loaded.voxels == voxels
    assert saved_bytes(loaded, folder) == saved_bytes(memory, folder)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_points_of_one_depth_is_no_matter(seed, backend):
    """A wall of points at one depth with different colours, several to a pixel and to a voxel."""
    rng = np.random.default_rng(seed)
    count = 600
    where = np.concatenate([rng.uniform(-1, 1, (count, 2)), np.full((count, 1), 2.0)], 1)
    color = rng.integers(0, 256, (count, 3))
    trust = rng.uniform(0.1, 2, count)
    seen = []
    for order in (np.arange(count), rng.permutation(count)):
        memory = SpatialMemory(0.05)
        memory.fuse(points(where[order], colors=color[order], confidence=trust[order]), round=0)
        seen.append(memory.project(camera(), options=SplatOptions(backend=backend)))
    one, two = seen
    np.testing.assert_array_equal(one.valid, two.valid)
    np.testing.assert_allclose(one.depth[one.valid], 2, rtol=1e-6)
    np.testing.assert_allclose(one.rgb, two.rgb, atol=1.01 / 255)
    np.testing.assert_allclose(one.confidence, two.confidence, rtol=1e-4)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 4000))
def test_of_equal_depths_the_lower_index_wins_whatever_stands_between(seed, count):
    rng = np.random.default_rng(seed)
    z = rng.choice(np.array([2.0, 2.0000002, 3.0], np.float32), count)
    zero = np.zeros(count, np.float32)
    image = project_nearest(np.stack([zero, zero, z], 1), camera())
    assert image.index.max() == np.argmin(z)
    assert (image.index >= 0).sum() == 1


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [1, 50_000])
def test_all_points_in_one_pixel(count, backend):
    """Each in a voxel of its own, at depths over a decade: the nearest and its band are seen.

    The tails of thousands of kernels add up to the support of the four neighbours; no further.
    """
    rng = np.random.default_rng(5)
    z = np.sort(rng.uniform(1, 10, count))
    ray = np.array((0.5, 0.5)) / 30
    where = np.concatenate([z[:, None] * ray, z[:, None]], 1)
    memory = SpatialMemory(1e-5)
    memory.fuse(points(where, spacing=1e-5, colors=(10, 20, 30)), round=0)
    seen = memory.project(camera(), options=SplatOptions(backend=backend))
    assert finite(seen)
    assert seen.valid[0, 12, 16]
    beside = np.argwhere(seen.valid[0]) - (12, 16)
    assert np.abs(beside).sum(axis=1).max() <= (1 if count > 1 and backend != "nearest" else 0)
    assert z[0] * (1 - 1e-5) <= seen.depth[0, 12, 16] <= z[0] * 1.0501
    np.testing.assert_allclose(
        seen.rgb[seen.valid] * 255, np.tile((10, 20, 30), (len(beside), 1)), atol=0.01
    )


@pytest.mark.parametrize("degrees", [1.0, 60.0, 170.0])
@pytest.mark.parametrize("shift", [0.0, 0.5, 1e-3, 1 - 1e-3])
def test_every_part_of_a_pixel_belongs_to_one_pixel(shift, degrees):
    """A grid of one point a pixel fills the picture, wherever in the pixels the points fall."""
    f = focal(degrees)
    columns, rows = np.meshgrid(np.arange(SIZE["width"]), np.arange(SIZE["height"]))
    depth = 4.0
    x = (columns + shift - SIZE["width"] / 2) / f * depth
    y = (rows + shift - SIZE["height"] / 2) / f * depth
    xyz = [axis.ravel().astype(np.float32) for axis in (x, y, np.full(x.shape, depth))]
    image = project_nearest(np.stack(xyz, 1), camera(**SIZE, focal=f))
    number = np.arange(columns.size).reshape(columns.shape)
    wrong = image.index != number
    # On the border itself the side is that of a rounded product.
    assert wrong.sum() == 0 if shift > 0 else wrong.mean() < 0.5
    if shift == 0:
        xy, _ = camera(**SIZE, focal=f).project(np.stack(xyz, 1))
        drawn = image.index[image.index >= 0]
        rows_, columns_ = np.nonzero(image.index >= 0)
        np.testing.assert_allclose(xy[0, drawn], np.stack([columns_, rows_], 1), atol=1 + 1e-3)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("degrees", [1.0, 170.0])
@pytest.mark.parametrize("shift", [0.25, 0.5, 0.75])
def test_half_a_pixel_aside_leaves_no_hole_through_any_lens(shift, degrees, backend):
    f = focal(degrees)
    columns, rows = np.meshgrid(np.arange(SIZE["width"]) + 0.5, np.arange(SIZE["height"]) + 0.5)
    x, y = (columns - SIZE["width"] / 2) / f * 4, (rows - SIZE["height"] / 2) / f * 4
    memory = SpatialMemory(2 / f)
    where = np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)], 1)
    memory.fuse(points(where, source=camera(**SIZE, focal=f), spacing=4 / f), round=0)
    moved = camera(**SIZE, focal=f, center=(shift * 4 / f, shift * 4 / f, 0))
    seen = memory.project(moved, options=SplatOptions(backend=backend))
    assert seen.valid[0, :-1, :-1].all()
    np.testing.assert_allclose(seen.depth[seen.valid], 4, rtol=1e-6)
