"""Recorded data sets: ScanNet v2, 7-Scenes, ARKitScenes, MapFree and RealEstate10K.

Files, axes, units and traps of each are in its spec, ``data_specs/data_sets``.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO
from urllib.parse import parse_qs, urlsplit

import numpy as np

from gvtools.cameras import rigid_poses, rigid_transform
from gvtools.errors import ProjectError
from gvtools.scenes.calibration import (
    INTRINSICS,
    MILLIMETRES,
    Float64,
    corner_origin,
    number_table,
    pinhole_lens,
    quaternion_pose,
    sky_findings,
)
from gvtools.scenes.images import decode_picture, read_depth, readings
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import natural, pictures_by_stem, pose_at, scenes_holding
from gvtools.scenes.photographs import Depth, PosedFrame, Registration, first_size, posed_scene
from gvtools.scenes.rgbd import RgbdOptions, rgbd_scene
from gvtools.scenes.rgbd_layouts import SCANNET, SCANNET_FOLDER, SEVENSCENES, SEVENSCENES_FOLDER
from gvtools.scenes.scene import Finding, Frame, Scene, counted
from gvtools.scenes.undistort import LensParameters
from gvtools.untrusted import expect, read_text, reading, regular

# --- 7-Scenes as published: ``SCENE/seq-NN/frame-NNNNNN.{color.png, depth.png, pose.txt}`` ------

# The published values of the depth camera, pixels: the download holds no file of them.
KINECT = [[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]]


@Layout.of_reader(
    "SCENE/seq-NN/frame-NNNNNN.pose.txt with .color.png and .depth.png",
    lambda root: scenes_holding(root, "*/seq-*/frame-*.pose.txt"),
)
def _sevenscenes(root: Path, scene: str) -> Scene:
    folder = root / scene
    if any((place / INTRINSICS).is_file() for place in (folder, folder.parent)):
        return SEVENSCENES.read(folder)
    recording = SEVENSCENES_FOLDER.record(folder, RgbdOptions(color_K=KINECT))
    return rgbd_scene(replace(recording, given=frozenset()))  # scaled where pictures are


# --- ScanNet v2 -------------------------------------------------------------------------------
#
# Exported folders, see ``gvtools.scenes.rgbd_layouts``, or the native ``SCENE.sens``: a head with
# the cameras, then frames one after another. It is indexed at opening and read frame by frame.


def _scannet_scenes(root: Path) -> tuple[str, ...]:
    folders = (
        folder for home in ("", "scans", "scans_test") for folder in (root / home).glob("scene*/")
    )
    found = (path for path in folders if SCANNET.matches(path) or any(path.glob("*.sens")))
    return natural(path.relative_to(root).as_posix() for path in found)


@Layout.of_reader(
    "scans/sceneNNNN_NN with color, depth, pose, intrinsic or a .sens", _scannet_scenes
)
def _scannet(root: Path, scene: str) -> Scene:
    folder = root / scene
    if SCANNET.matches(folder):
        recording = SCANNET_FOLDER.record(folder, RgbdOptions(), strict=False)
        return rgbd_scene(recording, kind="data set", strict=False)
    path = min(folder.glob("*.sens"), default=None)
    if path is None:
        raise ProjectError(f"{folder}: neither exported folders nor a .sens file")
    sens = SensFile.open(path)
    color_pose, depth_pose = (
        rigid_transform(sens.matrices[i], what=f"{path}, extrinsics")[0] for i in (1, 3)
    )
    registration = Registration(
        corner_origin(sens.matrices[2], what=f"{path}, depth intrinsics"),
        color_pose @ np.linalg.inv(depth_pose),
    )
    K = corner_origin(sens.matrices[0], what=f"{path}, colour intrinsics")
    lens, frames = pinhole_lens(K, sens.color_size), []
    for i, frame in enumerate(sens.frames):
        depth = path if frame.depth_bytes else None
        reader = partial(read_sens_depth, frame=frame, sens=sens)
        posed = PosedFrame(f"{i}", path, lens, frame.world_from_cam, depth, reader)
        read = partial(read_sens_color, frame=frame)
        frames.append(replace(posed, registration=registration, read=read))
    findings = [Finding("info", f"frames are read from {path.name}")]
    line = f"of {sens.count} frames are past the end of {path.name}: dropped"
    findings += counted(sens.count - len(sens.frames), line)
    return posed_scene(folder, frames, poses="world_from_cam", metric=True, findings=findings)


VERSION = 4
PNG, JPEG = 1, 2
RAW_USHORT, ZLIB_USHORT = 0, 1
FRAME_HEAD = struct.Struct("<16fQQQQ")  # pose, two time stamps, sizes of colour and depth


@dataclass(frozen=True, eq=False)
class SensFrame:
    """One frame in the file; the bytes of depth follow those of colour."""

    world_from_cam: Float64  # (4, 4), metres; infinite where tracking was lost
    offset: int
    color_bytes: int
    depth_bytes: int


@dataclass(frozen=True, eq=False)
class SensFile:
    """The head of a ``.sens`` file and the index of its frames; no picture is held."""

    # (4, 4, 4): intrinsics (pixels, first centre (0, 0)) and extrinsics of colour, then of depth.
    matrices: Float64
    color_size: tuple[int, int]  # width and height, pixels
    depth_size: tuple[int, int]
    depth_code: int  # how depth is compressed
    depth_unit: float  # metres in a stored unit
    count: int  # of frames, as the head says
    frames: tuple[SensFrame, ...]  # those that are there whole

    @staticmethod
    def open(path: Path) -> SensFile:
        """The head and the index of a file, which may end early."""
        with reading(path, "expected a .sens file; copy it again"):
            with regular(path).open("rb") as file:
                (version,) = _unpack(file, "<I")
                expect(version == VERSION, f"version {version}, not {VERSION}")
                (length,) = _unpack(file, "<Q")
                file.seek(length, io.SEEK_CUR)
                matrices = np.array(_unpack(file, "<64f")).reshape(4, 4, 4)
                color_code, depth_code, *sizes = _unpack(file, "<iiIIII")
                shift, count = _unpack(file, "<fQ")
                frames = _sens_index(file, count, path.stat().st_size)
            known = color_code in (PNG, JPEG) and depth_code in (ZLIB_USHORT, RAW_USHORT)
            expect(
                known and shift > 0,
                f"colour and depth of compression {color_code} and {depth_code}, {shift:g} "
                "steps a metre; expected PNG or JPEG, zlib or none, more than 0",
            )
        color_size, depth_size = (sizes[0], sizes[1]), (sizes[2], sizes[3])
        return SensFile(
            matrices, color_size, depth_size, depth_code, 1.0 / shift, count, tuple(frames)
        )


def _unpack(file: BinaryIO, form: str) -> tuple[int, ...]:
    return struct.unpack(form, file.read(struct.calcsize(form)))


def _sens_index(file: BinaryIO, count: int, end: int) -> list[SensFrame]:
    """The frames that are whole, without reading their pictures."""
    frames: list[SensFrame] = []
    offset = file.tell()
    while len(frames) < count:
        file.seek(offset)
        head = file.read(FRAME_HEAD.size)
        if len(head) < FRAME_HEAD.size:
            break
        values = FRAME_HEAD.unpack(head)
        color, depth = int(values[18]), int(values[19])
        offset += FRAME_HEAD.size
        if offset + color + depth > end:
            break
        pose = np.array(values[:16], np.float64).reshape(4, 4)
        frames.append(SensFrame(pose, offset, color, depth))
        offset += color + depth
    return frames


def read_sens_color(path: Path, *, frame: SensFrame) -> Frame:
    """The picture of a frame."""
    data = _sens_bytes(path, frame.offset, frame.color_bytes)
    return decode_picture(data, where=str(path))


def read_sens_depth(path: Path, *, frame: SensFrame, sens: SensFile) -> Depth:
    """(h, w) float32 z-depth of the depth camera, metres, 0 for none."""
    data = _sens_bytes(path, frame.offset + frame.color_bytes, frame.depth_bytes)
    with reading(path):
        if sens.depth_code == ZLIB_USHORT:
            data = zlib.decompress(data)
        raw = np.frombuffer(data, "<u2").reshape(sens.depth_size[::-1])
    return readings(raw, unit=sens.depth_unit)


def _sens_bytes(path: Path, offset: int, count: int) -> bytes:
    with reading(path), regular(path).open("rb") as file:
        file.seek(offset)
        return file.read(count)


# --- ARKitScenes ------------------------------------------------------------------------------
#
# A line of the trajectory holds a time stamp in seconds, an axis-angle rotation and a translation
# of cam_from_world; there are about ten a second, and up to sixty frames. A frame within a
# millisecond of a pose gets it; one between two not more than 0.2 s apart gets their
# interpolation; others are left out. Each frame has its own ``.pincam`` (width, height, fx, fy,
# cx, cy), the name of which may be a millisecond off. Scenes are of the low-resolution pair;
# ``VIDEO/wide`` asks for the other.

LOW, HIGH = "lowres_wide", "wide"
DEPTH_OF = {LOW: "lowres_depth", HIGH: "highres_depth"}
TRAJECTORY = "lowres_wide.traj"
SAME = 1.5e-3  # seconds; stamps in names are rounded to a millisecond
LONGEST_GAP = 0.2  # seconds between two poses that may be interpolated
UP = 2  # the world's z axis


def _arkit_scenes(root: Path) -> tuple[str, ...]:
    return scenes_holding(
        root, *(f"{above}{TRAJECTORY}" for above in ("*/", "*/*/", "*/*/*_frames/"))
    )


@Layout.of_reader(
    f"FOLD/VIDEO/{TRAJECTORY} with {LOW}, {LOW}_intrinsics and lowres_depth",
    _arkit_scenes,
    variants=lambda root: tuple(
        f"{s}/{HIGH}" for s in _arkit_scenes(root) if (root / s / HIGH).is_dir()
    ),
)
def _arkitscenes(root: Path, scene: str) -> Scene:
    from scipy.spatial.transform import Rotation

    folder, kind = root / scene, LOW
    if folder.name == HIGH:
        folder, kind = folder.parent, HIGH
    rows = number_table(folder / TRAJECTORY, 7, required=True)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    times, turns = rows[:, 0], Rotation.from_rotvec(rows[:, 1:4]).as_matrix()
    poses = rigid_poses(turns, rows[:, 4:])
    lenses = _pincams(folder / f"{kind}_intrinsics")
    depths = folder / DEPTH_OF[kind]
    # Of pictures and depth maps, so that a pair with half of it missing is counted.
    names = {path.name for home in (folder / kind, depths) for path in home.glob("*.png")}
    frames, exact, reader = [], 0, partial(read_depth, unit=MILLIMETRES)
    for name in sorted(names):
        time = _stamp(name)
        pose = pose_at(time, times, poses, same=SAME, longest_gap=LONGEST_GAP)
        exact += pose is not None and bool(np.abs(times - time).min() <= SAME)
        # Of its own time, or a millisecond beside it.
        key = round(time * 1000)
        lens = next((lenses[item] for item in (key, key - 1, key + 1) if item in lenses), None)
        depth = depths / name if depths.is_dir() else None
        frames.append(PosedFrame(name, folder / kind / name, lens, pose, depth, reader))
    interpolated = sum(frame.pose is not None for frame in frames) - exact
    findings = counted(interpolated, "frames have an interpolated pose", level="info")
    findings += sky_findings(poses, UP)
    return posed_scene(folder, frames, poses="cam_from_world", metric=True, findings=findings)


def _stamp(name: str) -> float:
    with reading(name, "expected a time stamp, VIDEO_SECONDS.png"):
        return float(name.rpartition(".")[0].rpartition("_")[2])


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


# --- MapFree ----------------------------------------------------------------------------------
#
# Lines hold a picture's path, then qw qx qy qz tx ty tz of cam_from_world, or fx fy cx cy width
# height. Withheld poses of the test split are all 0. The data set holds no depth; maps that were
# estimated beside a picture (``NAME.METHOD.png`` in millimetres, ``NAME[.METHOD].npy`` in metres)
# are read.


@Layout.of_reader(
    "SPLIT/SCENE/poses.txt and intrinsics.txt with seq0 and seq1",
    lambda root: scenes_holding(root, "*/intrinsics.txt", "*/*/intrinsics.txt"),
)
def _mapfree(root: Path, scene: str) -> Scene:
    folder = root / scene
    lenses = _named_numbers(folder / "intrinsics.txt", 6)
    if any(not np.isfinite(values).all() for values in lenses.values()):
        raise ProjectError(
            f"{folder / 'intrinsics.txt'}: numbers that are not finite; copy it again"
        )
    poses = _named_numbers(folder / "poses.txt", 7) if (folder / "poses.txt").is_file() else {}
    depths: dict[str, Path] = {}
    for pattern in ("seq*/frame_*.png", "seq*/frame_*.npy"):
        for path in sorted(folder.glob(pattern)):
            depths.setdefault(f"{path.parent.name}/{path.name.partition('.')[0]}", path)
    frames = []
    for name, (fx, fy, cx, cy, width, height) in lenses.items():
        stem = name.rpartition(".")[0]
        depth = depths.get(stem, folder / f"{stem}.npy") if depths else None
        unit = MILLIMETRES if depth is not None and depth.suffix == ".png" else 1.0
        lens = pinhole_lens([fx, fy, cx, cy], (round(width), round(height)))
        pose = quaternion_pose(poses[name][:4], poses[name][4:]) if name in poses else None
        reader = partial(read_depth, unit=unit)
        frames.append(PosedFrame(name, folder / name, lens, pose, depth, reader))
    line = "depth maps lie beside the pictures: estimated, not of the data set"
    findings = counted(len(depths), line, level="info")
    return posed_scene(folder, frames, poses="cam_from_world", metric=True, findings=findings)


def _named_numbers(path: Path, columns: int) -> dict[str, Float64]:
    """Lines of a picture's path and numbers; comments begin with #."""
    rows = {}
    with reading(path, f"expected a picture's path and {columns} numbers a line"):
        for line in read_text(path).splitlines():
            words = line.split()
            if not words or line.startswith("#"):
                continue
            values = np.array(words[1:], np.float64)
            expect(len(values) == columns, f"{words[0]} has {len(values)} numbers")
            rows[words[0].replace("\\", "/")] = values
    return rows


# --- RealEstate10K ----------------------------------------------------------------------------
#
# The first line of a camera file is the video's address; each further line holds a time stamp in
# microseconds, fx, fy, cx, cy as shares of the picture's width and height, k1, k2, and a 3x4
# cam_from_world. Pictures are looked for as ``STAMP.png`` or ``.jpg`` in ``SPLIT/ID``,
# ``frames/SPLIT/ID`` or ``frames/ID``, and otherwise taken from a video ``ID`` or named like the
# address, in ``videos``, ``videos/SPLIT`` or ``SPLIT``.

LONGEST = 10_000  # of an address
VIDEOS = (".mp4", ".mkv", ".webm", ".mov")
COLUMNS = 19  # time stamp, six of the lens, twelve of the pose


def _realestate_scenes(root: Path) -> tuple[str, ...]:
    found = []
    for split in ("train", "validation", "test"):
        cameras = {path.stem: path for path in (root / split).glob("*.txt")}
        folders = {path.name for home in _frame_homes(root, split) for path in home.glob("*/")}
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
        yield from (path for path in home.glob("*") if path.suffix.lower() in VIDEOS)


def _address(path: Path) -> str:
    """The video's name in its address: ``watch?v=NAME``, or the last part of the path."""
    try:
        with regular(path).open(encoding="utf-8-sig", errors="replace") as file:
            parts = urlsplit(file.readline(LONGEST).strip())
    except (OSError, ValueError):
        return ""  # as if it had none; its poses are refused where they are read
    return parse_qs(parts.query).get("v", [parts.path.rpartition("/")[2]])[0]


@Layout.of_reader(
    "train/ID.txt and test/ID.txt, with frames/SPLIT/ID or videos", _realestate_scenes
)
def _realestate10k(root: Path, scene: str) -> Scene:
    split, _, name = scene.partition("/")
    path = root / split / f"{name}.txt"
    rows = number_table(path, COLUMNS, skip=1, required=True)
    if not np.isfinite(rows[:, 0]).all():
        raise ProjectError(f"{path}: a time stamp that is no number; download it again")
    findings: list[Finding] = []
    homes = [home / name for home in _frame_homes(root, split) if (home / name).is_dir()]
    if homes:
        place, frames = homes[0], _from_pictures(homes[0], rows)
    else:
        wanted = {name, _address(path)}
        videos = (item for item in _videos(root, split) if item.stem in wanted)
        video = next(videos, None)
        if video is None:
            raise ProjectError(
                f"{path}: neither frames ({split}/{name}/STAMP.png) nor a video "
                f"({_address(path)}.mp4) in {root}; expected one of them"
            )
        place, frames = video, _from_video(video, rows, findings)
    return posed_scene(place, frames, poses="cam_from_world", metric=False, findings=findings)


def _row_lens(row: Float64, size: tuple[int, int]) -> LensParameters:
    """The lens of a line, for pictures of ``size``."""
    width, height = size
    fx, fy, cx, cy, k1, k2 = (float(value) for value in row[1:7])
    shared = (fx * width, fy * height, cx * width, cy * height)
    if k1 or k2:
        return LensParameters("OPENCV", (*shared, k1, k2, 0.0, 0.0), size)
    return LensParameters("PINHOLE", shared, size)


def _from_pictures(folder: Path, rows: Float64) -> list[PosedFrame]:
    files = pictures_by_stem(folder)
    size = first_size(files.values()) or (2, 2)
    frames = []
    for row in rows:
        stem = str(int(row[0]))
        image = files.get(stem, folder / f"{stem}.png")
        frames.append(PosedFrame(stem, image, _row_lens(row, size), row[7:].reshape(3, 4)))
    return frames


def _from_video(path: Path, rows: Float64, findings: list[Finding]) -> list[PosedFrame]:
    """Frames at the nearest time stamps; ``findings`` is added to."""
    from gvtools.scenes.images import read_frame, video_header

    header = video_header(path)
    within = rows[:, 0] / 1e6 <= header.seconds + header.frame_seconds
    line = f"frames are decoded from {path.name} at the nearest time stamp"
    findings.append(Finding("info", line))
    line = f"of {len(rows)} frames lie past the video's end: dropped"
    findings += counted(int((~within).sum()), line)
    frames = []
    for row in rows[within]:
        lens, pose = _row_lens(row, header.size), row[7:].reshape(3, 4)
        read = partial(read_frame, seconds=row[0] / 1e6)
        frames.append(PosedFrame(str(int(row[0])), path, lens, pose, read=read))
    return frames


LAYOUTS = (_sevenscenes, _scannet, _arkitscenes, _mapfree, _realestate10k)
