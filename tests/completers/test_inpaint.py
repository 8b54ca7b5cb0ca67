from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from skimage.restoration import inpaint_biharmonic

from gvtools.cameras import Cameras, invert_rigid, rigid_transform
from gvtools.completers import ContextView, create
from gvtools.completers.hole_depth import fill_depth
from gvtools.guidance import Guidance

HEIGHT, WIDTH, FOCAL = 120, 160, 150.0


def camera(x: float = 0.0) -> Cameras:
    """Looks along z from (x, 0, 0)."""
    K = np.array([[[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]])
    pose = np.eye(4)
    pose[0, 3] = -x
    return Cameras(K, pose[None], np.array([WIDTH]), np.array([HEIGHT]), (f"{x:g}",))


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
    cam = Cameras(K, invert_rigid(pose)[None], np.array([640]), np.array([480]), (stem.name,))
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


def test_photographs_give_the_texture_that_no_depth_covers():
    rgb, depth = wall_view()
    valid = _hole(np.s_[40:80, 55:105])
    given = guidance(rgb, depth, valid, camera())
    side_rgb, side_depth = wall_view(0.1)
    # The photograph shows the place, its sensor does not.
    side_depth[25:95, 30:130] = 0
    context = [ContextView("side", camera(0.1), side_rgb, side_depth)]
    with_it = psnr(create("inpaint").complete(context, given).rgb[0], rgb, ~valid)
    without = psnr(create("inpaint", context_views=0).complete(context, given).rgb[0], rgb, ~valid)
    assert with_it > 25
    assert with_it > without + 10


def test_a_photograph_of_another_surface_is_not_used():
    rgb, depth = wall_view()
    valid = _hole(np.s_[40:80, 55:105])
    given = guidance(rgb, depth, valid, camera())
    red = np.zeros_like(rgb)
    red[..., 0] = 1
    context = [ContextView("blocked", camera(0.1), red, np.full_like(depth, 1.0))]
    without = create("inpaint").complete([], given)
    blocked = create("inpaint").complete(context, given)
    assert np.array_equal(blocked.rgb, without.rgb)


def test_a_photograph_that_disagrees_with_two_others_is_outvoted():
    rgb, depth = wall_view()
    valid = _hole(np.s_[40:80, 55:105])
    given = guidance(rgb, depth, valid, camera())
    unknown = np.zeros_like(depth)
    red = np.zeros_like(rgb)
    red[..., 0] = 1
    honest = [ContextView(f"{x}", camera(x), wall_view(x)[0], unknown) for x in (-0.1, 0.1)]
    liar = ContextView("liar", camera(0.02), red, unknown)
    result = create("inpaint").complete([*honest, liar], given)
    assert psnr(result.rgb[0], rgb, ~valid) > 20


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
