"""Trajectory files: TUM (timestamped quaternions), KITTI (rows of 3x4 matrices), EuRoC (CSV).

They hold poses to world, in scene units, and nothing of the camera itself: the intrinsics and the
image size come from given cameras. TUM's and KITTI's poses are those of a camera with OpenCV axes,
EuRoC's those of the inertial unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import ROTATION_ROUNDING, Cameras, invert_rigid, rigid_transform
from gvtools.errors import ProjectError, ShapeError
from gvtools.untrusted import read_text

Float64 = NDArray[np.float64]

# A quaternion written with few digits may be this far from unit length; farther, it is none.
QUATERNION_TOLERANCE = 1e-2
# Numbers of a line that are read.
_COUNTS = {"tum": 8, "kitti": 12, "euroc": 8}


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses in the order of a file or project."""

    poses: Float64  # (N, 4, 4) float64, camera (or body) to world, scene units
    # N names; empty when poses are told apart by time or by order alone
    names: tuple[str, ...] = ()
    stamps: Float64 | None = None  # (N,) float64, seconds; None where there are no times

    def __len__(self) -> int:
        return len(self.poses)


def read_poses(path: str | Path, *, layout: str = "auto") -> Trajectory:
    r"""The poses of a trajectory file.

    Args:
        path: a text file; blank lines and lines that start with # are passed over.
        layout: "tum" (timestamp tx ty tz qx qy qz qw), "kitti" (12 numbers, a 3x4 matrix by rows),
            "euroc" (CSV: nanoseconds, x, y, z, qw, qx, qy, qz, and more that is not read) or "auto"
            (a .csv file is EuRoC's; else by the count of numbers in the first line: 8 or 12).

    Returns:
        N poses, with stamps for TUM and EuRoC. Rotations that are off by more than rounded digits
        are replaced by the nearest ones.

    Raises:
        ProjectError: unreadable or empty; a line with another count of numbers, something that is
            no number, or a rotation that is none. The message names the line.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "path.txt"
    ...     _ = file.write_text("0.0 1 2 3 0 0 0 1\n0.1 1 2 4 0 0 0 1\n")
    ...     track = read_poses(file)
    >>> track.poses[1, :3, 3], track.stamps
    (array([1., 2., 4.]), array([0. , 0.1]))
    """
    path = Path(path)
    rows = _rows(path)
    if layout == "auto":
        counted = {8: "tum", 12: "kitti"}
        layout = "euroc" if path.suffix.lower() == ".csv" else counted.get(len(rows[0][1]), layout)
    if layout not in _COUNTS:
        raise ProjectError(
            f"{path}:{rows[0][0]}: {len(rows[0][1])} numbers with layout {layout!r}; expected 8 "
            "(tum: timestamp tx ty tz qx qy qz qw) or 12 (kitti: a 3x4 matrix), or euroc's .csv"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    stamps = np.empty(len(rows))
    for i, (number, words) in enumerate(rows):
        where = f"{path}:{number}"
        if layout == "euroc":
            words = words[: _COUNTS[layout]]
        values = _numbers(words, _COUNTS[layout], where=where)
        if layout == "kitti":
            poses[i, :3] = values.reshape(3, 4)
        else:
            quaternion = values[4:] if layout == "tum" else values[[5, 6, 7, 4]]
            poses[i, :3, :3] = _rotation(quaternion, where=where)
            poses[i, :3, 3] = values[1:4]
            stamps[i] = values[0] if layout == "tum" else values[0] * 1e-9
        try:
            nearest, defect = rigid_transform(poses[i], what=where)
        except ShapeError as error:
            raise ProjectError(str(error)) from None
        if defect > ROTATION_ROUNDING:
            poses[i] = nearest
    return Trajectory(poses, (), None if layout == "kitti" else stamps)


def read_trajectory(path: str | Path, like: Cameras, *, layout: str = "auto") -> Cameras:
    """Cameras on the poses of a trajectory file.

    Args:
        path: as of ``read_poses``.
        like: intrinsics and size: those of the first camera for all, or row by row when there are
            as many cameras as poses.
        layout: as of ``read_poses``.

    Returns:
        V cameras; the names are the timestamps as written (TUM, EuRoC; a repeated one gets _1, _2,
        ...) or running numbers (KITTI).
    """
    path = Path(path)
    track = read_poses(path, layout=layout)
    names: list[str] = []
    repeats: dict[str, int] = {}
    for _, words in _rows(path):
        name = words[0] if track.stamps is not None else f"{len(names):06d}"
        # Published ground truth holds repeated timestamps; names have to differ.
        repeats[name] = repeats.get(name, -1) + 1
        if repeats[name]:
            name = f"{name}_{repeats[name]}"
        names.append(name)
    return _with_intrinsics(track.poses, like, names, path=path)


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Line numbers and words of the lines that hold data."""
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise ProjectError(f"{path}: cannot be read as a trajectory ({reason})") from error
    rows = [
        (number, line.replace(",", " ").split())
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise ProjectError(f"{path}: no poses; expected one line for each camera")
    return rows


def _numbers(words: list[str], count: int, *, where: str) -> Float64:
    """The numbers of a line, all finite."""
    if len(words) != count:
        raise ProjectError(f"{where}: {len(words)} numbers; expected {count} as in the layout")
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise ProjectError(f"{where}: {str(error)[:200]}; expected {count} numbers") from None
    if not np.isfinite(values).all():
        raise ProjectError(f"{where}: NaN or infinity; remove the line or mend it")
    return values


def _rotation(quaternion: Float64, *, where: str) -> Float64:
    """The rotation of a quaternion (x, y, z, w) of about unit length."""
    from scipy.spatial.transform import Rotation

    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > QUATERNION_TOLERANCE:
        raise ProjectError(
            f"{where}: a quaternion of length {norm:.6g}; expected 1 (order qx qy qz qw)"
        )
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())


def _with_intrinsics(poses: Float64, like: Cameras, names: list[str], *, path: Path) -> Cameras:
    """The poses with the intrinsics of ``like``: one for all, or one each."""
    if len(like) < 1:
        raise ProjectError(f"{path}: no camera to take the intrinsics from; give at least one")
    rows = np.arange(len(poses)) if len(like) == len(poses) else np.zeros(len(poses), np.int64)
    rigid = np.array([rigid_transform(pose, what=str(path))[0] for pose in poses])
    return Cameras(
        like.K[rows], invert_rigid(rigid), like.width[rows], like.height[rows], tuple(names)
    )
