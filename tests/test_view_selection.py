from __future__ import annotations

import numpy as np
import pytest
from geoverse_models import rotation

from gvtools.cameras import Cameras, concatenate
from gvtools.view_selection import covisible_views, evenly_spread, in_view, nearest_views


def looking(centre: tuple[float, float, float], angle: float, name: str) -> Cameras:
    pose = np.eye(4)
    pose[:3, :3] = rotation((0, 1, 0), angle).T
    pose[:3, 3] = -pose[:3, :3] @ np.array(centre)
    K = np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
    return Cameras(K[None], pose[None], np.array([40]), np.array([30]), (name,))


def views(*cameras: Cameras) -> Cameras:
    return concatenate(list(cameras))


def nearest(context: Cameras, targets: Cameras, count: int) -> list[str]:
    return [context.names[row] for row in nearest_views(context, targets, count)]


def covisible(
    context: Cameras, target: Cameras, depth: np.ndarray, count: int, own: np.ndarray | None = None
) -> list[str]:
    """``own`` is the depth of the first view; the others have none."""
    depths = [own, *[None] * (len(context) - 1)]
    rows = covisible_views(context, target, depth, count=count, depths=depths)
    return [context.names[row] for row in rows]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_the_nearest_views_stand_and_look_like_the_targets(scale, shift):
    def place(x: float, angle: float, name: str) -> Cameras:
        return looking((scale * (x + shift), 0, 0), angle, name)

    context = views(
        place(0, 0, "left"),
        place(10, 0, "right"),
        place(1, np.pi, "behind"),
        place(4, 0, "middle"),
        place(1, 0.1, "beside"),
    )

    def chosen(count: int, *targets: Cameras) -> list[str]:
        return nearest(context, concatenate(list(targets)), count)

    near = place(1, 0, "target")
    assert chosen(1, near) == ["beside"]
    assert chosen(2, near) == ["beside", "left"]
    assert chosen(1, place(1, np.pi, "turned")) == ["behind"]
    assert chosen(1, place(9, 0, "target")) == ["right"]
    # The first serves all targets; each then has its own: not the three that are best for one.
    assert chosen(1, near, place(9.5, 0, "far")) == ["middle"]
    assert set(chosen(3, near, place(9.5, 0, "far"))) == {"middle", "beside", "right"}
    everything = chosen(9, near)
    assert sorted(everything) == sorted(context.names)
    assert everything[0] == "beside" and everything[-1] == "behind"


def wall(distance: float) -> np.ndarray:
    return np.full((30, 40), distance, np.float32)


def test_a_view_that_sees_the_target_comes_before_one_that_stands_nearer():
    target = looking((0, 0, 0), 0.0, "target")
    context = views(looking((0.1, 0, 0), 1.2, "turned away"), looking((0, 0, -2), 0.0, "behind it"))
    assert nearest(context, target, 1) == ["turned away"]
    assert covisible(context, target, wall(2.0)[None], 1) == ["behind it"]


def test_the_second_view_shows_what_the_first_does_not():
    target = looking((0, 0, 0), 0.0, "target")
    context = views(
        looking((-1, 0, 0), 0.0, "left"),
        looking((-1.05, 0, 0), 0.0, "left again"),
        looking((1.2, 0, 0), 0.0, "right"),
    )
    assert covisible(context, target, wall(2.0)[None], 2) == ["left", "right"]
    everything = covisible(context, target, wall(2.0)[None], 9)
    assert sorted(everything) == ["left", "left again", "right"]


def test_what_hides_behind_a_photographs_own_surface_is_not_seen_by_it():
    target = looking((0, 0, 0), 0.0, "target")
    near, far = looking((0.1, 0, 0), 0.0, "near"), looking((0.6, 0, 0), 0.0, "far")

    def chosen(own: np.ndarray | None) -> list[str]:
        return covisible(views(near, far), target, wall(2.0)[None], 1, own)

    assert chosen(None) == chosen(wall(2.0)) == chosen(0 * wall(1.0)) == ["near"]
    # A board before the camera.
    assert chosen(wall(0.5)) == ["far"]


def test_without_depth_the_nearest_stand_in():
    target = looking((0, 0, 0), 0.0, "target")
    context = views(looking((3, 0, 0), 0.0, "far"), looking((0.1, 0, 0), 0.0, "near"))
    for nothing in (0.0, np.nan, np.inf):
        depth = np.full((1, 30, 40), nothing, np.float32)
        assert covisible(context, target, depth, 1) == ["near"]


def test_points_behind_and_beside_a_camera_are_not_in_its_view():
    points = np.array([[0, 0, 1.0], [0, 0, -1.0], [0.6, 0, 1.0], [0.4, 0, 1.0]])
    cameras = views(looking((0, 0, 0), 0.0, "ahead"), looking((0, 0, 0), np.pi, "back"))
    assert in_view(cameras, points).tolist() == [
        [True, False, False, True],
        [False, True, False, False],
    ]


def test_few_of_many_are_spread_over_all():
    assert list(evenly_spread(range(10), 3)) == [0, 4, 8]
    assert list(evenly_spread(range(2), 3)) == [0, 1]
    assert list(evenly_spread([])) == []
