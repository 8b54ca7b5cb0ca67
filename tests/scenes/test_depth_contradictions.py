from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes_workspace import PINHOLE, frame, ramp, save, transforms

from gvtools.cameras import Cameras
from gvtools.scenes.depth_contradictions import depth_findings
from gvtools.scenes.inspection import inspect
from gvtools.scenes.registration import register_depth
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.scenes.transforms import read_transforms

FOCAL = 45
X, Y = np.meshgrid((np.arange(96) + 0.5 - 48) / FOCAL, (np.arange(72) + 0.5 - 36) / FOCAL)


def place(i: int) -> float:
    """Where the camera of a frame is along x, scene units: it does not go evenly."""
    return 0.2 * i + -0.06 * (i % 2)


def slanted(i: int) -> np.ndarray:
    """(72, 96) depth of a plane z = 2 + X / 4, scene units."""
    return (2 + place(i) / 4) / (1 - X / 4)


def slats(i: int) -> np.ndarray:
    """(72, 96) depth of slats at z = 1.2 before a wall at z = 2."""
    return np.where(np.floor((place(i) + 1.2 * X) * 4) % 2, 1.2, 2.0)


def warned(root: Path, depth_of: Callable[[int], np.ndarray]) -> list[str]:
    """What a check of six views says of their depth."""
    frames = []
    for i in range(6):
        save(root / f"images/{i}.png", ramp())
        np.save(root / f"{i}.npy", depth_of(i).astype(np.float32))
        one = frame(f"images/{i}.png", depth_file_path=f"{i}.npy", depth_unit_scale_factor=1.0)
        # The camera looks along +z of the world, right along its x.
        pose = np.diag([1.0, -1, -1, 1])
        pose[0, 3] = place(i)
        frames.append({**one, "transform_matrix": pose.tolist()})
    lens = {**PINHOLE, "fl_x": FOCAL, "fl_y": FOCAL}
    found = inspect(read_transforms(transforms(root, frames, **lens))).findings
    return [item.message for item in found if "contradicts the poses" in item.message]


@pytest.mark.parametrize("lacking", [1, 1.05, 1.2, 0.8, 1000, 0.001, 5])
def test_depth_whose_unit_contradicts_the_poses(tmp_path, lacking):
    said = warned(tmp_path, lambda i: slanted(i) / lacking)
    assert len(said) == (abs(lacking - 1) > 0.1)
    if said:
        times = float(said[0].split("if depth were ")[1].split(" times")[0])
        assert times == pytest.approx(lacking, rel=0.15)


@pytest.mark.parametrize(
    ("depth_of", "reason"),
    [
        (slats, ""),
        (lambda i: slanted(i)[:, ::-1], "mirrored"),
        (lambda i: slanted(20 * (i % 3)), "of other frames"),
        (lambda i: slats(i + 1), "fits the frame after its own"),
        (lambda i: slanted(i) * np.sqrt(1 + X**2 + Y**2), "as distances along the rays"),
    ],
)
def test_depth_of_other_frames_or_cameras(tmp_path, depth_of, reason):
    assert [reason in line for line in warned(tmp_path, depth_of)] == [True] * bool(reason)


LENGTH, SIZE = 240.0, (320, 240)
CAMERA = Cameras.pinhole(*SIZE, focal=LENGTH)


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
        where = (over * 100 + 300).astype(np.float32), (down * 100 + 200).astype(np.float32)
        shade = cv2.remap(fine, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        texture = grey + 150 * shade
        rgb[hit] = np.clip(texture, 0, 255).astype(np.uint8)[hit, None]
        depth[hit] = z
    return rgb, depth


def moved(depth: np.ndarray, right: float, down: float) -> np.ndarray:
    return cv2.warpAffine(
        depth, np.array([[1.0, 0, right], [0, 1, down]]), SIZE, flags=cv2.INTER_NEAREST
    )


def seen_by(depth: np.ndarray, *, focal: float = LENGTH, beside: float = 0.0) -> np.ndarray:
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
        (lambda depth: seen_by(depth, focal=LENGTH * 585 / 525), "are 0.89"),
        (lambda depth: depth + 0.3, "or -0.3"),
        (lambda depth: 1.2 * depth, "if it were 0.829 times"),
    ],
)
def test_depth_that_is_not_of_its_pictures(change, said):
    found = said_of(change)
    assert [said in line for line in found] == [True] * bool(said), found


@pytest.mark.parametrize(
    ("flip", "said"),
    [(np.fliplr, "mirrored"), (np.flipud, "upside down"), (lambda x: x[::-1, ::-1], "by half")],
)
def test_depth_that_is_turned_over_where_nothing_moves(flip, said):
    (line,) = said_of(flip, step=0)
    assert f"depth is {said}" in line.replace("turned ", "")


def said_of(change, *, step=0.06):
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
