from __future__ import annotations

import numpy as np
import pytest

from gvtools.scenes.ray_casting import Flat
from gvtools.scenes.room_light import Block, Cylinder, Lamp, Solid, Sphere, bake
from gvtools.scenes.room_textures import paint

ROOM = np.array([4.0, 4.0, 3.0])
DARK = np.zeros(3)


def _floor() -> Flat:
    return Flat(
        paint((0.5, 0.5, 0.5)),
        (1, 1),
        0.0,
        np.array([0, 4.0, 0]),
        np.array([4.0, 0, 0]),
        np.array([0, -4.0, 0]),
    )


def _ceiling_lamp(side: float) -> Lamp:
    corner = np.array([2 - side / 2, 2 - side / 2, 3.0])
    return Lamp(corner, np.array([side, 0, 0]), np.array([0, side, 0]), np.ones(3))


SOLIDS: list[Solid] = [
    Block(np.array([0.2, -0.1, 0.3]), np.array([0.5, 0.3, 0.4]), 0.6),
    Sphere(np.array([0.1, 0.2, -0.1]), 0.7),
    Cylinder(np.array([-0.1, 0.1, -0.5]), 0.5, 0.9),
]


def _inside(solid: Solid, points: np.ndarray) -> np.ndarray:
    if isinstance(solid, Sphere):
        return ((points - solid.center) ** 2).sum(-1) < solid.radius**2
    if isinstance(solid, Cylinder):
        x, y, z = (points - solid.foot).T
        return (x * x + y * y < solid.radius**2) & (z > 0) & (z < solid.height)
    c, s = np.cos(-solid.yaw), np.sin(-solid.yaw)
    x, y, z = (points - solid.center).T
    local = np.stack([c * x - s * y, s * x + c * y, z], -1)
    return (np.abs(local) < solid.half).all(-1)


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: type(solid).__name__)
def test_interval_is_where_points_of_the_ray_are_inside(solid: Solid) -> None:
    rng = np.random.default_rng(1)
    origin, ray = rng.uniform(-1.5, 1.5, (400, 3)), rng.normal(size=(400, 3))
    enter, leave = solid.interval(origin, ray)
    at = np.linspace(-3, 3, 601)
    for i in range(len(origin)):
        expected = _inside(solid, origin[i] + at[:, None] * ray[i])
        clear = (np.abs(at - enter[i]) > 1e-9) & (np.abs(at - leave[i]) > 1e-9)
        found = (at > enter[i]) & (at < leave[i])
        np.testing.assert_array_equal(found[clear], expected[clear])
    assert 50 < (enter < leave).sum() < 380
    center, radius = solid.ball()
    hit = np.flatnonzero(enter < leave)
    for end in (enter, leave):
        reach = np.linalg.norm(origin[hit] + end[hit, None] * ray[hit] - center, axis=-1)
        assert (reach <= radius + 1e-9).all()


def test_small_lamp_follows_the_inverse_square_law() -> None:
    light = bake([_floor()], solids=[], lamps=[_ceiling_lamp(0.02)], ambient=DARK, room=ROOM)[0]
    rows, columns = light.shape[:2]
    x = (np.arange(columns) + 0.5) / columns * 4
    y = 4 - (np.arange(rows) + 0.5) / rows * 4
    squared = (x[None] - 2) ** 2 + (y[:, None] - 2) ** 2 + 9
    # cos at the floor and at the lamp are both 3 / distance.
    np.testing.assert_allclose(light[..., 0], 9 / squared**2, rtol=0.01)


def test_block_casts_the_shadow_of_a_small_lamp_and_nothing_else() -> None:
    block = Block(np.array([2.0, 2.0, 1.5]), np.array([0.4, 0.4, 0.1]))
    lamp = _ceiling_lamp(0.02)
    free = bake([_floor()], solids=[], lamps=[lamp], ambient=DARK, room=ROOM)[0][..., 0]
    light = bake([_floor()], solids=[block], lamps=[lamp], ambient=DARK, room=ROOM)[0][..., 0]
    rows, columns = light.shape
    x = np.abs((np.arange(columns) + 0.5) / columns * 4 - 2)
    y = np.abs((np.arange(rows) + 0.5) / rows * 4 - 2)
    # Its upper face, 1.4 below the lamp, throws an edge at 0.4 x 3 / 1.4 on the floor.
    edge = 0.4 * 3 / 1.4
    reach = np.maximum(x[None], y[:, None])
    assert (light[reach < edge - 0.05] == 0).all()
    np.testing.assert_array_equal(light[reach > edge + 0.05], free[reach > edge + 0.05])


def test_culling_does_not_change_shadows() -> None:
    # A solid that encloses nothing but has an enormous bounding ball is never culled.
    class Uncullable(Block):
        def ball(self) -> tuple[np.ndarray, float]:
            return self.center, 1e3

    rng = np.random.default_rng(5)
    boxes = [
        (
            rng.uniform([0.5, 0.5, 0.1], [3.5, 3.5, 2.5]),
            rng.uniform(0.05, 0.4, 3),
            rng.uniform(0, 3),
        )
        for _ in range(8)
    ]
    lamp, ambient = _ceiling_lamp(1.0), np.full(3, 0.5)
    results = [
        bake(
            [_floor()],
            solids=[kind(*box) for box in boxes],
            lamps=[lamp],
            ambient=ambient,
            room=ROOM,
        )
        for kind in (Block, Uncullable)
    ]
    np.testing.assert_array_equal(results[0][0], results[1][0])


def test_corners_are_darker_than_the_open_floor() -> None:
    light = bake([_floor()], solids=[], lamps=[], ambient=np.ones(3), room=ROOM)[0][..., 0]
    assert light[0, 0] < 0.75 * light[light.shape[0] // 2, light.shape[1] // 2]
    assert light.max() <= 1


def test_buried_cells_do_not_darken_their_neighbours() -> None:
    block = Block(np.array([2.0, 2.0, 0.2]), np.array([0.5, 0.5, 0.2]))
    light = bake([_floor()], solids=[block], lamps=[], ambient=np.ones(3), room=ROOM)[0]
    assert np.isfinite(light).all()
    assert light.min() > 0.1
