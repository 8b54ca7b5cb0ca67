"""What exports of ARKit recordings have in common, whichever app wrote them.

ARKit's camera looks along -z with y up, its world has y up and metres. Depth and its confidence
come from the LiDAR scanner at a lower resolution (256x192 as a rule) than the picture, of the same
camera and the same window: intrinsics of the picture, scaled, are those of the depth map, and each
pixel of the picture takes the reading that it falls into. Confidence is low, medium or high; what
is low is no reading. ARKit counts the principal point from the picture's upper left corner, as
gvtools does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.scenes.data_sets.posed_pictures import (
    OPENCV_FROM_OPENGL,
    Float64,
    PosedPicture,
    posed_scene,
)
from gvtools.scenes.data_sets.sky import sky_findings
from gvtools.scenes.images import read_depth, read_mask, resize_nearest
from gvtools.scenes.photographs import Depth
from gvtools.scenes.rgbd_recording import MILLIMETRES
from gvtools.scenes.scene import Finding, Scene
from gvtools.untrusted import read_json

WORLD_UP = 1  # y


@dataclass(frozen=True)
class PhoneLayout:
    """How an app exports a recording.

    Attributes:
        name: the app's, which is the kind of its scenes.
        looks_like: its name and what its export holds, for messages.
        matches: whether a folder or file is such an export.
        read: it as a scene; ProjectError where nothing of it can be read.
    """

    name: str
    looks_like: str
    matches: Callable[[Path], bool]
    read: Callable[[Path], Scene]


def opencv_pose(world_from_cam: ArrayLike) -> Float64:
    """(4, 4) world_from_cam for OpenCV's camera axes.

    Args:
        world_from_cam: (4, 4) or (3, 4) for ARKit's, metres; the world stays as it is.
    """
    pose = np.eye(4)
    pose[:3] = np.asarray(world_from_cam, np.float64)[:3]
    return pose @ OPENCV_FROM_OPENGL


def readings(depth: NDArray[Any], confident: NDArray[np.bool_] | None) -> Depth:
    """(h, w) float32 z-depth, metres, with 0 where there is none or it is not to be trusted.

    Args:
        depth: (h, w) metres; NaN, infinite or negative is none.
        confident: a map of any size; False where confidence is low. None: all are trusted.
    """
    usable = np.isfinite(depth) & (depth > 0)
    if confident is not None:
        usable &= resize_nearest(confident, depth.shape[1], depth.shape[0])
    return np.where(usable, depth, 0).astype(np.float32)


def read_lidar(path: Path, *, confidence: Path | None) -> Depth:
    """A depth map of millimetres and the picture of its confidence, in which 0 is low.

    Args:
        path: 16-bit PNG or ``.npy``.
        confidence: 8-bit picture; None: all depth is used.
    """
    depth = read_depth(path, unit=MILLIMETRES)
    return readings(depth, None if confidence is None else read_mask(confidence))


def read_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file; empty where it is absent or damaged, as if it had no key."""
    try:
        found = read_json(path)
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def numbers(values: object, shape: tuple[int, ...]) -> Float64 | None:
    """An array of finite numbers of that shape, row by row; None where the values are others."""
    try:
        array = np.asarray(values, np.float64)
    except (OverflowError, TypeError, ValueError):
        return None
    if array.size != int(np.prod(shape)) or not np.isfinite(array).all():
        return None
    return array.reshape(shape)


def phone_scene(
    root: Path,
    name: str,
    pictures: Sequence[PosedPicture],
    *,
    upright: bool = True,
    findings: Iterable[Finding] = (),
) -> Scene:
    """The scene of an export, metric, in the poses' own world.

    Args:
        root: the export.
        name: the app's.
        pictures: poses are world_from_cam for OpenCV's axes.
        upright: whether y of the world points up, as gravity has it.
        findings: what the reader met.
    """
    scene = posed_scene(
        root, pictures, poses="world_from_cam", metric=True, findings=tuple(findings)
    )
    sky = sky_findings(scene.cameras.cam_from_world, WORLD_UP) if upright else []
    return replace(scene, kind=name, findings=(*scene.findings, *sky))


@dataclass
class LidarMaps:
    """Depth maps beside their confidence maps, and how many of either are there.

    Attributes:
        maps: depth maps that are there.
        bare: those of them without a confidence map.
    """

    maps: int = 0
    bare: int = 0

    def reader(self, depth: Path, confidence: Path) -> Callable[[Path], Depth]:
        """How a depth map is read: with its confidence where that is there."""
        there = confidence.is_file()
        if depth.is_file():
            self.maps += 1
            self.bare += not there
        return partial(read_lidar, confidence=confidence if there else None)

    def findings(self) -> list[Finding]:
        """One line when depth maps lack their confidence."""
        if not self.bare:
            return []
        line = f"{self.bare} of {self.maps} depth maps have no confidence map: all of them is used"
        return [Finding("info", line)]
