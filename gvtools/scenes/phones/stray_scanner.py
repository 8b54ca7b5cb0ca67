"""Stray Scanner: ``rgb.mp4``, ``odometry.csv``, ``camera_matrix.csv``, ``depth``, ``confidence``.

A row of the odometry is a frame: its number names the depth map and the confidence map, its place
among the rows is the frame's in the video. Poses are world_from_cam, quaternion x, y, z, w, and,
unlike other apps', already of OpenCV's camera axes; the world has y up. Newer versions of the app
write fx, fy, cx, cy with each row; ``camera_matrix.csv`` holds the last frame's.

The app appends the first frame before the video's session begins, so that the file's edit list
hides it. Players follow that list, which shifts every picture by one frame against the poses; here
the list is ignored.
"""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.posed_pictures import (
    Float64,
    PosedPicture,
    pinhole_lens,
    quaternion_pose,
)
from gvtools.scenes.data_sets.video import frame_seconds, read_frame, video_header
from gvtools.scenes.phones.arkit import (
    LidarMaps,
    PhoneLayout,
    numbers,
    phone_scene,
)
from gvtools.scenes.rgbd_recording import load_matrix
from gvtools.scenes.scene import Finding, Scene
from gvtools.untrusted import regular

NAME = "Stray Scanner"
VIDEO, ODOMETRY, MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
# Of a recording: a year at a thousand a second.
MOST_FRAMES = 3e10
PLACE, TURN = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
LENS = ("fx", "fy", "cx", "cy")


def _matches(root: Path) -> bool:
    return (root / ODOMETRY).is_file() and (root / VIDEO).is_file()


def _read(root: Path) -> Scene:
    rows = read_odometry(root / ODOMETRY)
    video, lidar = root / VIDEO, LidarMaps()
    seconds, size = frame_seconds(video, edits=False), video_header(video).size
    shared = None
    if (root / MATRIX).is_file():
        shared = load_matrix(root / MATRIX, (3, 3))[[0, 1, 0, 1], [0, 1, 2, 2]]
    first = int(rows[0]["frame"])
    pictures = []
    for row in rows:
        place = int(row["frame"]) - first
        number = f"{int(row['frame']):06d}"
        depth = _depth_map(root / "depth", number)
        confidence = root / "confidence" / f"{number}.png"
        K = numbers([row.get(key) for key in LENS], (4,))
        K = shared if K is None else K
        inside = 0 <= place < len(seconds)
        pictures.append(
            PosedPicture(
                number,
                video if inside else root / f"{VIDEO}, frame {number}",
                None if K is None else pinhole_lens(K, size),
                _pose(row),
                depth,
                lidar.reader(depth, confidence),
                read=partial(read_frame, seconds=seconds[place], edits=False) if inside else None,
            )
        )
    findings = _length_findings(len(seconds), len(rows)) + lidar.findings()
    return phone_scene(root, NAME, pictures, findings=findings)


def read_odometry(path: Path) -> list[dict[str, float]]:
    """The rows of ``odometry.csv`` by the names of its header; what is no number is left out."""
    try:
        with regular(path).open(encoding="utf-8-sig", newline="") as file:
            lines = list(csv.DictReader(file, skipinitialspace=True))
    except (OSError, ValueError, csv.Error) as error:
        raise ProjectError(f"{path}: unreadable ({error}); export the recording again") from None
    rows = []
    for line in lines:
        row = {}
        for key, word in line.items():
            try:
                row[key.strip()] = float(word)
            except (AttributeError, TypeError, ValueError):
                continue  # a device without that value leaves it empty
        # A broken last line, of an export that was cut off, has no frame number.
        if abs(row.get("frame", np.nan)) < MOST_FRAMES:
            rows.append(row)
    if not rows:
        raise ProjectError(
            f"{path}: no row with a frame number; expected columns timestamp, frame, x, y, z, qx, "
            "qy, qz and qw; export the recording again"
        )
    return rows


def _pose(row: dict[str, float]) -> Float64 | None:
    """(4, 4) world_from_cam, OpenCV axes, metres."""
    turn = numbers([row.get(key) for key in TURN], (4,))
    place = numbers([row.get(key) for key in PLACE], (3,))
    if turn is None or place is None or not turn.any():
        return None
    return quaternion_pose(turn, place)


def _depth_map(folder: Path, number: str) -> Path:
    """Early versions of the app wrote arrays instead of pictures."""
    array = folder / f"{number}.npy"
    return array if array.is_file() else folder / f"{number}.png"


def _length_findings(pictures: int, rows: int) -> list[Finding]:
    if pictures == rows:
        return []
    line = (
        f"{VIDEO} has {pictures} frames for {rows} poses: pictures may belong to poses beside "
        "theirs; give the video as the app wrote it"
    )
    return [Finding("warning", line)]


STRAY_SCANNER = PhoneLayout(NAME, f"{NAME} ({VIDEO}, {ODOMETRY}, {MATRIX}, depth)", _matches, _read)
