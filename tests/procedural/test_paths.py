from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from reference_rays import is_free

from gvtools.cameras import Cameras
from gvtools.procedural.builder import ProceduralScene
from gvtools.procedural.layouts import scene
from gvtools.procedural.paths import camera_path
from gvtools.procedural.ray_cast import cast
from gvtools.training.views import ContextChoice, choose_context

SIZE = (48, 64)


@pytest.fixture(scope="module")
def paths() -> list[tuple[ProceduralScene, Cameras]]:
    found = []
    for seed in range(24):
        rng = np.random.default_rng([seed, 9])
        place = scene(rng, ("train", "held-out")[seed % 2])
        found.append((place, camera_path(rng, place.geometry, views=8, size=SIZE)))
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
        centers = cameras.centers
        depth = np.linalg.norm(np.ptp(centers, axis=0))
        travel.append(depth)
        forward = cameras.cam_from_world[:, 2, :3]
        turn.append(np.degrees(np.arccos(np.clip(forward[0] @ forward[-1], -1, 1))))
    assert np.quantile(travel, 0.1) > 0.01 and np.median(travel) > 0.3
    assert np.quantile(turn, 0.9) > 45 and np.median(turn) < 60


def test_the_same_generator_gives_the_same_path() -> None:
    place = scene(np.random.default_rng(1), "train")
    first, again = (
        camera_path(np.random.default_rng(2), place.geometry, views=8, size=SIZE) for _ in range(2)
    )
    assert np.array_equal(first.cam_from_world, again.cam_from_world)


@pytest.mark.parametrize(
    ("rule", "count", "expected"),
    [
        ("first", 3, {(0, 1, 2)}),
        ("ends", 1, {(0,)}),
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
