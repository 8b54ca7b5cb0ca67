"""Recorded depth that other views look through."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.depth.source import LEAST, RecordedDepth, contradicted
from gvtools.scenes.scene import Frame, Scene, View

HEIGHT, WIDTH, FAR = 40, 60, 3.0
K = np.array([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])


def camera(x: float = 0.0, name: str = "one") -> Cameras:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Cameras(K[None], pose[None], np.array([WIDTH]), np.array([HEIGHT]), (name,))


def wall(depth: float = FAR) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), depth, np.float32)


def with_blob(depth: float = 2.0) -> np.ndarray:
    """A wall with a square that floats at another depth."""
    out = wall()
    out[10:20, 25:35] = depth
    return out


OTHERS = [camera(0.1), camera(-0.1), camera(0.15)]


def test_what_others_look_through_is_contradicted():
    wrong = contradicted(with_blob(), camera(), [(wall(), each) for each in OTHERS])
    np.testing.assert_array_equal(wrong, with_blob() < FAR)


def test_one_view_alone_contradicts_nothing():
    witnesses = [(wall(), each) for each in OTHERS[: LEAST - 1]]
    assert not contradicted(with_blob(), camera(), witnesses).any()
    blind = [(np.zeros_like(wall()), each) for each in OTHERS]
    assert not contradicted(with_blob(), camera(), blind).any()


def test_what_as_many_others_confirm_stays():
    near = wall(2.0)
    agreeing, piercing = [(near, each) for each in OTHERS[:2]], [(wall(), each) for each in OTHERS]
    assert not contradicted(with_blob(), camera(), [*agreeing, *piercing[:2]])[
        with_blob() < FAR
    ].any()
    assert contradicted(with_blob(), camera(), [*agreeing, *piercing])[with_blob() < FAR].all()


def test_what_others_do_not_see_for_something_nearer_stays():
    assert not contradicted(wall(), camera(), [(wall(1.0), each) for each in OTHERS]).any()


@pytest.mark.parametrize("off", [0.99, 0.97])
def test_noise_is_no_contradiction(off):
    assert not contradicted(with_blob(FAR * off), camera(), [(wall(), c) for c in OTHERS]).any()


def test_a_real_object_in_front_of_a_wall_stays():
    # A square of 0.4 at depth 2, as each camera sees it; its rim hides and shows the wall.
    def seen(x: float) -> np.ndarray:
        out = wall()
        u = (np.arange(WIDTH) + 0.5 - 30) / 50 * 2.0 + x
        v = (np.arange(HEIGHT) + 0.5 - 20) / 50 * 2.0
        out[np.ix_(np.abs(v) < 0.2, np.abs(u) < 0.2)] = 2.0
        return out

    others = [(seen(x), camera(x)) for x in (0.1, -0.1, 0.15, -0.15)]
    wrong = contradicted(seen(0.0), camera(), others)
    assert wrong.sum() <= 0.1 * (seen(0.0) < FAR).sum()


def test_beside_something_thin_a_view_does_not_look_through():
    bar = wall()
    bar[:, 30] = 2.0
    # Its pose is off by a pixel, so that it shows the wall where the bar is.
    off = wall()
    off[:, 31] = 2.0
    witnesses = [(off, camera()), (off, camera()), (off, camera())]
    assert not contradicted(bar, camera(), witnesses).any()


def test_what_masks_leave_out_neither_speaks_nor_counts():
    def view(name: str, depth: np.ndarray, use: bool) -> View:
        frame = Frame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth, np.full(depth.shape, use))
        return View(name, camera(0.0, name), lambda: frame, has_depth=True)

    for first, others in ((True, False), (False, True)):
        views = (
            view("a", with_blob(), first),
            view("b", wall(), others),
            view("c", wall(), others),
        )
        scene = Scene(Path("."), "rgbd", views)
        source = RecordedDepth([each.name for each in views])
        found = source.depth(scene, views[0], views[0].load())
        assert found.contradicted == 0
        np.testing.assert_array_equal(found.depth, with_blob())


def test_views_of_another_size_are_compared_where_they_look():
    half = np.full((HEIGHT // 2, WIDTH // 2), FAR, np.float32)
    small = [(half, each.resized(WIDTH // 2, HEIGHT // 2)) for each in OTHERS]
    np.testing.assert_array_equal(contradicted(with_blob(), camera(), small), with_blob() < FAR)


def test_recorded_depth_is_dropped_counted_and_not_trusted():
    def view(name: str, x: float, depth: np.ndarray) -> View:
        frame = Frame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth, None)
        return View(name, camera(x, name), lambda: frame, has_depth=True)

    views = (
        view("a", 0.0, with_blob()),
        view("b", 0.1, wall()),
        view("c", -0.1, wall()),
        replace(view("d", 0.2, wall()), has_depth=False),
    )
    scene = Scene(Path("."), "rgbd", views)
    first = views[0]
    alone = RecordedDepth().depth(scene, first, first.load())
    assert alone.contradicted == 0
    np.testing.assert_array_equal(alone.depth, with_blob())
    checked = RecordedDepth([each.name for each in views]).depth(scene, first, first.load())
    assert checked.contradicted == (with_blob() < FAR).sum()
    np.testing.assert_array_equal(checked.depth, np.where(with_blob() < FAR, 0, wall()))
    np.testing.assert_array_equal(first.load().depth, with_blob())
