"""RealEstate10K: camera files ``SPLIT/ID.txt`` with frames by time stamp, or with the videos.

A camera file's first line is the video's address; each further line holds a time stamp in
microseconds, fx, fy, cx, cy as shares of the picture's width and height, k1, k2, and a 3x4
cam_from_world, row by row. The data set holds no pictures. They are looked for as
``STAMP.png`` or ``.jpg`` in ``SPLIT/ID``, ``frames/SPLIT/ID`` or ``frames/ID``, and otherwise taken
from a video ``ID`` or named like the address, in ``videos``, ``videos/SPLIT`` or ``SPLIT``.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import (
    Float64,
    PosedPicture,
    natural,
    posed_scene,
)
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.images import read_header
from gvtools.scenes.rgbd_recording import PICTURES
from gvtools.scenes.scene import Finding, Scene
from gvtools.scenes.transforms_frame import LensParameters
from gvtools.untrusted import read_text, regular

SPLITS = ("train", "validation", "test")
LONGEST = 10_000  # of an address
VIDEOS = (".mp4", ".mkv", ".webm", ".mov")
COLUMNS = 19  # time stamp, six of the lens, twelve of the pose


def _scenes(root: Path) -> tuple[str, ...]:
    found = []
    for split in SPLITS:
        cameras = {path.stem: path for path in (root / split).glob("*.txt")}
        folders = {
            path.name
            for home in _frame_homes(root, split)
            if home.is_dir()
            for path in home.iterdir()
            if path.is_dir()
        }
        videos = {path.stem for path in _videos(root, split)}
        # The address stands in the camera file, which is opened only where it can matter.
        by_address = bool(videos - set(cameras))
        for name, path in cameras.items():
            if name in folders | videos or (by_address and _address(path) in videos):
                found.append(f"{split}/{name}")
    return natural(found)


def _frame_homes(root: Path, split: str) -> tuple[Path, ...]:
    return root / split, root / "frames" / split, root / "frames"


def _videos(root: Path, split: str) -> Iterator[Path]:
    for home in (root / "videos", root / "videos" / split, root / split):
        if home.is_dir():
            yield from (path for path in home.iterdir() if path.suffix.lower() in VIDEOS)


def _address(path: Path) -> str:
    """The video's name in its address: ``watch?v=NAME``, or the last part of the path."""
    try:
        with regular(path).open(encoding="utf-8", errors="replace") as file:
            parts = urlsplit(file.readline(LONGEST).strip())
    except (OSError, ValueError):
        return ""  # as if it had none; its poses are refused where they are read
    return parse_qs(parts.query).get("v", [parts.path.rpartition("/")[2]])[0]


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    split, _, name = scene.partition("/")
    path = root / split / f"{name}.txt"
    rows = _rows(path)
    homes = [home / name for home in _frame_homes(root, split) if (home / name).is_dir()]
    if homes:
        return posed_scene(
            homes[0], _from_frames(homes[0], rows), poses="cam_from_world", metric=False
        )
    wanted = {name, _address(path)}
    video = next((item for item in _videos(root, split) if item.stem in wanted), None)
    if video is None:
        raise ProjectError(
            f"{path}: neither frames ({split}/{name}/STAMP.png) nor a video ({_address(path)}.mp4) "
            f"in {root}; expected one of them"
        )
    pictures, findings = _from_video(video, rows)
    return posed_scene(video, pictures, poses="cam_from_world", metric=False, findings=findings)


def _rows(path: Path) -> Float64:
    """(N, 19) float64: the lines of a camera file after its first."""
    try:
        lines = read_text(path).splitlines()[1:]
        rows = np.array([line.split() for line in lines if line.strip()], np.float64)
    except (OSError, ValueError) as error:
        raise ProjectError(
            f"{path}: {error}; expected an address, then {COLUMNS} numbers a line"
        ) from None
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or not np.isfinite(rows[:, 0]).all():
        raise ProjectError(
            f"{path}: {rows.shape} numbers; expected {COLUMNS} a line, of which the first is a time"
        )
    return rows


def _lens(row: Float64, size: tuple[int, int]) -> LensParameters:
    """The lens of a line, for pictures of ``size``."""
    width, height = size
    fx, fy, cx, cy, k1, k2 = (float(value) for value in row[1:7])
    shared = (fx * width, fy * height, cx * width, cy * height)
    if k1 or k2:
        return LensParameters("OPENCV", (*shared, k1, k2, 0.0, 0.0), size)
    return LensParameters("PINHOLE", shared, size)


def _from_frames(folder: Path, rows: Float64) -> list[PosedPicture]:
    files = {path.stem: path for path in folder.iterdir() if path.suffix.lower() in PICTURES}
    size = _first_size(list(files.values()))
    pictures = []
    for row in rows:
        stem = str(int(row[0]))
        path = files.get(stem, folder / f"{stem}.png")
        pictures.append(PosedPicture(stem, path, _lens(row, size), row[7:].reshape(3, 4)))
    return pictures


def _first_size(files: list[Path]) -> tuple[int, int]:
    """Of the first readable picture; intrinsics are shares of it."""
    for path in files:
        try:
            header = read_header(path)
        except ProjectError:
            continue
        return header.width, header.height
    return 2, 2  # of no picture: each of them will be left out


def _from_video(path: Path, rows: Float64) -> tuple[list[PosedPicture], list[Finding]]:
    from gvtools.scenes.data_sets.video import read_frame, video_header

    header = video_header(path)
    within = rows[:, 0] / 1e6 <= header.seconds + header.frame_seconds
    findings = [Finding("info", f"frames are decoded from {path.name} at the nearest time stamp")]
    if not within.all():
        line = f"{int((~within).sum())} of {len(rows)} frames lie past the video's end: dropped"
        findings.append(Finding("warning", line))
    pictures = [
        PosedPicture(
            str(int(row[0])),
            path,
            _lens(row, header.size),
            row[7:].reshape(3, 4),
            read=partial(read_frame, seconds=row[0] / 1e6),
        )
        for row in rows[within]
    ]
    return pictures, findings


LAYOUT = Layout("train/ID.txt and test/ID.txt, with frames/SPLIT/ID or videos", _scenes, _read)
