"""The photographs of a pass: those that see what the targets show, then those that stand near."""

from __future__ import annotations

import geoverse_models as micro
import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.completers import ContextView
from gvtools.completers.geoverse.context_views import covisible_views, nearest_views


def looking(centre: tuple[float, float, float], angle: float, name: str) -> Cameras:
    """A camera in a place, turned about y."""
    pose = np.eye(4)
    pose[:3, :3] = micro.rotation((0, 1, 0), angle).T
    pose[:3, 3] = -pose[:3, :3] @ np.array(centre)
    K = np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
    return Cameras(K[None], pose[None], np.array([40]), np.array([30]), (name,))


def photographs(*cameras: Cameras) -> list[ContextView]:
    return [ContextView(c.names[0], c, np.zeros((30, 40, 3), np.float32)) for c in cameras]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_the_nearest_views_stand_and_look_like_the_targets(scale, shift):
    def place(x: float, angle: float, name: str) -> Cameras:
        return looking((scale * (x + shift), 0, 0), angle, name)

    context = photographs(
        place(0, 0, "left"),
        place(10, 0, "right"),
        place(1, np.pi, "behind"),
        place(4, 0, "middle"),
        place(1, 0.1, "beside"),
    )

    def chosen(count: int, *targets: Cameras) -> list[str]:
        joined = micro.concatenate(list(targets))
        return [view.name for view in nearest_views(context, joined, count)]

    near = place(1, 0, "target")
    assert chosen(1, near) == ["beside"]
    assert chosen(2, near) == ["beside", "left"]
    assert chosen(1, place(1, np.pi, "turned")) == ["behind"]
    assert chosen(1, place(9, 0, "target")) == ["right"]
    # The first serves all targets; each then has its own: not the three that are best for one.
    assert chosen(1, near, place(9.5, 0, "far")) == ["middle"]
    assert set(chosen(3, near, place(9.5, 0, "far"))) == {"middle", "beside", "right"}
    everything = chosen(9, near)
    assert sorted(everything) == sorted(view.name for view in context)
    assert everything[0] == "beside" and everything[-1] == "behind"


@pytest.mark.parametrize("shift", [0.0, 3e6])
def test_from_one_place_the_nearest_view_is_the_one_that_looks_the_same_way(shift):
    centre = (shift, -shift, shift / 3)
    context = photographs(*(looking(centre, angle, f"{angle}") for angle in (0.0, 1.0, 2.0, 3.0)))
    for angle in (0.1, 1.1, 2.1, 2.9):
        (found,) = nearest_views(context, looking(centre, angle, "target"), 1)
        assert found.name == f"{round(angle)}.0"


def wall(distance: float) -> np.ndarray:
    """(30, 40) depth of a wall straight ahead."""
    return np.full((30, 40), distance, np.float32)


def names(views: list[ContextView]) -> list[str]:
    return [view.name for view in views]


def test_a_view_that_sees_the_target_comes_before_one_that_stands_nearer():
    target = looking((0, 0, 0), 0.0, "target")
    context = photographs(
        looking((0.1, 0, 0), 1.2, "turned away"), looking((0, 0, -2), 0.0, "behind it")
    )
    assert names(nearest_views(context, target, 1)) == ["turned away"]
    assert names(covisible_views(context, target, wall(2.0)[None], 1)) == ["behind it"]


def test_the_second_view_shows_what_the_first_does_not():
    target = looking((0, 0, 0), 0.0, "target")
    context = photographs(
        looking((-1, 0, 0), 0.0, "left"),
        looking((-1.05, 0, 0), 0.0, "left again"),
        looking((1.2, 0, 0), 0.0, "right"),
    )
    assert names(covisible_views(context, target, wall(2.0)[None], 2)) == ["left", "right"]
    everything = covisible_views(context, target, wall(2.0)[None], 9)
    assert sorted(names(everything)) == ["left", "left again", "right"]


def test_what_hides_behind_a_photographs_own_surface_is_not_seen_by_it():
    target = looking((0, 0, 0), 0.0, "target")
    near, far = looking((0.1, 0, 0), 0.0, "near"), looking((0.6, 0, 0), 0.0, "far")
    picture = np.zeros((30, 40, 3), np.float32)

    def chosen(depth: np.ndarray | None) -> str:
        context = [ContextView("near", near, picture, depth), ContextView("far", far, picture)]
        return covisible_views(context, target, wall(2.0)[None], 1)[0].name

    assert chosen(None) == chosen(wall(2.0)) == chosen(0 * wall(1.0)) == "near"
    # A board before the camera.
    assert chosen(wall(0.5)) == "far"


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_choice_hangs_on_no_unit(scale):
    target = looking((0, 0, 0), 0.0, "target")
    context = photographs(
        looking((0.1 * scale, 0, 0), 1.2, "turned"), looking((0, 0, -2 * scale), 0.0, "behind")
    )
    assert names(covisible_views(context, target, wall(2.0 * scale)[None], 1)) == ["behind"]


def test_without_depth_the_nearest_stand_in():
    target = looking((0, 0, 0), 0.0, "target")
    context = photographs(looking((3, 0, 0), 0.0, "far"), looking((0.1, 0, 0), 0.0, "near"))
    for nothing in (0.0, np.nan, np.inf):
        depth = np.full((1, 30, 40), nothing, np.float32)
        assert names(covisible_views(context, target, depth, 1)) == ["near"]
