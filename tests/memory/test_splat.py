from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from memory_scenes import (
    assert_equal_pictures,
    camera,
    plane_view,
    points,
    random_camera,
    random_memory,
)
from reference_splat import IMAGES, OTHERS, assert_same, reference_project

from gvtools.cameras import concatenate
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance
from gvtools.memory.back_projection import FREE_CELL
from gvtools.memory.culling import in_free_space
from gvtools.memory.projection import project
from gvtools.memory.spatial_memory import FARTHEST, STEP, SpatialMemory
from gvtools.memory.splat import torch_splatter as splat_torch
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.splat.one_pixel import project_nearest, project_open3d
from gvtools.networks.compute import named_device


@pytest.mark.parametrize(
    ("backend", "device"),
    [("cpu", "cpu"), ("torch", "cpu"), pytest.param("torch", "cuda", marks=pytest.mark.gpu)],
)
@pytest.mark.parametrize("options", OTHERS)
@pytest.mark.parametrize("seed", range(8))
def test_random_memories_look_as_the_reference_says(seed, options, backend, device):
    memory = random_memory(seed)
    options = options.replaced(backend=backend, device=device)
    target = random_camera(np.random.default_rng(100 + seed), spread=0.5)
    assert_same(
        project(memory, target, options=options), reference_project(memory, target, options)
    )


def test_the_random_memories_cover_every_case():
    """Holes, generated pixels and occluders occur, so that the comparison means something."""
    covered, made, let_through = [], 0, 0
    for seed in range(8):
        memory = random_memory(seed)
        target = random_camera(np.random.default_rng(100 + seed), spread=0.5)
        seen = project(memory, target)
        plain = project(memory, target, options=SplatOptions(occluders=False))
        covered.append(seen.coverage)
        assert (seen.valid == plain.valid).all()
        made += int(seen.generated.sum())
        let_through += int((seen.depth < plain.depth - 1e-3).sum())
    assert min(covered) < 0.7 < max(covered)
    assert made > 50
    assert let_through > 50


def by_threads(draw: Callable[[], object]) -> list:
    """What is drawn by one, two and all threads."""
    threads, results = numba.get_num_threads(), []
    try:
        for count in sorted({1, min(2, threads), threads}):
            numba.set_num_threads(count)
            results.append(draw())
    finally:
        numba.set_num_threads(threads)
    return results


@pytest.mark.parametrize("seed", [1, 6])
def test_the_number_of_threads_changes_nothing(seed):
    memory = random_memory(seed, most=2000)
    target = random_camera(np.random.default_rng(seed)).resized(64, 200)
    first, *others = by_threads(lambda: project(memory, target))
    for other in others:
        assert_equal_pictures(first, other)
    cloud = np.random.default_rng(seed).uniform((-3, -3, -1), (3, 3, 6), (50_000, 3))
    first, *others = by_threads(lambda: project_nearest(cloud.astype(np.float32), target))
    for other in others:
        np.testing.assert_array_equal(first.index, other.index)
        np.testing.assert_array_equal(first.depth, other.depth)


def test_generated_content_never_outranks_observed_content():
    """Whatever generated views add, the pixels that observed views fill stay as they are."""
    target = camera(width=64, height=48, focal=60)
    observed = plane_view(camera(width=64, height=48, focal=60, center=(0.3, 0, 0)), 3.0)
    # Nothing is known to be free: fusion lets the points in.
    observed = replace(observed, free_depth=None)
    for depth in (1.5, 2.98, 4.0):
        memory = SpatialMemory(0.05)
        memory.fuse(observed, round=0)
        before = project(memory, target)
        made = plane_view(target, depth, color=(0, 255, 0))
        assert memory.fuse(made, round=1, generated=True).added > 0
        after = project(memory, target)
        kept = before.valid
        assert 0.5 < kept.mean() < 1
        for name in ("rgb", "depth", "confidence"):
            np.testing.assert_array_equal(getattr(after, name)[kept], getattr(before, name)[kept])
        assert not after.generated[kept].any()
        assert after.valid.all()
        assert after.generated[~kept].all()
        np.testing.assert_allclose(after.depth[~kept], depth, rtol=0.02)


def _square_before_wall(source):
    """Depth and colour of a red square at z = 2 before a blue wall at z = 4."""
    rays = source.rays()
    square = (abs(2 * rays[..., 0]) <= 0.4) & (abs(2 * rays[..., 1]) <= 0.4)
    depth = np.where(square, 2.0, 4.0).astype(np.float32)
    rgb = np.where(square[..., None], (255, 0, 0), (0, 0, 255)).astype(np.uint8)
    return depth, rgb


MOVES = {"sideways": (0.31, 0, 0), "forward 0.8": (0, 0, 0.8), "forward 1.4": (0, 0, 1.4)}


def silhouette_shares(
    move, voxels: float, *, scale=1, options: SplatOptions | None = None
) -> dict[str, float]:
    """What is wrong after a move, against the analytic scene.

    hole: share of the pixels that the source saw and that are left open; bleed: share of the
    square that shows the wall; false: share of the never seen pixels that are valid; fattening and
    growth: by how many voxels the square grew over the wall, and the wall into the unseen. The
    outermost two source pixels of either side are dropped as depth edges and are no hole.

    Args:
        move: of the target camera.
        voxels: voxel edge, in pixels of the wall.
        scale: image size, 1 for 320 x 240.
        options: of the projection.
    """
    focal = 250 * scale
    voxel = voxels * 4 / focal
    size = {"width": 320 * scale, "height": 240 * scale, "focal": focal}
    depth, rgb = _square_before_wall(camera(**size))
    memory = SpatialMemory(voxel)
    memory.fuse(plane_view(camera(**size), depth, color=rgb), round=0)
    target = camera(**size, center=move)
    seen = project(memory, target, options=options)
    valid, red = seen.valid[0], seen.rgb[0, ..., 0] > 0.5
    center = np.asarray(move, float)
    rays = target.rays()
    square = (abs(center + rays * (2 - center[2])) <= 0.4)[..., :2].all(-1)
    world = center + rays * (np.where(square, 2.0, 4.0) - center[2])[..., None]
    source_ray = world[..., :2] / world[..., 2:]
    inside = (abs(source_ray) < (0.63, 0.47)).all(-1)
    # What the source's ray to a wall point passes at z = 2: within the square, it is hidden.
    at_square = abs(2 * source_ray).max(-1)
    edge = 4 / focal
    hidden = ~square & (at_square <= 0.4)
    core = square & (at_square < 0.4 - edge)
    known = inside & (core | ~square & (at_square > 0.4 + edge))
    false = hidden & valid & ~red
    fat = ~square & valid & red
    # A strip one voxel wide around the square, and beside the strip of wall that it hid.
    strip = 4 * 0.8 * voxel * (focal / (2 - center[2])) ** 2
    beside = 2 * 0.8 * (4 - center[2]) / 2 * voxel * (focal / (4 - center[2])) ** 2
    return {
        "hole": float((known & ~valid).sum() / known.sum()),
        "bleed": float((core & valid & ~red).sum() / core.sum()),
        "false": float(false.sum() / max(1, hidden.sum())),
        "fattening": float(fat.sum() / strip),
        "growth": float(false.sum() / beside),
    }


@pytest.mark.parametrize("voxels", [0.5, 1, 2, 4])
@pytest.mark.parametrize("move", MOVES)
def test_silhouettes_do_not_grow_and_let_nothing_through(move, voxels):
    # The widest footprint here is that of 4-pixel voxels from 0.6 before the square: 27 pixels.
    shares = silhouette_shares(MOVES[move], voxels, options=SplatOptions(max_splat_px=32))
    assert shares["hole"] < 1e-3
    assert shares["bleed"] < 1e-3
    assert shares["fattening"] < 0.5
    assert shares["growth"] < 1.0


def _scene_with_a_far_witness(saw_through: bool, center=(0.9, 0, 0.3), scale=1.0):
    """A near view that misses an object which a far view saw; the near view may rule it out."""
    size = {"width": round(64 * scale), "height": round(48 * scale), "focal": 60 * scale}
    target = camera(**size)
    near = camera(**size, center=(0.02, 0, 0), name="near")
    witness = camera(**size, center=center, name="witness")
    wall = plane_view(near, 4.0, color=(0, 0, 255))
    if not saw_through:
        wall = replace(wall, free_depth=None)
    grid = np.linspace(-0.3, 0.3, 40)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    thing = points(
        np.stack([x, y, np.full(x.size, 2.0)], 1), source=witness, colors=(255, 0, 0), spacing=0.03
    )
    memory = SpatialMemory(0.02)
    memory.fuse(wall, round=0)
    memory.fuse(thing, round=0)
    return memory, target


# From 40 away the weight beside the nearest view's is below every float32.
@pytest.mark.parametrize("center", [(0.9, 0, 0.3), (0, 0, -40)])
@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_an_object_that_only_a_far_view_saw_is_let_through(center, backend):
    memory, target = _scene_with_a_far_witness(False, center)
    options = SplatOptions(nearest_views=1, backend=backend, device="cpu")
    seen = project(memory, target, options=options)
    rays = target.rays()
    thing = (abs(2 * rays[..., :2]) < 0.27).all(-1)
    around = (abs(2 * rays[..., :2]) > 0.35).any(-1)
    assert thing.sum() > 150
    assert (seen.rgb[0, ..., 0] > 0.9)[thing].all()
    np.testing.assert_allclose(seen.depth[0][thing], 2, rtol=1e-5)
    assert (seen.rgb[0, ..., 0] == 0)[around].all()
    unseen = project(memory, target, options=options.replaced(occluders=False))
    assert (unseen.rgb[0, ..., 0] == 0).all()


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_in_one_tier_the_z_buffer_alone_decides(backend):
    """As the paper projects: what is nearest shows, whichever view saw it and whatever it saw."""
    memory, target = _scene_with_a_far_witness(saw_through=True)
    options = SplatOptions(
        nearest_views=None, view_weight=0, occluders=False, backend=backend, device="cpu"
    )
    seen = project(memory, target, options=options)
    thing = (abs(2 * target.rays()[..., :2]) < 0.27).all(-1)
    assert (seen.rgb[0, ..., 0] > 0.9)[thing].all()
    np.testing.assert_allclose(seen.depth[0][thing], 2, rtol=1e-5)
    assert_same(seen, reference_project(memory, target, options))


@pytest.mark.parametrize("case", OTHERS)
@pytest.mark.parametrize("saw_through", [False, True])
def test_the_reference_agrees_about_occluders(saw_through, case):
    memory, target = _scene_with_a_far_witness(saw_through, scale=0.5)
    assert_same(project(memory, target, options=case), reference_project(memory, target, case))


def _blank(guidance: Guidance) -> bool:
    return not any(getattr(guidance, name).any() for name in IMAGES)


@pytest.mark.parametrize("backend", ["cpu", "torch", "nearest", "open3d"])
def test_what_holds_nothing_in_view_gives_empty_images(backend):
    options = SplatOptions(backend=backend)
    target = camera()
    assert _blank(SpatialMemory(0.1).project(target, options=options))
    behind = SpatialMemory(0.1)
    behind.fuse(points([(0, 0, -2), (0.1, 0.2, -3)]), round=0)
    assert _blank(behind.project(target, options=options))


@pytest.mark.parametrize("backend", ["cpu", "torch", "nearest", "open3d"])
def test_an_image_of_one_pixel(backend):
    memory = SpatialMemory(0.1)
    memory.fuse(points([(0, 0, 2)], colors=(255, 51, 0), confidence=0.7), round=0)
    seen = memory.project(camera(width=1, height=1), options=SplatOptions(backend=backend))
    assert seen.valid.shape == (1, 1, 1)
    np.testing.assert_allclose(seen.rgb[0, 0, 0], (1, 0.2, 0), atol=1e-6)
    assert seen.depth[0, 0, 0] == pytest.approx(2)
    assert seen.confidence[0, 0, 0] == pytest.approx(0.7)


def test_views_of_a_batch_are_those_of_single_cameras():
    memory = random_memory(3)
    rng = np.random.default_rng(5)
    cameras = concatenate([random_camera(rng, name=f"t{i}") for i in range(3)])
    batch = project(memory, cameras)
    assert len(batch) == 3
    for i, one in enumerate(cameras):
        assert_equal_pictures(batch[i], project(memory, one))


def test_cameras_of_several_sizes_are_refused():
    cameras = concatenate([camera(name="a"), camera(width=31, name="b")])
    with pytest.raises(ShapeError, match="2 image sizes"):
        project(random_memory(0), cameras)
    with pytest.raises(ShapeError, match="0 image sizes"):
        project(random_memory(0), cameras[:0])


@pytest.mark.parametrize("backend", ["nearest", "open3d"])
def test_one_pixel_back_ends_show_the_nearest_observation(backend):
    memory = random_memory(9, views=5)
    target = camera(rotation=(0.1, -0.1, 0.2))
    seen = memory.project(target, options=SplatOptions(backend=backend))
    xy, z = target.project(memory.positions)
    column, row = np.floor(xy[0]).T
    best: dict[tuple[int, int], int] = {}
    for i in np.argsort(-z[0]):
        if z[0, i] > 0 and 0 <= column[i] < 32 and 0 <= row[i] < 24:
            best[int(row[i]), int(column[i])] = i
    assert seen.valid.sum() == len(best)
    assert len(best) > 100
    for (r, c), i in best.items():
        assert seen.depth[0, r, c] == pytest.approx(z[0, i], rel=1e-5)
        np.testing.assert_allclose(seen.rgb[0, r, c] * 255, memory.columns.colors[i], atol=1e-3)
        assert seen.confidence[0, r, c] == memory.confidence[i]
        assert seen.generated[0, r, c] == memory.generated[i]


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def project_torch(memory, cameras, *, options=None, device="auto"):
    options = (options or SplatOptions()).replaced(backend="torch", device=device)
    return project(memory, cameras, options=options)


def _target(seed: int):
    return random_camera(np.random.default_rng(100 + seed), spread=0.5)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("seed", [4, 7])
def test_a_larger_image_equals_the_compiled_back_end(seed, device):
    memory = random_memory(seed, most=300)
    cameras = concatenate([_target(seed).resized(160, 120), _target(seed + 1).resized(160, 120)])
    ours = project_torch(memory, cameras, device=device)
    assert ours.coverage > 0.1
    assert_same(ours, project(memory, cameras))


def test_cutting_the_work_into_parts_changes_nothing_but_rounding(monkeypatch):
    memory = random_memory(6)
    whole = project_torch(memory, _target(6), device="cpu")
    monkeypatch.setitem(splat_torch.PAIRS, "cpu", 100)
    parts = project_torch(memory, _target(6), device="cpu")
    assert whole.coverage > 0.3
    for name in IMAGES:
        np.testing.assert_allclose(
            getattr(parts, name).astype(float), getattr(whole, name).astype(float), atol=1e-5
        )


def test_cuda_is_refused_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(OptionError, match="no CUDA device"):
        project_torch(random_memory(1), _target(1), device="cuda")
    assert named_device("auto", option="").type == named_device("cpu", option="").type == "cpu"


def test_skew_is_honoured_here_and_refused_for_open3d():
    cloud = np.array([(0, 0.5, 2)], np.float32)
    target = camera(skew=8.0)
    image = project_nearest(cloud, target)
    (xy,), _ = target.project(cloud)
    assert image.index[tuple(np.floor(xy[0, ::-1]).astype(int))] == 0
    with pytest.raises(OptionError, match="ignores skew and K has 8 px"):
        project_open3d(cloud, target)


def test_the_winners_colours_come_along():
    rng = np.random.default_rng(5)
    cloud = rng.uniform((-1, -1, 1), (1, 1, 3), (500, 3)).astype(np.float32)
    colors = rng.integers(1, 255, (500, 3)).astype(np.uint8)
    image = project_nearest(cloud, camera(), colors=colors)
    seen = image.index >= 0
    assert seen.any()
    assert not seen.all()
    assert image.colors is not None
    np.testing.assert_array_equal(image.colors[seen], colors[image.index[seen]])
    assert not image.colors[~seen].any()


def _view(source, grid):
    return source.K[0], source.cam_from_world[0], grid


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("tolerance", [0.0, 0.03, 0.3])
def test_points_in_front_of_a_cell_by_the_margin_are_in_free_space(seed, tolerance):
    rng = np.random.default_rng(seed)
    where = rng.uniform((-3, -3, -1), (3, 3, 6), (2000, 3)).astype(np.float32)
    sources = [random_camera(rng, spread=0.5) for _ in range(3)]
    grids = [rng.uniform(-1, 6, (6, 8)).clip(0).astype(np.float32) for _ in sources]
    expected = np.zeros(len(where), bool)
    for source, grid in zip(sources, grids, strict=True):
        xy, z = source.project(where)
        for i in np.flatnonzero(z[0] > 0):
            column, row = np.floor(xy[0, i] / FREE_CELL).astype(int)
            if 0 <= row < 6 and 0 <= column < 8:
                expected[i] |= z[0, i] < grid[row, column] * (1 - tolerance)
    views = [_view(*pair) for pair in zip(sources, grids, strict=True)]
    found = in_free_space(where, views, tolerance=tolerance)
    assert 0.02 < expected.mean() < 0.9
    np.testing.assert_array_equal(found, expected)


def test_no_view_and_no_grid_free_nothing():
    where = np.array([(0, 0, 2)], np.float32)
    assert not in_free_space(where, [], tolerance=0.0).any()
    nothing = np.zeros((0, 0), np.float32)
    assert not in_free_space(where, [_view(camera(), nothing)], tolerance=0.0).any()


def test_what_moves_back_along_its_rays_is_taken_by_fusion():
    source = camera(width=64, height=48, focal=60)
    beside = camera(width=64, height=48, focal=60, center=(0.5, 0, 0))
    memory = SpatialMemory(0.05)
    grey, wall = np.full((48, 64, 3), 128, np.uint8), np.full((48, 64), 4, np.float32)
    memory.observe(grey, wall, source, round=0)
    some = np.tile(np.array([2, 3, 4.1, 4 * 0.96 / FARTHEST / STEP], np.float32), (48, 16))
    away = memory.behind_free_space(some, source, where=some > 0)
    limit = 4 * 0.97
    for columns in (away[:, 0::4], away[:, 1::4]):
        assert ((columns >= limit) & (columns < limit * STEP)).all()
    # Behind the wall already; free for as far as is tried; out of the view.
    assert (away[:, 2::4] == some[:, 2::4]).all() and not away[:, 3::4].any()
    elsewhere = camera(width=64, height=48, focal=60, center=(9, 0, 0))
    np.testing.assert_array_equal(memory.behind_free_space(some, elsewhere, where=some > 0), some)
    made = np.full((48, 64), 3, np.float32)
    where = np.ones(made.shape, bool)
    moved = memory.behind_free_space(made, beside, where=where)
    assert moved.min() >= 3
    rejected = memory.observe(grey, moved, beside, round=1, generated=True).rejected_free
    assert rejected == 0
    assert memory.observe(grey, made, beside, round=1, generated=True).rejected_free > 1000
    untouched = memory.behind_free_space(made, beside, where=~where)
    np.testing.assert_array_equal(untouched, made)
