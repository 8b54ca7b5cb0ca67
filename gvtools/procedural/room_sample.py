"""The sample room: drawn from a seed, photographed along a path, written as a COLMAP workspace.

Every picture, depth map and sparse point is exact up to the noise that is added on purpose, so
what a run makes of the room can be measured. No file is downloaded.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.procedural.furnished_room import Room, furnished_room
from gvtools.scenes.ray_casting import Grid, Hits, cast, shade
from gvtools.scenes.room_light import bake
from gvtools.scenes.sample_workspace import SampleContent, is_written, write_sample

Float64 = NDArray[np.float64]

AMBIENT = np.array([0.42, 0.42, 0.44])
CONTEXT_SHARE = 0.4  # of the views
CONTEXT_SWEEP = (0.0, 1.25)  # radians along the path, from its start
TARGET_SWEEP = (0.15, 2.9)
POINTS_PER_VIEW = 220
DETECTION_NOISE = 0.3  # standard deviation, pixels
SAME_SURFACE = 0.01  # relative z-depth by which a point may differ from the pixel it falls in


@dataclass(frozen=True)
class RoomSample:
    """A written room.

    Attributes:
        folder: the COLMAP workspace.
        context: names of the views to reconstruct from; they leave parts of the room unseen.
        targets: names of the views to predict, along a path that leads away from the context.
            Their own images and depth maps are the truth.
        depth_truth: names of the views with a true depth map: all of them.
        seed: which room.
    """

    folder: Path
    context: tuple[str, ...]
    targets: tuple[str, ...]
    depth_truth: tuple[str, ...]
    seed: int


def write_room(
    folder: Path,
    *,
    seed: int = 0,
    views: int = 20,
    width: int = 480,
    height: int = 360,
) -> RoomSample:
    """Write the room of a seed; a folder that holds it already is left as it is.

    The world's z axis points up, the floor is z = 0, the unit is the metre. Cameras are pinholes
    with one K. ``images``, ``sparse/0`` (binary) and ``stereo/depth_maps`` (geometric, exact
    z-depth at pixel centres) are those of a COLMAP dense workspace.

    Args:
        folder: the workspace; absent, empty, or written by the same call before.
        seed: 0 or more.
        views: of context and targets together, at least 4.
        width: of the images, pixels.
        height: of the images, pixels.

    Raises:
        OptionError: a negative seed, fewer than 4 views, or images below 16 x 16 pixels.
        ProjectError: the folder holds something else or cannot be written.
    """
    if seed < 0 or views < 4 or width < 16 or height < 16:
        raise OptionError(
            f"room: seed {seed}, {views} views of {width}x{height}; expected a seed of 0 or more, "
            "at least 4 views and images of at least 16x16"
        )
    folder = Path(folder)
    count = max(2, round(views * CONTEXT_SHARE))
    context = tuple(f"context_{i:02d}.png" for i in range(count))
    targets = tuple(f"target_{i:02d}.png" for i in range(views - count))
    sample = RoomSample(folder, context, targets, context + targets, seed)
    record: dict[str, Any] = {"sample": "room", "version": 1, "width": width, "height": height}
    record |= {key: value for key, value in asdict(sample).items() if key != "folder"}
    if is_written(folder, record):
        return sample
    room = furnished_room(seed)
    rng = np.random.default_rng([seed, 21])
    cameras = _path(room.size, context, targets, width=width, height=height, rng=rng)
    write_sample(folder, _photographed(room, cameras, rng), record=record)
    return sample


def _path(
    size: Float64,
    context: tuple[str, ...],
    targets: tuple[str, ...],
    *,
    width: int,
    height: int,
    rng: np.random.Generator,
) -> Cameras:
    """Cameras on an ellipse round the middle of the room, looking across it."""
    focal = width * rng.uniform(0.7, 0.78)
    x, y = np.array([width, height]) * (0.5 + rng.uniform(-0.02, 0.02, 2))
    K = np.array([[focal, 0, x], [0, focal * 1.004, y], [0, 0, 1]])
    start, sense = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1])
    sweep = np.concatenate(
        [np.linspace(*CONTEXT_SWEEP, len(context)), np.linspace(*TARGET_SWEEP, len(targets))]
    )
    poses = []
    for i, along in enumerate(start + sense * sweep):
        axis = np.array([np.cos(along), np.sin(along)]) * (size[:2] / 2 - 1.2)
        # Context views alternate in height, as somebody holding a camera does.
        up = 1.45 + (0.22 * (i % 2) - 0.11 if i < len(context) else 0.08 * np.sin(3 * along))
        eye = np.array([*(size[:2] / 2 + axis), up])
        aim = np.array([*(size[:2] / 2 - 0.5 * axis), 0.95])
        poses.append(look_at(eye, aim))
    count = len(poses)
    return Cameras(
        np.repeat(K[None], count, axis=0),
        np.stack(poses),
        np.full(count, width),
        np.full(count, height),
        context + targets,
    )


def look_at(eye: Float64, aim: Float64) -> Float64:
    """(4, 4) cam_from_world of a level camera at ``eye`` that looks at ``aim``; z is up."""
    forward = aim - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def _photographed(room: Room, cameras: Cameras, rng: np.random.Generator) -> SampleContent:
    lights = bake(
        room.patches, solids=room.solids, lamps=room.lamps, ambient=AMBIENT, room=room.size
    )
    with ThreadPoolExecutor(max_workers=2) as pool:
        shots = list(pool.map(partial(_shot, room, lights), cameras))
    images = [image for image, _, _ in shots]
    grids = [grid for _, grid, _ in shots]
    hits = [hit for _, _, hit in shots]
    points, colors, patch = _detected(images, grids, hits, rng)
    tracks = _tracks(cameras, hits, points, patch)
    tracks[2][:] += rng.normal(0, DETECTION_NOISE, tracks[2].shape)
    kept, point_index = np.unique(tracks[0], return_inverse=True)
    return SampleContent(
        cameras=cameras,
        images=images,
        depths=[hit.z.astype(np.float32) for hit in hits],
        points=points[kept],
        colors=colors[kept],
        tracks=(point_index, *tracks[1:]),
    )


def _shot(
    room: Room, lights: list[NDArray[np.float32]], camera: Cameras
) -> tuple[NDArray[np.uint8], Grid, Hits]:
    """A picture of 2 x 2 samples a pixel, and what the pixel centres hit."""
    image = shade(room.patches, lights, *cast(room.patches, camera, supersample=2))
    return image, *cast(room.patches, camera)


def _detected(
    images: list[NDArray[np.uint8]], grids: list[Grid], hits: list[Hits], rng: np.random.Generator
) -> tuple[Float64, NDArray[np.uint8], NDArray[np.int16]]:
    """Surface points where the pictures have detail: positions, colours, and their patches."""
    points, colors, patches = [], [], []
    for image, grid, hit in zip(images, grids, hits, strict=True):
        gradient = np.hypot(*np.gradient(image.astype(np.float64).mean(-1))).ravel()
        chance = np.where(hit.patch.ravel() >= 0, gradient + 0.2, 0)
        chosen = rng.choice(
            chance.size, min(POINTS_PER_VIEW, chance.size // 4), False, chance / chance.sum()
        )
        y, x = np.divmod(np.sort(chosen), image.shape[1])
        points.append(grid.center + hit.z[y, x][:, None] * grid.directions(y, x))
        colors.append(image[y, x])
        patches.append(hit.patch[y, x])
    return np.concatenate(points), np.concatenate(colors), np.concatenate(patches)


def _tracks(
    cameras: Cameras, hits: list[Hits], points: Float64, patch: NDArray[np.int16]
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float64]:
    """Point index, view index and projection wherever at least two views see a point.

    A view sees a point when the pixel that it falls in shows the same patch at the same depth.
    """
    xy, z = cameras.project(points)
    seen = np.zeros(z.shape, bool)
    for view, hit in enumerate(hits):
        height, width = hit.z.shape
        with np.errstate(invalid="ignore"):
            inside = (xy[view] >= 0).all(-1) & (xy[view, :, 0] < width) & (xy[view, :, 1] < height)
        rows = np.flatnonzero(inside)
        x, y = np.floor(xy[view, rows]).astype(int).T
        near = np.abs(hit.z[y, x] / z[view, rows] - 1) < SAME_SURFACE
        seen[view, rows] = near & (hit.patch[y, x] == patch[rows])
    seen[:, seen.sum(0) < 2] = False
    point_index, view_index = np.nonzero(seen.T)
    return point_index, view_index, xy[view_index, point_index]
