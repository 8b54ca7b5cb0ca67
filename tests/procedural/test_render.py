from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from reference_rays import first_surface, is_free

from gvtools.cameras import Cameras, invert_rigid
from gvtools.procedural import furnished_room as materials
from gvtools.procedural.builder import Light, ProceduralScene, SceneBuilder
from gvtools.procedural.layouts import scene
from gvtools.procedural.paths import camera_path
from gvtools.procedural.ray_cast import BALL, BOX, TUBE, cast, clearance
from gvtools.procedural.render import Look, decode_srgb, encode_srgb, radiance, to_srgb
from gvtools.procedural.textures import (
    LONGEST,
    PHOTOGRAPHS,
    SIDE,
    level_starts,
    photograph,
    photograph_names,
    picture,
    stack_levels,
)
from gvtools.training.views import ContextChoice, choose_context
from gvtools.trajectories import look_at

SEEDS = range(8)
SIZE = (20, 20)


def _drawn(seed: int, *, size: tuple[int, int] = SIZE, views: int = 3):
    rng = np.random.default_rng([seed, 5])
    place = scene(rng, ("train", "held-out")[seed % 2])
    return place, camera_path(rng, place.geometry, views=views, size=size)


def _rays(cameras: Cameras, view: int) -> np.ndarray:
    return (cameras.rays(view) @ cameras.cam_from_world[view, :3, :3]).reshape(-1, 3)


def _white(look: Look, **changes) -> Look:
    black = {
        "texels": np.ones_like(look.texels),
        "gain": np.ones_like(look.gain),
        "emission": np.zeros_like(look.emission),
        "ambient": np.zeros((2, 3)),
        "sun": np.array([[0, 0, 1.0], [0, 0, 0]]),
        "lamps": np.zeros((1, 2, 3)),
        "shadows": False,
    }
    return look._replace(**{**black, **changes})


@pytest.mark.parametrize("seed", SEEDS)
def test_depth_is_where_rays_leave_free_space(seed: int) -> None:
    place, cameras = _drawn(seed)
    depth = cast(place.geometry, cameras).depth
    for view in range(len(cameras)):
        expected = first_surface(place.geometry, cameras.centers[view], _rays(cameras, view))
        np.testing.assert_allclose(depth[view].ravel(), expected, rtol=1e-9)


def test_the_picture_has_the_same_depth() -> None:
    place, cameras = _drawn(3)
    _, depth = radiance(place.geometry, place.look, cameras)
    np.testing.assert_allclose(depth, cast(place.geometry, cameras).depth, rtol=1e-6)


def test_solids_on_their_own_and_from_within_their_hull() -> None:
    build = SceneBuilder(np.random.default_rng(0), ())
    paint = build.material()
    build.room([-5, -5, 0], [5, 5, 4], [paint] * 6)
    build.solid(TUBE, [2, 0, 1], [0.5, 0.3, 1], material=paint, yaw=0.4)
    build.solid(BALL, [2, 2, 2], [0.9, 0.5, 0.7], material=paint, yaw=1.0, tilt=0.5)
    tunnel = ([-0.6, -2, -0.5], [0.6, 2, 0.6])
    build.solid(BOX, [0, 0, 1.5], [1, 1, 1], material=paint, cuts=[tunnel])
    cell = ([-0.3, -2.0, -0.2], [0.3, 0.4, 0.5])
    build.solid(BALL, [2, -2, 2], [1, 1, 1], material=paint, yaw=0.7, cuts=[cell])
    geometry = build.geometry()
    rng = np.random.default_rng(1)
    # One stands in the tunnel: within the hull, and free.
    for eye in ([0.1, 0.2, 1.4], [-3.0, -3.0, 2.0], [2.0, -4.5, 2.2]):
        assert is_free(geometry, np.array(eye))
        camera = _towards(np.array(eye), rng.uniform([1, -1, 1], [3, 1, 3]))
        depth = cast(geometry, camera).depth[0].ravel()
        expected = first_surface(geometry, np.array(eye), _rays(camera, 0))
        np.testing.assert_allclose(depth, expected, rtol=1e-9)


def _towards(eye: np.ndarray, aim: np.ndarray) -> Cameras:
    (pose,) = invert_rigid(look_at(eye[None], aim, up=[0, 0, 1]))
    return Cameras.pinhole(40, 40, focal=16.0, cam_from_world=pose)


@pytest.mark.parametrize("seed", [0, 1, 2, 5])
def test_normals_are_those_of_neighbouring_surface_points(seed: int) -> None:
    place, cameras = _drawn(seed, views=1)
    geometry = place.geometry
    found = np.zeros((*SIZE, 3))
    for towards in (*np.eye(3), *-np.eye(3)):
        look = _white(place.look, sun=np.stack([towards, np.ones(3)]))
        found += towards * radiance(geometry, look, cameras, supersample=1)[0][0, ..., :1]
    rays = _rays(cameras, 0)
    eye = cameras.centers[0]
    step = 1e-5
    turn = cameras.cam_from_world[0, :3, :3]
    points = [
        eye + first_surface(geometry, eye, rays + offset)[:, None] * (rays + offset)
        for offset in (0 * turn[0], step * turn[0], step * turn[1])
    ]
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= -np.sign((normal * rays).sum(1, keepdims=True))
    smooth = np.linalg.norm(points[1] - points[0], axis=1) < 50 * step * points[0].max()
    wrong = np.linalg.norm(found.reshape(-1, 3) - normal, axis=1) > 1e-2
    # A ray that straddles an edge has no normal of this kind.
    assert (wrong & smooth).mean() < 0.01
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-5)


@pytest.mark.parametrize("seed", [0, 2, 3, 6])
def test_the_lamp_lights_what_it_sees(seed: int) -> None:
    place, cameras = _drawn(seed, views=1)
    geometry = place.geometry
    lamp = np.stack([place.look.lamps[0, 0], np.ones(3)])
    assert is_free(geometry, lamp[0])
    lit, open_ = (
        radiance(
            geometry, _white(place.look, lamps=lamp[None], shadows=shadows), cameras, supersample=1
        )[0][0, ..., 0].ravel()
        for shadows in (True, False)
    )
    facing = open_ > 1e-3
    rays = _rays(cameras, 0)
    depth = cast(geometry, cameras).depth[0].reshape(-1, 1)
    start = cameras.centers[0] + depth * (1 - 1e-6) * rays
    clear = first_surface(geometry, start, lamp[0] - start) >= 1
    assert ((lit > 0) != clear)[facing].mean() < 0.005
    seen = facing & clear & (lit > 0)
    np.testing.assert_allclose(lit[seen], open_[seen], rtol=1e-5)


def test_a_point_has_one_colour_in_all_views() -> None:
    errors, chance = [], []
    for seed in range(6):
        place, cameras = _drawn(seed, size=(64, 64), views=2)
        light, depth = radiance(place.geometry, place.look, cameras)
        image = to_srgb(light, place.key / light.mean()).astype(float) / 255
        points = cameras.centers[0] + depth[0].reshape(-1, 1) * _rays(cameras, 0)
        xy, z = cameras[1].project(points)
        with np.errstate(invalid="ignore"):
            inside = ((xy[0] > 1) & (xy[0] < 63)).all(1)
        column, row = np.floor(xy[0][inside]).astype(int).T
        same = np.abs(depth[1][row, column] / z[0][inside] - 1) < 0.01
        first = image[0].reshape(-1, 3)[inside][same]
        errors.append((first - image[1][row, column][same]) ** 2)
        chance.append((first - np.random.default_rng(0).permutation(first)) ** 2)
    found, expected = np.concatenate(errors), np.concatenate(chance)
    assert len(found) > 3000
    # Half a pixel of misplacement at most, and textures that are finer than a pixel.
    assert np.median(found.mean(1)) < 4e-4
    assert found.mean() < 0.15 * expected.mean()


def test_cameras_in_no_room_see_nothing() -> None:
    place, cameras = _drawn(1)
    away = cameras.cam_from_world.copy()
    away[:, :3, 3] += 1e3
    outside = Cameras(cameras.K, away, cameras.width, cameras.height, cameras.names)
    assert (cast(place.geometry, outside).depth == 0).all()


def test_clearance_is_the_distance_to_what_is_not_free() -> None:
    place, _ = _drawn(2)
    geometry = place.geometry
    rng = np.random.default_rng(3)
    low, high = geometry.rooms[0]
    points = rng.uniform(low - 0.2, high + 0.2, (300, 3))
    distance = clearance(geometry, points)
    for point, reach in zip(points, distance, strict=True):
        if reach <= 0:
            continue
        around = rng.standard_normal((200, 3))
        around *= 0.999 * reach / np.linalg.norm(around, axis=1, keepdims=True)
        assert is_free(geometry, point + around).all()
    assert not is_free(geometry, points[distance < -0.05]).all()


def test_pictures_do_not_depend_on_threads() -> None:
    import numba

    place, cameras = _drawn(0)
    before = numba.get_num_threads()
    several = radiance(place.geometry, place.look, cameras)
    numba.set_num_threads(1)
    single = radiance(place.geometry, place.look, cameras)
    numba.set_num_threads(before)
    for a, b in zip(several, single, strict=True):
        assert np.array_equal(a, b)


def test_scenes_are_those_of_their_seed() -> None:
    def arrays(place: ProceduralScene) -> list[np.ndarray]:
        return [*place.geometry, *(part for part in place.look if isinstance(part, np.ndarray))]

    first, again, other = (scene(np.random.default_rng(n), "train") for n in (7, 7, 8))
    assert all(np.array_equal(a, b) for a, b in zip(arrays(first), arrays(again), strict=True))
    assert not np.array_equal(first.geometry.rooms[0], other.geometry.rooms[0])
    path, same = (
        camera_path(np.random.default_rng(2), first.geometry, views=8, size=PICTURE).cam_from_world
        for _ in range(2)
    )
    assert np.array_equal(path, same)


def test_a_picture_hangs_upright_and_unmirrored() -> None:
    image = np.zeros((64, 64, 3), np.uint8)
    image[:32, :32, 0] = 200  # red, upper left
    image[:32, 32:, 1] = 200  # green, upper right
    build = SceneBuilder(np.random.default_rng(0), ())
    build.room([-5, -5, -5], [5, 5, 5], [build.coated(np.zeros_like(image), 1.0)] * 6)
    shown = build.coated(image, 2.0, offset=-1.0, emission=1.0)
    build.solid(BOX, [0, 0, 0], [1, 0.01, 1], material=shown)
    look = build.look(Light(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((1, 2, 3)), 1.0, False))
    # Seen along the box's second axis.
    camera = _towards(np.array([0.0, -2.0, 0.0]), np.zeros(3))
    picture = radiance(build.geometry(), look, camera)[0][0]
    assert picture[16, 16, 0] > 0.5 and picture[16, 16, 1] < 0.01
    assert picture[16, 24, 1] > 0.5 and picture[16, 24, 0] < 0.01
    assert picture[24, 20].max() < 0.01


def test_several_lamps_add_up_and_some_things_cast_no_shadow() -> None:
    build = SceneBuilder(np.random.default_rng(0), ())
    white = build.coated(np.full((8, 8, 3), 255, np.uint8), 1.0)
    build.room([-3, -3, 0], [3, 3, 3], [white] * 6)
    build.solid(BOX, [0, 0, 1], [0.3, 0.3, 0.1], material=white, shades=False)
    lamps = np.array([[[0.0, 0.0, 2.5], [1, 1, 1]], [[1.5, 1.0, 2.0], [1, 0.5, 0.2]]])
    camera = _towards(np.array([-2.0, -2.0, 1.5]), np.zeros(3))

    def light(lamps: np.ndarray, *, shades: bool) -> np.ndarray:
        geometry = build.geometry()._replace(shades=np.array([shades]))
        look = build.look(Light(np.zeros((2, 3)), np.zeros((2, 3)), lamps, 2.0, True))
        return radiance(geometry, look, camera)[0]

    apart = light(lamps[:1], shades=True) + light(lamps[1:], shades=True)
    np.testing.assert_allclose(light(lamps, shades=True), apart, rtol=1e-5, atol=1e-6)
    shadow = light(lamps, shades=False) - apart
    assert shadow.min() > -1e-6 and (shadow > 0.1).mean() > 0.01


def test_photographs_are_of_installed_wheels_and_of_one_split_alone() -> None:
    train, held_out = (PHOTOGRAPHS[split] for split in ("train", "held-out"))
    assert not set(train) & set(held_out)
    thumbnails: dict[str, list[bytes]] = {}
    for split in PHOTOGRAPHS:
        for name in photograph_names(split):
            image = photograph(name)
            assert image.dtype == np.uint8 and image.shape[2] == 3
            assert max(image.shape) <= LONGEST and image.std() > 5
            levels = np.sort(image.reshape(-1, 3).mean(1))[:: image.size // 300][:100]
            thumbnails.setdefault(split, []).append(levels.tobytes())
        assert len(thumbnails[split]) >= 6
    assert not set(thumbnails["train"]) & set(thumbnails["held-out"])


def test_pictures_are_neither_black_nor_blank() -> None:
    rng = np.random.default_rng(0)
    images = [picture(rng, photograph_names("train")) for _ in range(60)]
    assert all(image.shape == (SIDE, SIDE, 3) and image.dtype == np.uint8 for image in images)
    assert np.median([image.mean() for image in images]) > 60
    assert np.mean([image.std() > 8 for image in images]) > 0.9


def test_levels_are_block_means_in_linear_light() -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, SIDE, SIDE, 3), np.uint8)
    texels = stack_levels(list(images))
    linear = decode_srgb(images).astype(np.float64)
    starts = level_starts(SIDE)
    for level in range(len(starts) - 1):
        side = SIDE >> level
        block = 1 << level
        expected = linear.reshape(2, side, block, side, block, 3).mean((2, 4))
        found = texels[:, starts[level] : starts[level + 1]].reshape(2, side, side, 3)
        np.testing.assert_allclose(found, expected, atol=2e-6)


def test_room_materials_have_their_colour_and_size() -> None:
    rng = np.random.default_rng(0)
    color = (0.5, 0.6, 0.7)
    for image in (materials.paint(color), materials.tiled("brick", color)):
        np.testing.assert_allclose(image.mean((0, 1)) / 255, color, atol=0.03)
    boards = materials.planks(color, rng)
    assert boards.std() > materials.paint(color).std()
    for image in (boards, materials.globe("moon"), materials.picture("rocket")[0]):
        assert image.shape == (materials.SIDE, materials.SIDE, 3) and image.dtype == np.uint8


def test_colour_codes_round_trip_below_the_roll_off() -> None:
    codes = np.arange(0, 215, dtype=np.uint8)
    np.testing.assert_array_equal(encode_srgb(decode_srgb(codes)), codes)
    bright = encode_srgb(np.linspace(0.6, 5, 50).astype(np.float32))
    assert (np.diff(bright.astype(int)) >= 0).all()


PICTURE = (48, 64)


@pytest.fixture(scope="module")
def paths() -> list[tuple[ProceduralScene, Cameras]]:
    found = []
    for seed in range(24):
        rng = np.random.default_rng([seed, 9])
        place = scene(rng, ("train", "held-out")[seed % 2])
        found.append((place, camera_path(rng, place.geometry, views=8, size=PICTURE)))
    return found


def test_cameras_stand_in_free_space_and_see_something(paths) -> None:
    for place, cameras in paths:
        assert is_free(place.geometry, cameras.centers).all()
        # Not inside a hull either: nobody stands under a table.
        bare = place.geometry._replace(first_cutter=0 * place.geometry.first_cutter)
        assert is_free(bare, cameras.centers).all()
        depth = cast(place.geometry, cameras.resized(16, 12)).depth
        assert depth.min() > 0.02 * depth.mean()
        rotation = cameras.cam_from_world[:, :3, :3]
        gram = rotation @ rotation.swapaxes(1, 2)
        np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-12)
        assert (np.linalg.det(rotation) > 0).all()
        fov = 2 * np.degrees(np.arctan(32 / cameras.K[0, 0, 0]))
        assert 50 <= fov <= 80
        # Upright, up to the slant of a hand: the world's up is the image's up.
        assert (rotation[:, 1, 2] < 0).all()


def test_paths_move_and_turn(paths) -> None:
    travel, turn = [], []
    for _, cameras in paths:
        travel.append(np.linalg.norm(np.ptp(cameras.centers, axis=0)))
        forward = cameras.cam_from_world[:, 2, :3]
        turn.append(np.degrees(np.arccos(np.clip(forward[0] @ forward[-1], -1, 1))))
    assert np.quantile(travel, 0.1) > 0.01 and np.median(travel) > 0.3
    assert np.quantile(turn, 0.9) > 45 and np.median(turn) < 60


@pytest.mark.parametrize(
    ("rule", "count", "expected"),
    [
        ("first", 3, {(0, 1, 2)}),
        ("ends", 2, {(0, 7)}),
        ("ends", 4, {(0, 2, 5, 7)}),
        ("every", 4, {(0, 2, 4, 6), (1, 3, 5, 7)}),
        ("every", 2, {(i, i + 4) for i in range(4)}),
    ],
)
def test_context_rules(rule: Any, count: int, expected: set[tuple[int, ...]]) -> None:
    rng = np.random.default_rng(0)
    assert {choose_context(rng, 8, count, rule=rule) for _ in range(60)} == expected


def test_context_counts_come_in_groups() -> None:
    options = ContextChoice(group=4)
    counts = np.array([options.count([0, 1], index) for index in range(400)]).reshape(-1, 4)
    assert (counts == counts[:, :1]).all()
    assert {int(c) for c in counts[:, 0]} == {1, 2, 3, 4}
    assert np.bincount(counts[:, 0])[1:].min() > 10
