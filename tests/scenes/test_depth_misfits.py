from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.scenes.depth_contradictions import depth_findings
from gvtools.scenes.registration import register_depth
from gvtools.scenes.scene import Frame, Scene, View

FOCAL, SIZE = 240.0, (320, 240)
CAMERA = Cameras.pinhole(*SIZE, focal=FOCAL)


def boards(at: float) -> tuple[np.ndarray, np.ndarray]:
    """Picture and depth of textured boards before a wall, from a camera at ``at`` along x."""
    rng = np.random.default_rng(3)
    rgb, depth = np.zeros((*SIZE[::-1], 3), np.uint8), np.zeros(SIZE[::-1], np.float32)
    x, y, _ = np.moveaxis(CAMERA.rays(), -1, 0)
    for z in (3.0, *np.linspace(2.3, 1.2, 14)):
        left, top, grey = rng.uniform(-1.2, 1.6), rng.uniform(-0.9, 0.6), rng.uniform(60, 190)
        fine = cv2.GaussianBlur(rng.standard_normal((400, 600)).astype(np.float32), (0, 0), 2)
        over, down = x * z + at, y * z
        hit = (z == 3) | ((np.abs(over - left) < 0.18) & (np.abs(down - top) < 0.14))
        texture = grey + 150 * cv2.remap(
            fine,
            (over * 100 + 300).astype(np.float32),
            (down * 100 + 200).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
        rgb[hit] = np.clip(texture, 0, 255).astype(np.uint8)[hit, None]
        depth[hit] = z
    return rgb, depth


def moved(depth: np.ndarray, right: float, down: float) -> np.ndarray:
    return cv2.warpAffine(
        depth, np.array([[1.0, 0, right], [0, 1, down]]), SIZE, flags=cv2.INTER_NEAREST
    )


def seen_by(depth: np.ndarray, *, focal: float = FOCAL, beside: float = 0.0) -> np.ndarray:
    """The map of another camera, of another focal length and to the left."""
    there = np.eye(4)
    there[0, 3] = beside
    K = Cameras.pinhole(*SIZE, focal=focal).K[0]
    return register_depth(
        depth, CAMERA.K[0], K, color_from_depth=there, width=SIZE[0], height=SIZE[1]
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (np.asarray, ""),
        (lambda depth: 1.02 * depth, ""),
        (lambda depth: cv2.erode(depth, np.ones((5, 5))), ""),
        (lambda depth: moved(depth, 5, 0), "moved right by -5 and down by 0 pixels"),
        (lambda depth: moved(depth, -4, 6), "moved right by 4 and down by -6 pixels"),
        (lambda depth: seen_by(depth, beside=0.05), "moved right by -"),
        (lambda depth: seen_by(depth, focal=FOCAL * 585 / 525), "are 0.89"),
        (lambda depth: depth + 0.3, "or -0.3"),
        (lambda depth: 1.2 * depth, "if it were 0.829 times"),
    ],
)
def test_depth_that_is_not_of_its_pictures(change, said):
    found = told(change)
    assert [said in line for line in found] == [True] * bool(said), found


@pytest.mark.parametrize(
    ("flip", "said"),
    [(np.fliplr, "mirrored"), (np.flipud, "upside down"), (lambda x: x[::-1, ::-1], "by half")],
)
def test_depth_that_is_turned_over_where_nothing_moves(flip, said):
    (line,) = told(flip, step=0)
    assert f"depth is {said}" in line.replace("turned ", "")


def told(change, *, step=0.06):
    """What is said of six views, so far apart."""
    views = []
    for number in range(6):
        pose = np.eye(4)
        pose[0, 3] = -step * number
        camera = Cameras(CAMERA.K, pose[None], CAMERA.width, CAMERA.height, (f"{number}",))
        rgb, depth = boards(step * number)
        load = partial(Frame, rgb, np.ascontiguousarray(change(depth), np.float32))
        views.append(View(f"{number}", camera, load, has_depth=True))
    return [item.message for item in depth_findings(Scene(Path("."), "rgbd", tuple(views)))]
