"""ARKitScenes: ``[FOLD/]VIDEO/{lowres_wide, lowres_depth, lowres_wide.traj, ...}``.

A line of the trajectory holds a time stamp in seconds, an axis-angle rotation and a translation of
cam_from_world, in metres; there are about ten a second, and up to sixty frames. Files are named
``VIDEO_STAMP`` with three decimals. A frame within a millisecond of a pose gets it; one between two
poses not more than 0.2 s apart gets their interpolation; others are left out. Each frame has its
own ``.pincam`` (width, height, fx, fy, cx, cy), the name of which may be a millisecond off.

Scenes are of the low-resolution pair (256x192, LiDAR). ``VIDEO/wide`` asks for the high-resolution
one: ``wide`` and ``highres_depth`` (1920x1440, from a laser scanner's mesh). Depth is in
millimetres. Pictures are stored as the sensor lay, not turned upright; a finding tells where up is.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import (
    Float64,
    PosedPicture,
    natural,
    pinhole_lens,
    posed_scene,
)
from gvtools.scenes.data_sets.sky import sky_findings
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.data_sets.timed_poses import pose_at
from gvtools.scenes.images import read_depth
from gvtools.scenes.rgbd_recording import MILLIMETRES
from gvtools.scenes.scene import Finding, Scene
from gvtools.scenes.transforms_frame import LensParameters
from gvtools.untrusted import read_text

LOW, HIGH = "lowres_wide", "wide"
DEPTH_OF = {LOW: "lowres_depth", HIGH: "highres_depth"}
TRAJECTORY = "lowres_wide.traj"
SAME = 1.5e-3  # seconds; stamps in names are rounded to a millisecond
LONGEST_GAP = 0.2  # seconds between two poses that may be interpolated
UP = 2  # the world's z axis


def _scenes(root: Path) -> tuple[str, ...]:
    found = []
    for pattern in (f"*/{TRAJECTORY}", f"*/*/{TRAJECTORY}", f"*/*/*_frames/{TRAJECTORY}"):
        found += [path.parent for path in root.glob(pattern)]
    return natural(path.relative_to(root).as_posix() for path in found)


def _variants(root: Path) -> tuple[str, ...]:
    return tuple(f"{scene}/{HIGH}" for scene in _scenes(root) if (root / scene / HIGH).is_dir())


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder, pictures = root / scene, LOW
    if folder.name == HIGH:
        folder, pictures = folder.parent, HIGH
    times, poses = read_trajectory(folder / TRAJECTORY)
    lenses = _pincams(folder / f"{pictures}_intrinsics")
    depths = folder / DEPTH_OF[pictures]
    frames, exact = [], 0
    for name in _names(folder / pictures, depths):
        time = _stamp(name)
        pose = pose_at(time, times, poses, same=SAME, longest_gap=LONGEST_GAP)
        exact += pose is not None and bool(np.abs(times - time).min() <= SAME)
        frames.append(
            PosedPicture(
                name,
                folder / pictures / name,
                lenses.get(_nearest_stamp(time, lenses)),
                pose,
                depths / name if depths.is_dir() else None,
                partial(read_depth, unit=MILLIMETRES),
            )
        )
    posed = sum(frame.pose is not None for frame in frames)
    findings = _findings(poses, posed - exact)
    return posed_scene(folder, frames, poses="cam_from_world", metric=True, findings=findings)


def _findings(poses: Float64, interpolated: int) -> list[Finding]:
    findings = []
    if interpolated:
        findings.append(Finding("info", f"{interpolated} frames have an interpolated pose"))
    return findings + sky_findings(poses, UP)


def _names(folder: Path, depths: Path) -> list[str]:
    """Of pictures and depth maps, so that a pair with half of it missing is counted."""
    names = {
        path.name
        for home in (folder, depths)
        if home.is_dir()
        for path in home.iterdir()
        if path.suffix == ".png"
    }
    return sorted(names)


def _stamp(name: str) -> float:
    try:
        return float(name.rpartition(".")[0].rpartition("_")[2])
    except ValueError:
        raise ProjectError(f"{name}: no time stamp; expected VIDEO_SECONDS.png") from None


def _pincams(folder: Path) -> dict[int, LensParameters]:
    """The lens of each time stamp, in milliseconds."""
    lenses: dict[int, LensParameters] = {}
    for path in folder.glob("*.pincam"):
        try:
            width, height, *K = (float(word) for word in read_text(path).split())
            lenses[round(_stamp(path.name) * 1000)] = pinhole_lens(K, (int(width), int(height)))
        except (OSError, OverflowError, ValueError):
            continue  # as if it were absent
    return lenses


def _nearest_stamp(time: float, lenses: dict[int, LensParameters]) -> int:
    """The key of a frame's lens: its own time, or a millisecond beside it."""
    key = round(time * 1000)
    return next((item for item in (key, key - 1, key + 1) if item in lenses), key)


def read_trajectory(path: Path) -> tuple[Float64, Float64]:
    """A ``.traj`` file: (N,) seconds in increasing order and (N, 4, 4) cam_from_world."""
    from scipy.spatial.transform import Rotation

    try:
        rows = np.loadtxt(read_text(path).splitlines(), np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise ProjectError(f"{path}: {error}; expected seven numbers a line") from None
    if rows.shape[0] == 0 or rows.shape[1] != 7:
        raise ProjectError(f"{path}: {rows.shape} numbers; expected seven a line")
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rows[:, 1:4]).as_matrix()
    poses[:, :3, 3] = rows[:, 4:]
    return rows[:, 0], poses


LAYOUT = Layout(
    f"FOLD/VIDEO/{TRAJECTORY} with {LOW}, {LOW}_intrinsics and lowres_depth",
    _scenes,
    _read,
    _variants,
)
