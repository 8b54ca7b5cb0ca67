from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest

from gvtools.cameras import Cameras
from gvtools.scenes.ray_casting import Ball, Flat, Patch, Tube, bilinear, cast, shade
from gvtools.scenes.room_textures import Texture, decode_srgb, encode_srgb, paint, picture
from gvtools.scenes.synthetic import look_at

GREY = Texture((np.full((2, 2, 3), 0.4, np.float32), np.full((1, 1, 3), 0.4, np.float32)), True, 1)


def _camera(eye: list[float], aim: list[float]) -> Cameras:
    K = np.array([[90.0, 0, 47.3], [0, 92.0, 34.6], [0, 0, 1]])
    pose = look_at(np.array(eye), np.array(aim))
    return Cameras(K[None], pose[None], np.array([96]), np.array([72]), ("a",))


def _sheets(count: int) -> list[Flat]:
    rng = np.random.default_rng(4)
    return [
        Flat(GREY, (1, 1), 0.0, rng.uniform(-1, 1, 3), *rng.normal(0, 0.7, (2, 3)))
        for _ in range(count)
    ]


def _seen_from(sheet: Flat, eye: list[float]) -> Flat:
    if sheet.averted(np.array(eye)):
        return Flat(GREY, (1, 1), 0.0, sheet.origin + sheet.u, -sheet.u, sheet.v)
    return sheet


def test_sheets_have_the_depth_that_open3d_finds() -> None:
    eye = [2.6, 0.4, 0.7]
    sheets = [_seen_from(sheet, eye) for sheet in _sheets(25)]
    camera = _camera(eye, [0, 0, 0])
    _, hits = cast(sheets, camera)
    scene = o3d.t.geometry.RaycastingScene()
    for sheet in sheets:
        corners = sheet.hull().astype(np.float32)
        faces = np.array([[0, 1, 2], [1, 3, 2]], np.uint32)
        scene.add_triangles(o3d.core.Tensor(corners), o3d.core.Tensor(faces))
    rays = camera.rays() @ camera.cam_from_world[0, :3, :3]
    origin = np.broadcast_to(camera.centers[0], rays.shape)
    both = np.concatenate([origin, rays], -1).astype(np.float32)
    answer = scene.cast_rays(o3d.core.Tensor(both))
    expected = answer["t_hit"].numpy()
    patch = np.where(np.isfinite(expected), answer["geometry_ids"].numpy().astype(int), -1)
    agree = hits.patch == patch
    assert (hits.patch >= 0).mean() > 0.3
    assert agree.mean() > 0.998  # pixel centres that an edge runs through may go either way
    hit = agree & (patch >= 0)
    np.testing.assert_allclose(hits.z[hit], expected[hit], rtol=1e-4)


def test_camera_among_the_sheets_needs_no_window() -> None:
    eye = [0.1, 0.05, 0.1]
    sheets: list[Patch] = [_seen_from(sheet, eye) for sheet in _sheets(25)]
    camera = _camera(eye, [1, 1, 0])
    grid, hits = cast(sheets, camera)
    everything = slice(0, 72), slice(0, 96)
    slow = np.min([sheet.hit(grid, *everything)[0] for sheet in sheets], axis=0)
    np.testing.assert_array_equal(hits.z, slow)


@pytest.mark.parametrize(
    "patch",
    [
        Ball(GREY, (1, 1), 0.0, np.array([0.1, -0.2, 0.3]), 0.6),
        Tube(GREY, (1, 1), 0.0, np.array([0.1, -0.2, -0.5]), 0.4, 1.1),
        Flat(GREY, (1, 1), 0.0, np.zeros(3), np.array([0, 1.0, 0]), np.array([0, 0, -1.0])),
    ],
)
def test_hits_lie_where_the_parameters_say(patch: Patch) -> None:
    camera = _camera([3, 0.5, 0.9], [0, 0, 0])
    _, hits = cast([patch], camera)
    seen = hits.patch == 0
    assert 0.01 < seen.mean() < 0.9
    rays = camera.rays() @ camera.cam_from_world[0, :3, :3]
    world = camera.centers[0] + rays * np.where(seen, hits.z, 1)[..., None]
    position, normal = patch.at(hits.s[seen], hits.t[seen])
    np.testing.assert_allclose(position, world[seen], atol=1e-9)
    # The side that is seen faces the camera.
    assert ((normal * rays[seen]).sum(-1) < 1e-9).all()


def test_ball_covers_its_silhouette() -> None:
    ball = Ball(GREY, (1, 1), 0.0, np.array([0.1, -0.2, 0.3]), 0.6)
    camera = _camera([3, 0.5, 0.9], [0, 0, 0])
    _, hits = cast([ball], camera)
    rays = camera.rays() @ camera.cam_from_world[0, :3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    offset = ball.center - camera.centers[0]
    along = rays @ offset
    miss = np.linalg.norm(offset - along[..., None] * rays, axis=-1)
    np.testing.assert_array_equal(hits.patch == 0, miss < ball.radius)


def test_shading_a_grey_sheet_gives_grey_times_light() -> None:
    sheet = Flat(
        GREY, (3, 2), 0.0, np.array([0, -9.0, 9.0]), np.array([0, 18.0, 0]), -9.0 * np.eye(3)[2] * 2
    )
    light = np.full((2, 2, 3), 0.5, np.float32)
    image = shade([sheet], [light], *cast([sheet], _camera([3, 0, 0], [0, 0, 0]), supersample=2))
    assert image.shape == (72, 96, 3)
    np.testing.assert_array_equal(image, encode_srgb(np.full((72, 96, 3), 0.2, np.float32)))


def test_a_picture_hangs_upright_and_unmirrored() -> None:
    values = np.zeros((4, 4, 3), np.float32)
    values[:2, :2, 0] = 0.6  # red, upper left
    values[:2, 2:, 1] = 0.6  # green, upper right
    texture = Texture((values, values[::2, ::2]), False, 1)
    # Seen from +x with z up, the viewer's right is +y.
    sheet = Flat(
        texture,
        (1, 1),
        0.0,
        np.array([0, -1.0, 1.0]),
        np.array([0, 2.0, 0]),
        np.array([0, 0, -2.0]),
    )
    light = np.ones((2, 2, 3), np.float32)
    image = shade([sheet], [light], *cast([sheet], _camera([3, 0, 0], [0, 0, 0])))
    assert image[20, 30, 0] > 150 and image[20, 30, 1] < 20
    assert image[20, 65, 1] > 150 and image[20, 65, 0] < 20
    assert image[50, 48].max() < 20


def test_texture_far_away_is_its_mean() -> None:
    for texture in (picture("astronaut"), paint((0.5, 0.6, 0.7), grain=0.1)):
        place = np.linspace(0.05, 0.9, 7)
        far = texture.sample(place, place, np.full(7, 1e6))
        mean = texture.levels[0].mean((0, 1))
        np.testing.assert_allclose(far, np.broadcast_to(mean, far.shape), rtol=1e-3)


def test_texture_near_is_its_texels_and_tiles_seamlessly() -> None:
    texture = paint((0.5, 0.6, 0.7), grain=0.1)
    side = texture.levels[0].shape[0]
    index = np.arange(0, side, 37)
    center = (index + 0.5) / side
    near = texture.sample(center, center, np.full(len(index), 0.1))
    np.testing.assert_allclose(near, texture.levels[0][index, index], atol=1e-6)
    np.testing.assert_allclose(
        near, texture.sample(center + 2, center - 3, np.full(len(index), 0.1)), atol=1e-5
    )


def test_colour_codes_round_trip_below_the_roll_off() -> None:
    codes = np.arange(0, 215, dtype=np.uint8)
    np.testing.assert_array_equal(encode_srgb(decode_srgb(codes)), codes)
    bright = encode_srgb(np.linspace(0.6, 5, 50).astype(np.float32))
    assert (np.diff(bright.astype(int)) >= 0).all()


def test_bilinear_reproduces_a_ramp() -> None:
    rows, columns = 5, 7
    ramp = ((np.arange(columns) + 0.5) / columns)[None, :, None] + 2 * (
        (np.arange(rows) + 0.5) / rows
    )[:, None, None]
    s, t = np.array([0.3, 0.5, 0.77]), np.array([0.2, 0.6, 0.81])
    np.testing.assert_allclose(bilinear(ramp.astype(np.float32), s, t)[:, 0], s + 2 * t, atol=1e-6)
