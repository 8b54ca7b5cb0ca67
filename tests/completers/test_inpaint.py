from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage
from skimage.restoration import inpaint_biharmonic
from walls import blotches, camera_at, cast, photograph

from gvtools.cameras import Cameras, concatenate, invert_rigid, rigid_poses, rigid_transform
from gvtools.completers import ContextView, create
from gvtools.completers.hole_depth import fill_depth
from gvtools.completers.push_pull import push_pull, push_pull_depth
from gvtools.completers.surface_fill import AVERAGED, CARRIED, surface_fill
from gvtools.guidance import Guidance

pytestmark = pytest.mark.usefixtures("one_thread")

HEIGHT, WIDTH, FOCAL = 120, 160, 150.0


def camera(x: float = 0.0) -> Cameras:
    """Looks along z from (x, 0, 0)."""
    pose = rigid_poses(np.eye(3), (-x, 0, 0))
    return Cameras.pinhole(WIDTH, HEIGHT, focal=FOCAL, cam_from_world=pose, name=f"{x:g}")


def wall_view(x: float = 0.0, *, stripes: float = 9.0) -> tuple[np.ndarray, np.ndarray]:
    """rgb and depth of a striped, slanted wall z = 4 - 0.3 X seen by ``camera(x)``."""
    cam = camera(x)
    rays = cam.rays()
    z = (4 - 0.3 * x) / (1 + 0.3 * rays[..., 0])
    points = rays * z[..., None] + cam.centers[0]
    phase = stripes * points[..., 0]
    shade = 0.5 + 0.4 * np.sin(phase) * np.cos(0.7 * stripes * points[..., 1])
    rgb = np.stack([shade, 0.2 + 0.0 * shade, 0.9 - 0.5 * shade], axis=-1)
    return rgb.astype(np.float32), z.astype(np.float32)


def guidance(rgb: np.ndarray, depth: np.ndarray, valid: np.ndarray, cam: Cameras) -> Guidance:
    """One view of projected memory, empty outside ``valid``."""
    return Guidance(
        cam,
        np.where(valid[..., None], rgb, 0).astype(np.float32)[None],
        np.where(valid, depth, 0).astype(np.float32)[None],
        valid[None],
        valid.astype(np.float32)[None],
        np.zeros_like(valid)[None],
    )


def psnr(estimate: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    """Peak signal-to-noise ratio over some pixels, peak 1."""
    return float(-10 * np.log10(np.mean((estimate - truth)[where] ** 2)))


def kitchen_view(folder: Path, frame: int) -> ContextView:
    """A real RGB-D frame."""
    from skimage.io import imread

    stem = folder / f"frame-{frame:06d}"
    pose, _ = rigid_transform(np.loadtxt(f"{stem}.pose.txt"), what=str(stem))
    K = np.array([[[522.9, 0, 318.4], [0, 522.9, 235.0], [0, 0, 1]]])
    depth = imread(f"{stem}.depth.png").astype(np.float32) / 1000
    rgb = imread(f"{stem}.color.jpg").astype(np.float32) / 255
    cam = Cameras.alike(K, invert_rigid(pose), size=(640, 480), names=(stem.name,))
    return ContextView(stem.name, cam, rgb, np.where(depth < 60, depth, 0))


def warp(source: ContextView, target: Cameras) -> Guidance:
    """The source's points in the target's pixels: nearest wins, each covers 2x2 pixels."""
    depth = source.depth
    assert depth is not None
    low = ndimage.minimum_filter(np.where(depth > 0, depth, np.inf), 3)
    flat = (depth > 0) & (ndimage.maximum_filter(depth, 3) - low < 0.05 * depth)
    world = (source.camera.rays() * depth[..., None])[flat] @ source.camera.world_from_cam[
        0, :3, :3
    ].T + source.camera.centers[0]
    xy, z = (part[0] for part in target.project(world))
    height, width = int(target.height[0]), int(target.width[0])
    far = np.full(height * width, np.inf)
    rgb = np.zeros((height * width, 3), np.float32)
    order = np.argsort(-z, kind="stable")
    order = order[z[order] > 0]
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = np.floor(xy[order] - 0.5 + step).astype(np.int64).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel, point = (row * width + column)[inside], order[inside]
        winner = np.full(height * width, -1)
        winner[pixel] = point
        hit = np.flatnonzero(winner >= 0)
        hit = hit[z[winner[hit]] < 0.98 * far[hit]]
        far[hit], rgb[hit] = z[winner[hit]], source.rgb[flat][winner[hit]]
    valid = np.isfinite(far).reshape(height, width)
    shape = (height, width)
    return guidance(rgb.reshape(*shape, 3), far.reshape(shape), valid, target)


def _hole(*windows) -> np.ndarray:
    valid = np.ones((HEIGHT, WIDTH), bool)
    for window in windows:
        valid[window] = False
    return valid


def _square_before_wall():
    """The wall, what is seen of it behind a near blue square, and a hole at the square's right."""
    rgb, depth = wall_view(stripes=0.5)
    seen, near = rgb.copy(), depth.copy()
    seen[35:85, 40:80], near[35:85, 40:80] = (0.0, 0.0, 1.0), 1.5
    return rgb, depth, seen, near, _hole(np.s_[35:85, 80:105])


def test_valid_pixels_come_back_bit_for_bit():
    rgb, depth = wall_view()
    valid = np.random.default_rng(0).random(depth.shape) < 0.7
    given = guidance(rgb, depth, valid, camera())
    result = create("inpaint").complete([], given)
    assert result.rgb[given.valid].tobytes() == given.rgb[given.valid].tobytes()
    assert result.depth[given.valid].tobytes() == given.depth[given.valid].tobytes()
    assert np.array_equal(result.confidence[given.valid], given.confidence[given.valid])


def test_a_hidden_wall_gets_the_walls_depth_and_colour():
    rgb, depth, seen, near, valid = _square_before_wall()
    result = create("inpaint").complete([], guidance(seen, near, valid, camera()))
    np.testing.assert_allclose(result.depth[0][~valid], depth[~valid], rtol=1e-5)
    assert psnr(result.rgb[0], rgb, ~valid) > 30
    biharmonic = inpaint_biharmonic(np.where(valid[..., None], seen, 0), ~valid, channel_axis=-1)
    assert psnr(result.rgb[0], rgb, ~valid) > psnr(biharmonic, rgb, ~valid) + 8
    # Right beside the square, where a leak would show first.
    assert np.abs(result.rgb[0] - rgb)[36:84, 80].max() < 0.1


def test_nothing_known_is_left_empty():
    rgb, depth = wall_view()
    empty = np.zeros((HEIGHT, WIDTH), bool)
    few = empty.copy()
    few[60, 80:90] = True
    for valid in (empty, few):
        result = create("inpaint").complete([], guidance(rgb, depth, valid, camera()))
        assert not result.depth[0][~valid].any()
        assert not result.confidence[0][~valid].any()
        assert not result.rgb[0][~valid].any()


def test_confidence_falls_with_distance_and_with_the_size_of_the_hole():
    rgb, depth = wall_view()
    valid = _hole(np.s_[10:20, 10:20], np.s_[40:100, 40:120])
    confidence = create("inpaint").complete([], guidance(rgb, depth, valid, camera())).confidence[0]
    assert (confidence[valid] == 1).all()
    assert (confidence[~valid] > 0).all() and (confidence[~valid] < 1).all()
    row = confidence[70, 40:80]
    assert (np.diff(row[:30]) < 0).all()
    assert confidence[10, 15] > confidence[40, 80]


def test_reach_leaves_what_is_farther_empty():
    rgb, depth = wall_view()
    valid = _hole(np.s_[20:100, 40:120])
    result = create("inpaint", reach=0.05).complete([], guidance(rgb, depth, valid, camera()))
    distance = ndimage.distance_transform_edt(~valid)
    assert np.array_equal(result.depth[0] > 0, distance <= 0.05 * np.hypot(HEIGHT, WIDTH))


@pytest.fixture(scope="module")
def holed() -> tuple[np.ndarray, np.ndarray, Guidance]:
    """The wall's picture, a hole in its middle, and both as guidance; not to be changed."""
    rgb, depth = wall_view()
    valid = _hole(np.s_[40:80, 55:105])
    return rgb, ~valid, guidance(rgb, depth, valid, camera())


def test_photographs_give_the_texture_that_no_depth_covers(holed):
    rgb, hole, given = holed
    side_rgb, side_depth = wall_view(0.1)
    # The photograph shows the place, its sensor does not.
    side_depth[25:95, 30:130] = 0
    context = [ContextView("side", camera(0.1), side_rgb, side_depth)]
    with_it, without = (
        psnr(create("inpaint", context_views=count).complete(context, given).rgb[0], rgb, hole)
        for count in (4, 0)
    )
    assert with_it > 25
    assert with_it > without + 10


RED = np.zeros((HEIGHT, WIDTH, 3), np.float32)
RED[..., 0] = 1


def test_a_photograph_of_another_surface_is_not_used(holed):
    given = holed[2]
    context = [ContextView("blocked", camera(0.1), RED, np.ones((HEIGHT, WIDTH), np.float32))]
    without = create("inpaint").complete([], given)
    blocked = create("inpaint").complete(context, given)
    assert np.array_equal(blocked.rgb, without.rgb)


def test_a_photograph_that_disagrees_with_two_others_is_outvoted(holed):
    rgb, hole, given = holed
    unknown = np.zeros((HEIGHT, WIDTH), np.float32)
    honest = [ContextView(f"{x}", camera(x), wall_view(x)[0], unknown) for x in (-0.1, 0.1)]
    liar = ContextView("liar", camera(0.02), RED, unknown)
    result = create("inpaint").complete([*honest, liar], given)
    assert psnr(result.rgb[0], rgb, hole) > 20


@pytest.mark.data
@pytest.mark.parametrize(("source", "target"), [(500, 510), (200, 210)])
def test_real_frames_are_filled_better_than_by_the_nearest_pixel(shared, source, target):
    folder = shared / "data" / "sevenscenes_reg"
    context, truth = kitchen_view(folder, source), kitchen_view(folder, target)
    given = warp(context, truth.camera)
    assert truth.depth is not None
    real, hole = truth.depth, ~given.valid[0]
    where = tuple(ndimage.distance_transform_edt(hole, return_distances=False, return_indices=True))
    measured = hole & (real > 0)

    def depth_error(depth: np.ndarray) -> float:
        return float(np.median(np.abs(depth / np.maximum(real, 1e-9) - 1)[measured]))

    result = create("inpaint").complete([context], given)
    assert psnr(result.rgb[0], truth.rgb, hole) > psnr(given.rgb[0][where], truth.rgb, hole) + 2
    assert depth_error(result.depth[0]) < 0.7 * depth_error(given.depth[0][where])


def _grid() -> np.ndarray:
    return np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)


def _fill(inverse: np.ndarray, valid: np.ndarray, **options):
    depth = np.where(valid, 1 / inverse, 0).astype(np.float32)
    return fill_depth(depth, valid, focal=FOCAL, **options)


def _wall_with_square():
    """Inverse depth of a near square before a slanted wall, and a hole at the square's right."""
    y, x = _grid()
    wall = 0.25 + 0.0004 * x + 0.0002 * y
    seen = wall.copy()
    square = np.s_[35:85, 40:80]
    seen[square] = 0.6
    return wall, seen, _hole(np.s_[35:85, 80:105])


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.0008, -0.0005), (-0.0006, 0.0009)])
@pytest.mark.parametrize(
    "window", [np.s_[40:80, 50:110], np.s_[:, 130:], np.s_[90:, :40], np.s_[:15, :]]
)
def test_a_plane_is_continued_exactly(slope, window):
    y, x = _grid()
    plane = 0.4 + slope[0] * x + slope[1] * y
    result = _fill(plane, _hole(window))
    np.testing.assert_allclose(result.inverse, plane, rtol=2e-6)


def test_what_stands_in_front_does_not_grow_into_a_hole_that_leaves_the_picture():
    """The wall ends at the left, the square stands free in the hole: nothing faces its rim.

    Beyond the square, where it is all that can be seen, it still goes on.
    """
    wall, seen, valid = _wall_with_square()
    valid[:, 30:] = False
    valid[35:85, 40:80] = True
    result = _fill(seen, valid)
    beside = ~valid & (result.distance > 8)
    beside[:, 75:] = False
    assert np.median(np.abs(result.inverse / wall - 1)[beside]) < 0.02
    assert (np.abs(result.inverse / 0.6 - 1) < 0.1)[beside].mean() < 0.02


def test_what_the_pictures_edge_cut_off_goes_on_a_little():
    _, seen, valid = _wall_with_square()
    valid[:, 70:] = False
    result = _fill(seen, valid)
    middle = result.inverse[57:63, 70:72]
    np.testing.assert_allclose(middle, 0.6, rtol=0.02)


def test_a_room_corner_hidden_by_a_hole_is_found_again():
    # Seen from inside a room, the nearest plane is the surface: the largest inverse depth.
    x = _grid()[1]
    room = np.maximum(0.30 + 0.0015 * (x - 80), 0.30 - 0.0015 * (x - 80))
    valid = _hole(np.s_[30:90, 50:110])
    result = _fill(room, valid)
    error = np.abs(result.inverse / room - 1)[~valid]
    assert np.quantile(error, 0.9) < 0.01
    # Smooth interpolation from all the rim rounds the corner off.
    naive = inpaint_biharmonic(np.where(valid, room, 0), ~valid)
    assert error.mean() < 0.4 * np.abs(naive / room - 1)[~valid].mean()


def test_noise_does_not_tilt_planes():
    y, x = _grid()
    plane = 0.4 + 0.0005 * x - 0.0004 * y
    rng = np.random.default_rng(1)
    noisy = plane * (1 + 0.005 * rng.standard_normal(plane.shape))
    valid = _hole(np.s_[40:80, 50:110], np.s_[:, 140:])
    result = _fill(noisy, valid)
    error = np.abs(result.inverse / plane - 1)[~valid]
    assert np.median(error) < 0.004
    assert error.max() < 0.03


def test_nothing_known_stays_unknown_and_everything_known_stays_as_it_is():
    plane = 0.4 + 0.0005 * _grid()[1]
    empty = _fill(plane, np.zeros((HEIGHT, WIDTH), bool))
    assert not empty.inverse.any() and (empty.hits == -1).all()
    full = _fill(plane, np.ones((HEIGHT, WIDTH), bool))
    np.testing.assert_allclose(full.inverse, plane, rtol=1e-6)


def test_a_thin_rim_stops_every_direction():
    # One pixel thin, yet no knight's move may leap over it to the surface behind.
    inverse = np.full((HEIGHT, WIDTH), 0.5)
    valid = np.zeros((HEIGHT, WIDTH), bool)
    valid[:, 60] = valid[:, 100:] = True
    result = _fill(inverse, valid)
    columns = np.where(result.hits >= 0, result.hits % WIDTH, -1)[:, :, :60]
    assert set(np.unique(columns)) <= {-1, 60}


def test_the_fill_stays_within_limits():
    y = _grid()[0]
    floor = 0.002 * (y - 20.0) + 1e-4
    valid = y >= 60
    result = _fill(np.where(valid, floor, 1.0), valid)
    known = result.inverse[valid]
    assert result.inverse.min() == pytest.approx(0.5 * np.percentile(known, 1))


def test_an_observed_rim_outweighs_a_generated_one():
    window = np.s_[45:75, 65:95]
    inverse = np.full((HEIGHT, WIDTH), 0.3)
    inverse[45:75] = 0.25
    nearer, valid = inverse == 0.3, _hole(window)
    plain, left, above = (
        _fill(inverse, valid, generated=generated).inverse[window].mean()
        for generated in (None, nearer, ~nearer)
    )
    assert left < 0.98 * plain < 1.02 * plain < above


def windows_of_two(values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted means and mean weights of 2 x 2 windows, fewer at an odd edge."""
    rows, columns = (-(-side // 2) for side in weight.shape)
    mean = np.zeros((len(values), rows, columns))
    share = np.zeros((rows, columns))
    for i, j in np.ndindex(rows, columns):
        window = np.s_[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
        share[i, j] = weight[window].mean()
        if weight[window].sum() > 0:
            sums = (values * weight)[(slice(None), *window)].sum((1, 2))
            mean[:, i, j] = sums / weight[window].sum()
    return mean, share


def between(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    found = np.zeros((len(values), *size))
    for i, j in np.ndindex(*size):
        places = []
        for index, side, full in ((i, values.shape[1], size[0]), (j, values.shape[2], size[1])):
            place = min(max((index + 0.5) * side / full - 0.5, 0), side - 1)
            low = int(place)
            places.append((low, min(low + 1, side - 1), place - low))
        (top, bottom, v), (left, right, u) = places
        found[:, i, j] = (1 - v) * ((1 - u) * values[:, top, left] + u * values[:, top, right])
        found[:, i, j] += v * ((1 - u) * values[:, bottom, left] + u * values[:, bottom, right])
    return found


def plain_push_pull(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The definition, for one (C, H, W) image."""
    known = np.where(valid, values, 0.0)
    if valid.shape == (1, 1):
        return known
    coarse, share = windows_of_two(known, valid.astype(float))
    return np.where(valid, values, between(_pulled(coarse, share), valid.shape))


def _pulled(values: np.ndarray, share: np.ndarray) -> np.ndarray:
    weight = np.minimum(4 * share, 1)
    if share.shape == (1, 1):
        return values
    coarse, coarser = windows_of_two(values, weight)
    return weight * values + (1 - weight) * between(_pulled(coarse, coarser), share.shape)


@pytest.mark.parametrize(
    "size", [(1, 1), (1, 2), (1, 9), (7, 1), (2, 2), (3, 3), (5, 8), (13, 6), (16, 16), (17, 11)]
)
@pytest.mark.parametrize("share", [0.02, 0.3, 0.9])
def test_holes_are_filled_as_the_plain_algorithm_fills_them(size, share):
    rng = np.random.default_rng(size[0] * 100 + size[1])
    values = rng.normal(size=(2, 3, *size))
    valid = rng.random((2, 1, *size)) < share
    given = torch.from_numpy(np.where(valid, values, np.nan))
    found = push_pull(given, torch.from_numpy(valid))
    for index in range(2):
        expected = plain_push_pull(values[index], valid[index, 0])
        if not valid[index].any():
            expected = np.zeros_like(expected)
        np.testing.assert_allclose(found[index].numpy(), expected, rtol=1e-10, atol=1e-12)


def test_depth_is_filled_in_its_logarithm():
    depth = torch.zeros(3, 1, 4, 8)
    depth[0, :, :, :4], depth[0, :, :, 6:] = 1.0, 4.0
    depth[1, 0, 2, 2] = 7.0
    depth[0, 0, 0, 0] = torch.nan
    found = push_pull_depth(depth, torch.ones_like(depth, dtype=torch.bool))
    log = push_pull(depth.nan_to_num(1).clamp_min(0.5).log(), depth > 0)
    torch.testing.assert_close(found[0], log[0].exp())
    assert found[0].min() >= 1 - 1e-6 and found[0].max() <= 4 + 1e-5
    torch.testing.assert_close(found[1], torch.full_like(found[1], 7.0))
    assert not found[2].any()


SCALE = 0.8


@pytest.fixture(scope="module")
def corner() -> tuple[Guidance, np.ndarray, np.ndarray]:
    """Two views of a room, their true depth, and what the second sees of the first's.

    The first lacks a narrow strip of the left wall, the second knows the right third alone, so that
    nothing there tells it of that wall.
    """
    rng = np.random.default_rng(0)
    textures = [blotches(rng) for _ in range(3)]
    cameras = [camera_at((x, 0, 0), scale=SCALE, name=f"view {x}") for x in (0.0, 0.08)]
    pictures = [photograph(camera, textures) for camera in cameras]
    rgb = np.stack([picture.rgb for picture in pictures]) / np.float32(255)
    depth = np.stack([cast(camera)[1] for camera in cameras])
    height, width = depth.shape[1:]
    valid = np.ones(depth.shape, bool)
    valid[0, 10 : height - 10, 12:24] = False
    valid[1, :, : 2 * width // 3] = False
    strip = ~valid[0] & (cast(cameras[0])[0] == 2)
    _, _, points = cast(cameras[1])
    row, column = np.moveaxis(_pixels(points, cameras[0]), -1, 0)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    seen = np.zeros((height, width), bool)
    seen[inside] = strip[row[inside], column[inside]]
    assert strip.sum() > 300 and seen.sum() > 300
    known = Guidance(
        concatenate(cameras),
        np.where(valid[..., None], rgb, 0).astype(np.float32),
        np.where(valid, depth, 0).astype(np.float32),
        valid,
        valid.astype(np.float32),
        np.zeros_like(valid),
    )
    return known, depth, seen


def _pixels(points, camera):
    """(..., 2) row and column of points in a camera."""
    local = points @ camera.cam_from_world[0, :3, :3].T + camera.cam_from_world[0, :3, 3]
    at = local @ camera.K[0].T
    return np.floor(at[..., 1::-1] / at[..., 2:]).astype(int)


def test_what_one_view_is_surer_of_is_carried_to_the_others(corner):
    known, depth, seen = corner
    alone, shared = (surface_fill([], known, shared=value) for value in (False, True))
    error = {
        name: float(np.median(np.abs(fill.depth[1] / depth[1] - 1)[seen]))
        for name, fill in (("alone", alone), ("shared", shared))
    }
    assert error["shared"] < 0.1 * error["alone"], error
    assert shared.confidence is not None
    assert np.median(shared.confidence[1][seen]) > CARRIED
    # The first view lies deep in no hole: nothing is carried to it.
    for name in ("rgb", "depth", "confidence"):
        np.testing.assert_array_equal(getattr(shared, name)[0], getattr(alone, name)[0])


def test_memory_stays_as_it_is_and_the_order_of_the_views_does_not_matter(corner):
    known = corner[0]
    fill = surface_fill([], known, shared=True)
    turned = surface_fill([], known.select([1, 0]), shared=True).select([1, 0])
    for name in ("rgb", "depth", "confidence"):
        values = getattr(fill, name)
        np.testing.assert_array_equal(values, getattr(turned, name))
        np.testing.assert_array_equal(values[known.valid], getattr(known, name)[known.valid])


def test_only_memory_is_certain_and_averages_are_the_least_so(corner):
    known = corner[0]
    few = known.select([0, 1])
    # Too few pixels for planes.
    few.valid[1] = False
    few.valid[1, 40, 60:70] = True
    for values in (few.rgb, few.depth, few.confidence):
        values[~few.valid] = 0
    fill = surface_fill([], few)
    assert fill.confidence is not None
    assert (fill.confidence[~few.valid] < 1).all()
    assert (fill.confidence[0][~few.valid[0]] > AVERAGED).any()
    np.testing.assert_array_equal(fill.confidence[1][~few.valid[1]], np.float32(AVERAGED))
