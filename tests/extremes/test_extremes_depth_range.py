"""Near and far in one picture, narrow and wide lenses, and what stands at the camera plane."""

from __future__ import annotations

import numpy as np
import pytest
from extreme_scenes import SIZE, finite, focal, share_that_differs
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import camera, plane_view, points
from reference_splat import reference_project

from gvtools.memory.back_projection import BackProjectionOptions, back_project
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.store.voxel_index import MAX_VOXEL

BLENDING = ("cpu", "torch")
BACKENDS = (*BLENDING, "nearest")


# So wide that the widest footprint, 1.4 x 32 pixels, leaves columns of either half alone.
WIDE = {"width": 224, "height": 16, "focal": 60}


def _halves(near: float, far: float) -> np.ndarray:
    """A near wall on the left of the picture, a far one on the right."""
    depth = np.full((WIDE["height"], WIDE["width"]), far, np.float32)
    depth[:, : WIDE["width"] // 2] = near
    return depth


@pytest.mark.parametrize("backend", BLENDING)
@pytest.mark.parametrize(
    ("near", "far", "voxel"),
    [(1e-4, 50, 1e-5), (1e-4, 5e2, 1e-4), (1e-2, 5e4, 1e-2), (1.0, 5e4, 1e-2), (1.0, 1e5, 2e-2)],
)
def test_seven_decades_of_depth_in_one_picture(near, far, voxel, backend):
    """From one voxel to as far as voxels go; the typical depth is the far wall's."""
    source = camera(**WIDE)
    memory = SpatialMemory(voxel)
    report = memory.fuse(plane_view(source, _halves(near * 1.5, far)), round=0)
    assert report.out_of_reach == 0
    seen = memory.project(source, options=SplatOptions(backend=backend))
    assert finite(seen)
    middle = WIDE["width"] // 2
    # The near wall is a few voxels wide where these are as large as its depth.
    for columns, depth in ((slice(middle - 2, middle), near * 1.5), (slice(-60, -4), far)):
        valid = seen.valid[0, 6:10, columns]
        assert valid.any()
        np.testing.assert_allclose(seen.depth[0, 6:10, columns][valid], depth, rtol=1e-5)
    assert seen.valid[0, 2:-2, -60:-4].all()


@pytest.mark.parametrize("backend", BLENDING)
def test_what_is_nearer_than_a_voxel_is_left_open_and_not_misdrawn(backend):
    """The documented end of the range: the camera stands inside the voxel."""
    source = camera(**WIDE)
    memory = SpatialMemory(1e-2)
    memory.fuse(plane_view(source, _halves(1e-4, 5e4)), round=0)
    seen = memory.project(source, options=SplatOptions(backend=backend))
    assert seen.depth[seen.valid].min() == pytest.approx(5e4, rel=1e-5)
    assert not seen.valid[0, :, : WIDE["width"] // 2 - 4].any()


def test_what_is_too_far_is_counted_and_wide_voxels_go_farther():

    source = camera(**WIDE)
    memory = SpatialMemory(1e-4)
    assert memory.reach == MAX_VOXEL * 1e-4
    report = memory.fuse(plane_view(source, _halves(1e-4, 1e6)), round=0)
    # The column beside the step is a depth edge.
    assert report.out_of_reach == (WIDE["width"] // 2 - 1) * WIDE["height"]
    memory = SpatialMemory(1e-4)
    assert memory.fuse(plane_view(source, _halves(1e-4, 5e4)), round=0).out_of_reach == 0
    seen = memory.project(source)
    assert finite(seen)
    np.testing.assert_allclose(seen.depth[0, 2:-2, -60:-4], 5e4, rtol=1e-5)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), decades=st.floats(0, 3))
def test_random_depths_look_as_float64_says(seed, decades):
    rng = np.random.default_rng(seed)
    source = camera()
    depth = 10 ** rng.uniform(0, decades, 400)
    ray = rng.uniform((-0.5, -0.4), (0.5, 0.4), (400, 2))
    where = np.concatenate([ray, np.ones((400, 1))], 1) * depth[:, None]
    memory = SpatialMemory(2.0**-8)
    fresh = points(
        where, source=source, colors=rng.integers(0, 256, (400, 3)), spacing=depth / 30,
        confidence=rng.uniform(0.1, 1, 400),
    )  # fmt: skip
    memory.fuse(fresh, round=0)
    seen = memory.project(source)
    assert seen.coverage > 0.3
    # A rounded centre tips a pixel in or out of a footprint here and there.
    assert share_that_differs(seen, reference_project(memory, source)) <= 4e-3


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("degrees", [1e-2, 1.0, 60.0, 170.0])
def test_a_wall_is_seen_again_through_any_lens(degrees, backend):
    """Back-projected, fused and projected into the camera that saw it."""
    source = camera(**SIZE, focal=focal(degrees))
    spacing = 4 / focal(degrees)
    memory = SpatialMemory(spacing / 2)
    lifted = plane_view(source, 4.0)
    assert len(lifted) == SIZE["width"] * SIZE["height"]
    assert memory.fuse(lifted, round=0).merged == 0
    seen = memory.project(source, options=SplatOptions(backend=backend))
    assert seen.valid.all()
    np.testing.assert_allclose(seen.depth, 4, rtol=1e-6)
    np.testing.assert_allclose(
        seen.rgb * 255, np.broadcast_to((200, 100, 50), seen.rgb.shape), atol=1e-3
    )


@pytest.mark.parametrize(
    ("degrees", "off"), [(0.1, 0.02), (1.0, 3e-4), (60.0, 1e-5), (170.0, 1e-5)]
)
def test_the_cosine_of_a_slant_holds_to_float32_depth(degrees, off):
    """The slope between neighbours is the last bits of their depths when the lens is narrow."""
    source = camera(**SIZE, focal=focal(degrees))
    normal = np.array((0.3, 0.1, 1)) / np.linalg.norm((0.3, 0.1, 1))
    depth = 3 / (source.rays() @ normal)
    usable = np.where((depth > 0) & (depth < 100), depth, 0).astype(np.float32)
    rgb = np.zeros((*usable.shape, 3), np.uint8)
    rgb[..., 0], rgb[..., 1] = np.mgrid[: SIZE["height"], : SIZE["width"]]
    options = BackProjectionOptions(grazing=0, edge=10)
    lifted = back_project(rgb, usable, source, options=options)
    rows, columns = lifted.colors[:, 0].astype(int), lifted.colors[:, 1].astype(int)
    rays = source.rays()[rows, columns]
    expected = rays @ normal / np.linalg.norm(rays, axis=1)
    assert len(lifted) > 1500
    assert np.abs(lifted.confidence - expected).max() < off
    np.testing.assert_allclose(lifted.positions.astype(float) @ normal, 3, rtol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_points_at_and_behind_the_camera_plane_leave_the_wall_as_it_is(seed, scale, backend):
    """Zero, tiny and negative depths, beside and at the centre of projection."""
    rng = np.random.default_rng(seed)
    z = rng.choice([0.0, -0.0, -1e-30, 1e-30, -1e-3, -50.0], 40)
    beside = rng.choice([0.0, 1e-9, 0.3, -2.0], (40, 2))
    source = camera(**SIZE, focal=60)
    wall = plane_view(camera(**SIZE, focal=60), 4 * scale)
    memory = SpatialMemory(0.02 * scale)
    memory.fuse(wall, round=0)
    before = memory.project(source, options=SplatOptions(backend=backend))
    bad = np.concatenate([beside, z[:, None]], 1) * scale
    memory.fuse(points(bad, source=source, spacing=0.05 * scale, colors=(0, 255, 0)), round=0)
    seen = memory.project(source, options=SplatOptions(backend=backend))
    for name in ("valid", "rgb", "depth"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(before, name))


@pytest.mark.parametrize("backend", BLENDING)
def test_a_box_that_touches_the_camera_plane_hides_nothing(backend):
    """One run with a corner a rounding error before the plane: columns beyond every integer."""
    memory = SpatialMemory(1.0)
    where = [(0.1, 0.1, 1e-30), (0.4, 0.2, 0.5), (0.1, 0.3, 0.9)]
    memory.fuse(points(where, spacing=0.5), round=0)
    memory.fuse(points([(2.5, 2.5, 20.5)], spacing=0.5, colors=(1, 2, 3)), round=0)
    for width in (64, 4096):
        seen = memory.project(
            camera(width=width, height=48, focal=60), options=SplatOptions(backend=backend)
        )
        assert finite(seen)
        assert seen.valid.any()
