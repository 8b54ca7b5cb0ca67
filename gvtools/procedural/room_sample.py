"""The sample room: drawn from a seed, photographed along a path, written as a COLMAP workspace.

Every picture, depth map and sparse point is exact up to the noise that is added on purpose, so
what a run makes of the room can be measured. No file is downloaded.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64, invert_rigid
from gvtools.errors import OptionError
from gvtools.kernels import KernelSet
from gvtools.procedural.builder import ProceduralScene
from gvtools.procedural.furnished_room import furnished_room
from gvtools.procedural.render import develop, radiance, to_srgb
from gvtools.procedural.sample_workspace import (
    SampleContent,
    WrittenSample,
    is_written,
    write_sample,
)
from gvtools.trajectories import look_at
from gvtools.view_selection import in_view

Float32 = NDArray[np.float32]

CONTEXT_SHARE = 0.4  # of the views
CONTEXT_SWEEP = (0.0, 1.25)  # radians along the path, from its start
TARGET_SWEEP = (0.15, 2.9)
POINTS_PER_VIEW = 220
DETECTION_NOISE = 0.3  # standard deviation, pixels
SAME_SURFACE = 0.005  # relative z-depth by which a point may differ from the pixel it falls in


def write_room(
    folder: Path, *, seed: int = 0, views: int = 20, width: int = 480, height: int = 360
) -> WrittenSample:
    """Write the room of a seed; a folder that holds it already is left as it is.

    The world's z axis points up, the floor is z = 0, the unit is the metre. Cameras are pinholes
    with one K. ``images``, ``sparse/0`` (binary) and ``stereo/depth_maps`` (geometric, exact
    z-depth at pixel centres) are those of a COLMAP dense workspace. Targets follow a path that
    leads away from the context. There are at least 4 views of both together.
    """
    folder = Path(folder)
    check_options(seed, views, width=width, height=height)
    context, targets = _names(views)
    sample = WrittenSample(folder, context, targets, context + targets, seed)
    record = sample.record("room", version=2, width=width, height=height)
    if is_written(folder, record):
        return sample
    room, cameras, rng = room_views(seed, views, width=width, height=height)
    write_sample(folder, photograph_room(room, cameras, rng), record=record)
    return sample


def check_options(seed: int, views: int, *, width: int, height: int) -> None:
    """Refuse what no sample can be drawn with."""
    if seed < 0 or views < 4 or width < 16 or height < 16:
        raise OptionError(
            f"room: seed {seed}, {views} views of {width}x{height}; expected a seed of 0 or more, "
            "at least 4 views and images of at least 16x16"
        )


def room_views(
    seed: int, views: int, *, width: int, height: int
) -> tuple[ProceduralScene, Cameras, np.random.Generator]:
    """The room, its cameras (context before targets), and the generator for what follows."""
    room = furnished_room(seed)
    rng = np.random.default_rng([seed, 21])
    size = room.geometry.rooms[0, 1]
    return room, _path(size, *_names(views), width=width, height=height, rng=rng), rng


def _names(views: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of context and targets."""
    count = max(2, round(views * CONTEXT_SHARE))
    context = tuple(f"context_{i:02d}.png" for i in range(count))
    return context, tuple(f"target_{i:02d}.png" for i in range(views - count))


def compile_kernels() -> None:
    """Compile, or load from numba's cache, what photographing a room needs."""
    room, cameras, _ = room_views(0, 4, width=16, height=16)
    light, _ = radiance(room.geometry, room.look, cameras)
    to_srgb(light, 1.0)


KERNELS = KernelSet("renderer", compile_kernels, develop)


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
    angle = start + sense * sweep
    axis = np.stack([np.cos(angle), np.sin(angle)], -1) * (size[:2] / 2 - 1.2)
    # Context views alternate in height, as somebody holding a camera does.
    number = np.arange(len(angle))
    up = np.where(
        number < len(context), 1.34 + 0.22 * (number % 2), 1.45 + 0.08 * np.sin(3 * angle)
    )
    eye = np.column_stack([size[:2] / 2 + axis, up])
    aim = np.column_stack([size[:2] / 2 - 0.5 * axis, np.full(len(angle), 0.95)])
    poses = invert_rigid(look_at(eye, aim, up=[0.0, 0.0, 1.0]))
    return Cameras.alike(K, poses, size=(width, height), names=context + targets)


def photograph_room(
    room: ProceduralScene,
    cameras: Cameras,
    rng: np.random.Generator,
    *,
    per_view: int = POINTS_PER_VIEW,
) -> SampleContent:
    """Pictures, depth, and noisy detections of surface points in them, ``per_view`` or fewer."""
    light, depth = radiance(room.geometry, room.look, cameras)
    images = to_srgb(light, room.key / float(light.mean()))
    points, colors = _detected(cameras, images, depth, rng, per_view=per_view)
    point_index, view_index, xy = _tracks(cameras, depth, points)
    xy += rng.normal(0, DETECTION_NOISE, xy.shape)
    kept, point_index = np.unique(point_index, return_inverse=True)
    tracks = point_index, view_index, xy
    return SampleContent(cameras, list(images), list(depth), points[kept], colors[kept], tracks)


def _detected(
    cameras: Cameras,
    images: NDArray[np.uint8],
    depth: Float32,
    rng: np.random.Generator,
    *,
    per_view: int,
) -> tuple[Float64, NDArray[np.uint8]]:
    """Surface points where the pictures have detail: positions and colours."""
    points, colors = [], []
    for view, image in enumerate(images):
        chance = np.hypot(*np.gradient(image.astype(np.float64).mean(-1))).ravel() + 0.2
        count = min(per_view, chance.size // 4)
        chosen = rng.choice(chance.size, count, False, chance / chance.sum())
        y, x = np.divmod(np.sort(chosen), image.shape[1])
        local = cameras.rays(view)[y, x] * depth[view, y, x, None]
        world = cameras.world_from_cam[view]
        points.append(local @ world[:3, :3].T + world[:3, 3])
        colors.append(image[y, x])
    return np.concatenate(points), np.concatenate(colors)


def _tracks(
    cameras: Cameras, depth: Float32, points: Float64
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float64]:
    """Point index, view index and projection wherever at least two views see a point.

    A view sees a point when the pixel that it falls in shows something at the point's depth.
    """
    xy, z = cameras.project(points)
    seen = in_view(cameras, points)
    view, row = np.nonzero(seen)
    x, y = np.floor(xy[view, row]).astype(int).T
    seen[view, row] = np.abs(depth[view, y, x] / z[view, row] - 1) < SAME_SURFACE
    seen[:, seen.sum(0) < 2] = False
    point_index, view_index = np.nonzero(seen.T)
    return point_index, view_index, xy[view_index, point_index]
