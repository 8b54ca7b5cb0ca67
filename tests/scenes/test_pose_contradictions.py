"""Cameras in the middle of a box whose walls are photographs far away, so that truth is known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import skimage.data
from scenes_workspace import sparse_points
from tiny_scan import without_depth

from gvtools.cameras import Cameras
from gvtools.scenes.inspection import contradiction_findings, contradictions, inspect, thumbnail
from gvtools.scenes.scene import Frame, Scene, SparsePoints, View

WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
FAR = 4.0  # distance of the walls, scene units
WALLS = ("astronaut", "coffee")  # seen along +z, and along -z


def wall_picture(camera: Cameras, name: str) -> np.ndarray:
    """(H, W, 3) uint8: the photograph on the plane z = FAR, 8 units wide, as the camera sees it."""
    photograph = cv2.resize(getattr(skimage.data, name)(), (400, 400), interpolation=cv2.INTER_AREA)
    from_pixel = np.array([[8 / 400, 0, -4], [0, 8 / 400, -4], [0, 0, 1]])
    pose = camera.cam_from_world[0]
    plane = np.stack([pose[:3, 0], pose[:3, 1], FAR * pose[:3, 2] + pose[:3, 3]], axis=1)
    H = camera.K[0] @ plane @ from_pixel
    return np.asarray(cv2.warpPerspective(photograph, H, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR))


def turned(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """(3, 3) rotation by degrees."""
    vector = np.radians([pitch, yaw, roll])
    return np.asarray(cv2.Rodrigues(vector)[0])


def camera_at(center: np.ndarray, rotation: np.ndarray) -> Cameras:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return Cameras.pinhole(WIDTH, HEIGHT, focal=FOCAL, cam_from_world=pose)


def walk(
    views: int = 12, *, spread: float = 0.02, wrong: tuple[int, ...] = (), lit: float = 0.0
) -> Scene:
    """Two views at each of places ``spread`` apart; those of ``wrong`` saw the other wall."""
    rng = np.random.default_rng(3)
    made = []
    for i in range(views):
        rotation = turned(*rng.uniform(-3, 3, 3))
        camera = camera_at(np.array([spread * (i // 2), *rng.uniform(-0.02, 0.02, 2)]), rotation)
        band = (np.arange(HEIGHT) // 12 + i) % 2
        rgb = wall_picture(camera, WALLS[i in wrong]) * (1 - lit * band[:, None, None])
        exposure = rng.uniform(0.6, 1.1)
        rgb = np.clip(255 * (rgb / 255.0) ** rng.uniform(0.8, 1.4) * exposure, 0, 255)
        frame = Frame(rgb.astype(np.uint8), np.full((HEIGHT, WIDTH), FAR, np.float32))
        made.append(
            View(f"{i:02d}.png", camera, partial(Frame, frame.rgb, frame.depth), has_depth=True)
        )
    return Scene(Path("walls"), "rgbd", tuple(made), metric=True)


def contradiction_messages(scene: Scene) -> list[str]:
    frames = dict(enumerate(view.load() for view in scene))
    depths = {
        i: float(np.median(frame.depth)) for i, frame in frames.items() if frame.depth is not None
    }
    thumbnails = {i: thumbnail(frame) for i, frame in frames.items()}
    return [item.message for item in contradiction_findings(scene, thumbnails, depths)]


def test_exposure_and_small_turns_are_no_contradiction() -> None:
    scene = walk()
    assert contradiction_messages(scene) == []
    assert contradiction_messages(without_depth(scene)) == []
    assert contradiction_messages(walk(lit=0.45)) == []


def test_half_of_the_views_with_poses_of_the_other_side_are_told() -> None:
    wrong = (1, 3, 5, 7, 9, 11)
    scene = walk(wrong=wrong)
    report = inspect(scene)
    assert report.ok
    (message,) = contradiction_messages(scene)
    assert message in {finding.message for finding in report.findings}
    said = "different things", "flickers in bands", "solve the poses"
    assert all(part in message for part in said)
    thumbnails = {i: thumbnail(view.load()) for i, view in enumerate(scene)}
    found = contradictions(scene, thumbnails, dict.fromkeys(thumbnails, FAR))
    assert message.startswith(f"{len(found)} pairs of views")
    for pair in found:
        a, b = (int(name[:2]) for name in pair.names)
        assert (a in wrong) != (b in wrong)
    assert {int(name[:2]) for pair in found for name in pair.names} == set(range(12))


def test_one_swapped_picture_is_told_without_depth_too() -> None:
    scene = without_depth(walk(wrong=(4,), spread=0.5))
    (message,) = contradiction_messages(scene)
    assert "04.png" in message


def points_of(scene: Scene, *, shared: bool) -> SparsePoints:
    """Points on the wall; each view's own, or all of them in all views."""
    rng = np.random.default_rng(0)
    count = 40
    sets = 1 if shared else len(scene)
    positions = np.column_stack([rng.uniform(-1, 1, (sets * count, 2)), np.full(sets * count, FAR)])
    view_index = np.repeat(np.arange(len(scene)), count)
    point_index = np.tile(np.arange(count), len(scene)) if shared else np.arange(sets * count)
    xy = np.array([scene.cameras[int(v)].project(positions[[p]])[0][0, 0]
                   for v, p in zip(view_index, point_index, strict=True)])  # fmt: skip
    return sparse_points(positions, point_index, view_index, xy)


def test_near_views_that_share_no_sparse_point_are_told() -> None:
    scene = without_depth(walk(views=4))
    assert contradiction_messages(replace(scene, points=points_of(scene, shared=True))) == []
    (message,) = contradiction_messages(replace(scene, points=points_of(scene, shared=False)))
    assert "0 of 40 sparse points shared" in message


def test_near_views_that_parallax_makes_different_are_not_told() -> None:
    scene = without_depth(walk(views=4, spread=0.2, wrong=(1, 3)))
    points = points_of(scene, shared=True)
    (message,) = contradiction_messages(replace(scene, points=points))
    assert "of the picture differs" in message
    points.positions[::10] *= 0.015  # one of ten stands close before the cameras
    assert contradiction_messages(replace(scene, points=points)) == []
