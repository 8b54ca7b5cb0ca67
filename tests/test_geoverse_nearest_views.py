from __future__ import annotations

import geoverse_models as micro
import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.completers import ContextView
from gvtools.completers.geoverse.completer import nearest_views


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
