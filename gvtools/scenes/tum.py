"""The TUM RGB-D layout: ``rgb.txt``, ``depth.txt`` and ``groundtruth.txt`` with time stamps.

Pictures, depth maps and poses are joined by the nearest time stamp, each depth map used once. Poses
are camera-to-world. Intrinsics come from ``camera-intrinsics.txt`` (3x3) or ``camera.json``
(Open3D's form) in the folder; otherwise those published for freiburg1, 2 or 3 when the folder's
name says so, with their distortion, and the driver's default when not. All of them count pixel
centres as integers.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.rgbd import RgbdLayout
from gvtools.scenes.rgbd_recording import (
    Recording,
    RgbdFrame,
    RgbdOptions,
    load_matrix,
    open3d_intrinsics,
    pinhole,
)
from gvtools.scenes.scene import Finding
from gvtools.trajectory_files import read_poses
from gvtools.untrusted import is_file, named_file, read_text

Float64 = NDArray[np.float64]

DEPTH_UNIT = 1 / 5000
# Depth maps within the limit of a picture, on average, at most.
MOST_CANDIDATES = 100
FILES = ("rgb.txt", "depth.txt", "groundtruth.txt")

# fx, fy, cx, cy and k1, k2, p1, p2, k3 as published with the benchmark; freiburg3 is rectified.
PUBLISHED = {
    "freiburg1": (
        (517.3, 516.5, 318.6, 255.3),
        (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    ),
    "freiburg2": (
        (520.9, 521.0, 325.1, 249.7),
        (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    ),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), ()),
}
DRIVER_DEFAULT = (525.0, 525.0, 319.5, 239.5)


def _matches(root: Path) -> bool:
    return all((root / name).is_file() for name in FILES)


def _record(root: Path, options: RgbdOptions) -> Recording:
    findings = []
    limit = options.max_time_difference
    colors, absent = frame_files(root, limit)
    truth = read_poses(root / "groundtruth.txt", layout="tum")
    assert truth.stamps is not None
    frames, unposed = [], 0
    for time, color, depth in colors:
        nearest = int(np.argmin(np.abs(truth.stamps - time)))
        if abs(truth.stamps[nearest] - time) > limit:
            unposed += 1
            continue
        where = f"{root / 'groundtruth.txt'}, time {truth.stamps[nearest]:.6f}"
        frames.append(RgbdFrame(color.name, color, depth, truth.poses[nearest], where))
    if unposed:
        message = f"{unposed} of {len(colors)} pictures have no pose within {limit:g} s: dropped"
        findings.append(Finding("warning", message))
    if absent:
        findings.append(Finding("warning", f"{absent} files named in the lists are absent on disk"))
    K, distortion, source = intrinsics(root)
    if options.color_K is None:
        findings.append(Finding("info", f"intrinsics: {source}"))
    return Recording(root, frames, K, distortion, depth_unit=DEPTH_UNIT, findings=findings)


def frame_files(root: Path, limit: float) -> tuple[list[tuple[float, Path, Path | None]], int]:
    """Time, picture and depth map of each frame, and the number of listed files that are absent.

    Args:
        root: the folder with rgb.txt and depth.txt.
        limit: between the times of a picture and its depth map, seconds.
    """
    colors, depths = _read_list(root / "rgb.txt"), _read_list(root / "depth.txt")
    color_times = np.array([time for time, _ in colors])
    depth_of = associate(color_times, np.array([time for time, _ in depths]), limit)
    frames: list[tuple[float, Path, Path | None]] = []
    absent = 0
    for i, (time, name) in enumerate(colors):
        color = named_file(root, name, where=str(root / "rgb.txt"))
        if not is_file(color):
            absent += 1
            continue
        depth = None
        if i in depth_of:
            depth = named_file(root, depths[depth_of[i]][1], where=str(root / "depth.txt"))
        if depth is not None and not is_file(depth):
            absent += 1
            depth = None
        frames.append((time, color, depth))
    return frames, absent


def associate(first: Float64, second: Float64, limit: float) -> dict[int, int]:
    """Pairs of nearest time stamps, each stamp used once, the closest pairs first.

    Args:
        first: (A,) seconds.
        second: (B,) seconds.
        limit: the largest accepted difference, seconds.

    Returns:
        For indices of ``first``, the index of ``second``.
    """
    order = np.argsort(second, kind="stable")
    low = np.searchsorted(second[order], first - limit, side="left")
    high = np.searchsorted(second[order], first + limit, side="right")
    if int((high - low).sum()) > MOST_CANDIDATES * (len(first) + len(second)):
        raise ProjectError(
            f"{int((high - low).sum())} pairs of {len(first)} and {len(second)} time stamps are "
            f"within {limit:g} s; expected a few of each; give a smaller max_time_difference"
        )
    candidates = sorted(
        (abs(first[i] - second[j]), i, int(j))
        for i in range(len(first))
        for j in order[low[i] : high[i]]
    )
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in candidates:
        if i not in pairs and j not in taken:
            pairs[i] = j
            taken.add(j)
    return pairs


def _read_list(path: Path) -> list[tuple[float, str]]:
    try:
        lines = read_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ProjectError(f"{path}: unreadable ({error})") from None
    entries = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            time, name = line.replace(",", " ").split(maxsplit=1)
            entries.append((float(time), name.strip()))
            if not math.isfinite(entries[-1][0]):
                raise ValueError
        except ValueError:
            raise ProjectError(
                f"{path}, line {number}: {line!r}; expected a time stamp in seconds and a file"
            ) from None
    return entries


def intrinsics(root: Path) -> tuple[Float64, tuple[float, ...], str]:
    """(3, 3) and distortion of the colour camera as published, and where they come from."""
    if (root / "camera-intrinsics.txt").is_file():
        path = root / "camera-intrinsics.txt"
        return load_matrix(path, (3, 3)), (), path.name
    if (root / "camera.json").is_file():
        return open3d_intrinsics(root / "camera.json"), (), "camera.json"
    for name, (values, distortion) in PUBLISHED.items():
        if name in root.resolve().name:
            return pinhole(values), distortion, f"published for {name}"
    return pinhole(DRIVER_DEFAULT), (), "the driver's default 525, 525, 319.5, 239.5"


TUM = RgbdLayout("TUM (rgb.txt, depth.txt, groundtruth.txt)", _matches, _record)
read_tum = TUM.read
