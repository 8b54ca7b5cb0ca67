from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import SIZE, camera, focal, plane_view, points, saved_bytes
from reference_splat import reference_project

from gvtools.errors import MemoryFileError
from gvtools.guidance import Guidance
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.splat.cpu import FAINTEST
from gvtools.memory.splat.one_pixel import project_nearest
from gvtools.memory.store.voxel_index import MAX_VOXEL
from gvtools.ply import read_ply, write_ply

BLENDING = ("cpu", "torch")
BACKENDS = (*BLENDING, "nearest")
LARGEST = float(np.finfo(np.float32).max)
MILLION = 1_000_000
COLOR = (0, 99, 200)


def finite(guidance: Guidance) -> bool:
    """Whether no picture holds NaN or infinity, and colours stay in [0, 1] but for rounding."""
    values = (guidance.rgb, guidance.depth, guidance.confidence)
    return all(np.isfinite(v).all() for v in values) and bool((guidance.rgb <= 1 + 1e-6).all())


def _wall(confidence, **more) -> SpatialMemory:
    source = camera(**SIZE, focal=60)
    memory = SpatialMemory(0.02, **more)
    lifted = plane_view(source, 4.0, color=COLOR)
    trust = np.full(len(lifted), confidence, np.float32)
    memory.fuse(dataclasses.replace(lifted, confidence=trust), round=0)
    return memory


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("confidence", "cap"),
    [(1e-45, 100), (1.0, 100), (LARGEST, 100), (LARGEST, 1e-20), (LARGEST, 1e20)],
)
def test_any_confidence_and_cap_give_the_colour_and_the_depth(confidence, cap, backend):
    memory = _wall(confidence, options=MemoryOptions(weight_cap=cap))
    seen = memory.project(camera(**SIZE, focal=60), options=SplatOptions(backend=backend))
    assert finite(seen) and seen.valid.all()
    np.testing.assert_allclose(seen.depth, 4, rtol=1e-5)
    np.testing.assert_allclose(seen.rgb * 255, np.broadcast_to(COLOR, seen.rgb.shape), atol=1e-3)
    faintest = 0 if backend == "nearest" else FAINTEST
    known = np.float32(confidence)
    np.testing.assert_allclose(seen.confidence, np.clip(known, faintest, cap), rtol=1e-5)


def test_a_point_cloud_without_a_usable_point_is_refused(tmp_path):
    memory = SpatialMemory(0.1)
    memory.fuse(points([(0, 0, 2), (1, 0, 2), (0, 1, 2)]), round=0)
    path = tmp_path / "cloud.ply"
    export_memory_ply(memory, path)
    vertices = read_ply(path)
    vertices["confidence"] = 0
    write_ply(path, vertices)
    with pytest.raises(MemoryFileError, match="none of its 3 points has a positive"):
        SpatialMemory.from_ply(path)


@settings(max_examples=12, deadline=None)
@given(powers=st.lists(st.floats(-44.8, 38.5), min_size=2, max_size=30), seed=st.integers(0, 999))
def test_mixed_confidences_average_as_in_float64(powers, seed):
    """Weights over eighty decades in one voxel."""
    rng = np.random.default_rng(seed)
    weight = (10 ** np.array(powers)).astype(np.float32).clip(None, LARGEST)
    count = len(weight)
    where = rng.uniform((0.1, 0.1, 2.1), (0.9, 0.9, 2.9), (count, 3)).astype(np.float32)
    color = rng.integers(0, 256, (count, 3))
    memory = SpatialMemory(1.0)
    memory.fuse(points(where, colors=color, confidence=weight), round=0)
    # Powers of two keep the sums of the oracle within float64, too.
    w = weight.astype(np.float64) / float(weight.max())
    np.testing.assert_allclose(memory.positions[0], w @ where / w.sum(), rtol=1e-6)
    assert np.abs(memory.columns.colors[0] - w @ color / w.sum()).max() <= 0.5 + 1e-6
    assert memory.confidence[0] == min(weight.max(), np.float32(100))


def test_huge_confidences_saturate_within_and_across_rounds(tmp_path):
    memory = SpatialMemory(1.0)
    place = [(0.5, 0.5, 2.5)]
    for round_ in (0, 0, 1, 1, 2):
        memory.fuse(points(place, confidence=LARGEST, colors=COLOR), round=round_)
    assert memory.confidence.tolist() == [100]
    np.testing.assert_array_equal(memory.columns.colors[0], COLOR)
    seen = memory.project(camera())
    assert finite(seen)
    np.testing.assert_allclose(seen.confidence[seen.valid], 100, rtol=1e-5)
    memory.save(tmp_path / "m.npz")
    loaded = SpatialMemory.load(tmp_path / "m.npz")
    assert saved_bytes(loaded, tmp_path) == saved_bytes(memory, tmp_path)
    for round_ in (2, 1):
        memory.forget(round=round_)
    assert np.isfinite(memory.confidence).all()


@pytest.mark.parametrize("backend", BLENDING)
@pytest.mark.parametrize("depths", [1.0, 3.5, 20.0])
def test_what_only_a_far_view_saw_is_neither_lost_nor_nan(depths, backend):
    """exp(-proximity x distance) leaves float32 some four typical depths away."""
    half = np.full((SIZE["height"], SIZE["width"]), 4, np.float32)
    half[:, SIZE["width"] // 2 :] = 0
    near = camera(**SIZE, focal=60, center=(0.05, 0, 0))
    far = camera(**SIZE, focal=60, center=(0, 0, -4 * depths))
    memory = SpatialMemory(0.02)
    memory.fuse(plane_view(near, half), round=0)
    memory.fuse(plane_view(far, 4 + 4 * depths, color=COLOR), round=0)
    target = camera(**SIZE, focal=60)
    seen = memory.project(target, options=SplatOptions(backend=backend))
    reference = reference_project(memory, target)
    assert finite(seen)
    np.testing.assert_array_equal(seen.valid, reference.valid)
    np.testing.assert_allclose(seen.rgb, reference.rgb, atol=1e-5)
    np.testing.assert_allclose(seen.depth, reference.depth, rtol=1e-5)
    trust = np.where(seen.valid, np.maximum(reference.confidence, FAINTEST), 0)
    np.testing.assert_allclose(seen.confidence, trust, rtol=1e-4)


def test_a_million_points_of_one_view_in_one_voxel():
    rng = np.random.default_rng(0)
    where = rng.uniform((0.1, 0.1, 2.1), (0.9, 0.9, 2.9), (MILLION, 3)).astype(np.float32)
    color = rng.integers(0, 256, (MILLION, 3)).astype(np.uint8)
    memory = SpatialMemory(1.0)
    report = memory.fuse(points(where, colors=color, confidence=0.3), round=0)
    assert (report.added, report.merged) == (1, MILLION - 1)
    np.testing.assert_allclose(memory.positions[0], where.mean(0, dtype=np.float64), rtol=6e-8)
    np.testing.assert_array_equal(memory.columns.colors[0], np.rint(color.mean(0)))
    assert memory.confidence[0] == np.float32(0.3)


@pytest.mark.parametrize("own", [1e-30, 0.3, LARGEST])
def test_hundreds_of_equal_fusions_drift_nowhere(own):
    memory, place = SpatialMemory(1.0), np.array((0.1, 0.7, 2.3), np.float32)
    for _ in range(200):
        memory.fuse(points(place, colors=COLOR, confidence=own), round=0)
    np.testing.assert_array_equal(memory.columns.positions, [place])
    np.testing.assert_array_equal(memory.columns.colors, [COLOR])
    assert memory.confidence[0] == pytest.approx(min(200 * own, 100.0), rel=0.01)


# So wide that the widest footprint, 1.4 x 32 pixels, leaves columns of either half alone.
WIDE = {"width": 224, "height": 16, "focal": 60}


def _halves(near: float, far: float) -> np.ndarray:
    depth = np.full((WIDE["height"], WIDE["width"]), far, np.float32)
    depth[:, : WIDE["width"] // 2] = near
    return depth


@pytest.mark.parametrize("backend", BLENDING)
@pytest.mark.parametrize(("near", "far", "voxel"), [(1e-4, 5e2, 1e-4), (1.0, 1e5, 2e-2)])
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


def test_what_is_too_far_is_counted():
    source = camera(**WIDE)
    memory = SpatialMemory(1e-4)
    assert memory.reach == MAX_VOXEL * 1e-4
    report = memory.fuse(plane_view(source, _halves(1e-4, 1e6)), round=0)
    # The column beside the step is a depth edge.
    assert report.out_of_reach == (WIDE["width"] // 2 - 1) * WIDE["height"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("degrees", [1e-2, 1.0, 60.0, 170.0])
def test_a_wall_is_seen_again_through_any_lens(degrees, backend):
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


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_points_at_and_behind_the_camera_plane_leave_the_wall_as_it_is(seed, scale, backend):
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


EDGES = (0.1, 1 / 3, 0.02, 0.5, 1e-6, 7e5)


def _cells(memory: SpatialMemory) -> np.ndarray:
    return np.floor(memory.columns.positions.astype(float) * (1.0 / memory.voxel))


@settings(max_examples=60, deadline=None)
@given(
    edge=st.sampled_from(EDGES),
    corner=st.tuples(*[st.integers(-300, 300)] * 3),
    steps=st.integers(1, 40),
)
def test_points_on_borders_belong_to_one_voxel_and_stay_there(edge, corner, steps):
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


@settings(max_examples=12, deadline=None)
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


@pytest.mark.parametrize("backend", BLENDING)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_points_of_one_depth_is_no_matter(seed, backend):
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


@settings(max_examples=8, deadline=None)
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


@pytest.mark.parametrize("backend", BLENDING)
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
