"""What a posed RGB-D recording holds, and what readers of its layouts have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from gvtools.errors import ProjectError
from gvtools.scenes.photographs import named
from gvtools.scenes.scene import Finding, natural_key
from gvtools.settings import Settings
from gvtools.untrusted import read_json, read_text

Float64 = NDArray[np.float64]
Matrix = Annotated[list[list[float]], BeforeValidator(lambda value: np.asarray(value).tolist())]

PICTURES = (".jpg", ".jpeg", ".png")
MILLIMETRES = 1e-3


class RgbdOptions(Settings):
    """What a posed RGB-D folder does not tell by itself; None means the layout's own value.

    The same names may stand in a file ``rgbd.json`` in the folder; values given here win.
    Intrinsics are as published with such recordings: the first pixel's centre is (0, 0).
    """

    section = "rgbd"

    depth_unit: float | None = Field(None, gt=0)
    """Metres per stored unit (TUM 1/5000, others 1/1000)."""
    color_K: Matrix | None = None
    """(3, 3) intrinsics of the colour camera, pixels."""
    depth_K: Matrix | None = None
    """(3, 3) intrinsics of the depth camera, pixels; None: depth is of the colour camera."""
    color_from_depth: Matrix | None = None
    """(4, 4) rigid, metres; None with ``depth_K`` given: the same place."""
    distortion: list[float] | None = None
    """k1, k2, p1, p2, k3 of the colour camera, as OpenCV has them."""
    depth_max: float | None = Field(None, gt=0)
    """Metres; greater readings are ignored."""
    max_time_difference: float = Field(0.02, gt=0)
    """Seconds between colour, depth and pose of one frame (TUM)."""


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """One frame of a recording.

    Attributes:
        name: the view's name.
        color: the picture.
        depth: the depth map, None when the frame has none.
        world_from_cam: (4, 4) as read.
        where: the pose's file, for messages.
    """

    name: str
    color: Path
    depth: Path | None
    world_from_cam: Float64
    where: str


@dataclass(frozen=True, eq=False)
class Recording:
    """What a layout's reader found.

    Attributes:
        root: the folder.
        frames: with a pose each.
        color_K: (3, 3) as published (integer pixel centres).
        distortion: k1, k2, p1, p2, k3 of the colour camera as OpenCV has them; empty for none.
        depth_K: (3, 3) as published, None where depth is of the colour camera.
        color_from_depth: (4, 4), metres; None: the same place.
        depth_unit: metres per stored unit.
        findings: what was met.
    """

    root: Path
    frames: Sequence[RgbdFrame]
    color_K: Float64
    distortion: tuple[float, ...] = ()
    depth_K: Float64 | None = None
    color_from_depth: Float64 | None = None
    depth_unit: float = MILLIMETRES
    findings: Sequence[Finding] = field(default_factory=tuple)


def posed_frames(
    files: Sequence[tuple[Path, Path, Path]], *shapes: tuple[int, int]
) -> tuple[list[RgbdFrame], list[Finding]]:
    """Frames of which each has a pose file of its own.

    Pictures without a pose file, and those whose pose is infinite because the tracker lost them,
    are left out and reported.

    Args:
        files: picture, depth map and pose of each frame; the last two may be absent.
        shapes: that a pose's matrix may have.
    """
    frames, unposed, lost = [], [], []
    for color, depth, pose in files:
        if not pose.is_file():
            unposed.append(color.name)
            continue
        matrix = load_matrix(pose, *shapes)
        if np.isinf(matrix).any():
            lost.append(color.name)
            continue
        depth_or_none = depth if depth.is_file() else None
        frames.append(RgbdFrame(color.name, color, depth_or_none, matrix, str(pose)))
    findings = [
        Finding(
            "warning", f"{len(names)} of {len(files)} frames {reason}: dropped ({named(names)})"
        )
        for names, reason in ((unposed, "have no pose"), (lost, "were lost by the tracker"))
        if names
    ]
    return frames, findings


def pictures_in(folder: Path) -> list[Path]:
    """The folder's pictures in natural order of their names."""
    paths = (path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    return sorted(paths, key=lambda path: natural_key(path.name))


def pinhole(values: Sequence[float]) -> Float64:
    """(3, 3) intrinsics of fx, fy, cx, cy, pixels."""
    fx, fy, cx, cy = values
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def open3d_intrinsics(path: Path) -> Float64:
    """(3, 3) intrinsics of Open3D's JSON form, which lists them column by column."""
    try:
        values = read_json(path)["intrinsic_matrix"]
        return np.array(values, np.float64).reshape(3, 3).T
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise ProjectError(
            f"{path}: {type(error).__name__} ({error}); expected Open3D's form with "
            "'intrinsic_matrix' as nine numbers, column by column"
        ) from None


def load_matrix(path: Path, *shapes: tuple[int, int]) -> Float64:
    """A matrix in a text file."""
    expected = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
    try:
        text = read_text(path).replace(",", " ")
        matrix = np.loadtxt(text.splitlines(), np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ProjectError(f"{path}: unreadable ({reason}); expected {expected} numbers") from None
    if matrix.shape not in shapes:
        shape = "x".join(str(length) for length in matrix.shape)
        raise ProjectError(f"{path}: {shape} numbers; expected {expected}")
    return matrix
