"""Exports of phones: Polycam, 3D Scanner App, Stray Scanner and Record3D, all ARKit recordings.

ARKit's camera looks along -z with y up, its world has y up and metres. Depth and its confidence
come from the LiDAR scanner at a lower resolution (256x192 as a rule) than the picture, of the same
camera and the same window: intrinsics of the picture, scaled, are those of the depth map, and each
pixel of the picture takes the reading that it falls into. Confidence is low, medium or high; what
is low is no reading. ARKit counts the principal point from the picture's upper left corner, as
gvtools does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from gvtools.errors import ProjectError
from gvtools.optional import require
from gvtools.scenes.calibration import (
    FLAT,
    MILLIMETRES,
    Float64,
    csv_rows,
    finite_array,
    found_lens,
    found_pose,
    json_object,
    load_matrix,
    opencv_pose,
    quaternion_pose,
    sky_findings,
)
from gvtools.scenes.images import (
    exr_depth,
    frame_seconds,
    read_depth,
    read_frame,
    read_image,
    read_mask,
    readings,
    resize_nearest,
    video_header,
)
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import natural, pictures_by_stem
from gvtools.scenes.photographs import Depth, PosedFrame, first_size, posed_scene
from gvtools.scenes.scene import Finding, Frame, Scene, counted
from gvtools.scenes.undistort import LensParameters
from gvtools.untrusted import read_bytes, read_json, reading

WORLD_UP = 1  # y
AGAIN = "export the recording again"


def phone_scene(
    root: Path,
    name: str,
    frames: Sequence[PosedFrame],
    *,
    upright: bool = True,
    findings: Iterable[Finding] = (),
) -> Scene:
    """The scene of an app's export, metric, of world_from_cam poses in OpenCV's axes."""
    readers = [item.read_depth for item in frames if item.depth and item.depth.is_file()]
    bare = sum(getattr(reader, "keywords", {}).get("confidence") is None for reader in readers)
    line = f"of {len(readers)} depth maps have no confidence map: all of them is used"
    findings = [*findings, *counted(bare, line, level="info")]
    scene = posed_scene(
        root, frames, poses="world_from_cam", metric=True, kind=name, findings=findings,
        advice=AGAIN,
    )  # fmt: skip
    sky = sky_findings(scene.cameras.cam_from_world, WORLD_UP) if upright else []
    return replace(scene, findings=(*scene.findings, *sky))


def confident(depth: Depth, trusted: NDArray[np.bool_]) -> Depth:
    """(h, w) depth, 0 where a map of any size says that it is not to be trusted."""
    height, width = depth.shape
    return np.where(resize_nearest(trusted, width, height), depth, np.float32(0))


def read_lidar(path: Path, *, confidence: Path | None) -> Depth:
    """A depth map of millimetres (16-bit PNG or ``.npy``) and its confidence, in which 0 is low."""
    depth = read_depth(path, unit=MILLIMETRES)
    return depth if confidence is None else confident(depth, read_mask(confidence))


def lidar_reader(confidence: Path) -> Callable[[Path], Depth]:
    """How a depth map is read: with its confidence where that is there."""
    return partial(read_lidar, confidence=confidence if confidence.is_file() else None)


# --- Polycam, raw data ------------------------------------------------------------------------
#
# ``keyframes/{images, cameras, depth, confidence}``. A frame's camera, a JSON, has t_00 to t_23,
# world_from_cam row by row for ARKit's axes, and fx, fy, cx, cy, width, height of the picture.
# Where ``corrected_images`` and ``corrected_cameras`` are there, both are read instead: poses are
# optimised and pictures undistorted, with a black border where undistortion found nothing, which
# is masked. Poses of the two kinds are never mixed. Depth is in millimetres, confidence 0, 127 or
# 255.

_CORRECTED = "corrected_cameras", "corrected_images"
_RECORDED = "cameras", "images"
_CAMERAS = _CORRECTED[0], _RECORDED[0]
_BLACK = 8  # the compression of a JPEG leaves no more of a black border


def _keyframes(root: Path) -> Path:
    """The folder of the keyframes, which may be given itself."""
    return root if root.name == "keyframes" else root / "keyframes"


def _read_polycam(root: Path) -> Scene:
    home = _keyframes(root)
    corrected = all((home / folder).is_dir() for folder in _CORRECTED)
    cameras, images = _CORRECTED if corrected else _RECORDED
    pictures = pictures_by_stem(home / images)
    names = natural([*pictures, *(path.stem for path in (home / cameras).glob("*.json"))])
    pose_keys = [f"t_{row}{column}" for row in range(3) for column in range(4)]
    frames = []
    for name in names:
        camera = json_object(home / cameras / f"{name}.json")
        image = pictures.get(name, home / images / f"{name}.jpg")
        depth = home / "depth" / f"{name}.png"
        size = finite_array([camera.get(key) for key in ("width", "height")], 2)
        width_height = first_size([image]) if size is None else (int(size[0]), int(size[1]))
        lens = found_lens([camera.get(key) for key in FLAT], width_height)
        # A reader of its own is given where a picture is readable and of its camera's size.
        whole = lens is not None and first_size([image]) == lens.size
        pose = found_pose([camera.get(key) for key in pose_keys], 3, 4)
        reader = lidar_reader(home / "confidence" / f"{name}.png")
        read = _read_undistorted if corrected and whole else None
        frames.append(PosedFrame(image.name, image, lens, pose, depth, reader, read=read))
    said = "optimised, pictures undistorted" if corrected else "as ARKit tracked them"
    findings = [Finding("info", f"poses: {said}")]
    return phone_scene(root, "Polycam", frames, findings=findings)


def _read_undistorted(path: Path) -> Frame:
    """An undistorted picture, masked where black pixels hang together with its edge."""
    from scipy.ndimage import label

    rgb = read_image(path).rgb
    places, count = label(rgb.max(axis=-1) <= _BLACK)
    edge: Float64 = np.concatenate([places[[0, -1]].ravel(), places[:, [0, -1]].ravel()])
    outside = np.zeros(count + 1, bool)
    outside[edge] = True
    outside[0] = False
    return Frame(rgb, mask=~outside[places])


POLYCAM = Layout.of_folder(
    "Polycam",
    "raw data: keyframes/ with cameras, images, depth",
    matches=lambda root: any((_keyframes(root) / kind).is_dir() for kind in _CAMERAS),
    read=_read_polycam,
)


# --- 3D Scanner App, "All Data" ---------------------------------------------------------------
#
# ``frame_N.json``, ``frame_N.jpg``, ``depth_N.png``, ``conf_N.png``. A frame's JSON has
# ``cameraPoseARFrame``, world_from_cam row by row for ARKit's axes, and ``intrinsics``, 3x3 row by
# row, of the picture. The app stores more poses and depth maps than pictures; only frames with a
# picture become views. Depth is in millimetres, confidence 0, 1 or 2.

_POSE = "cameraPoseARFrame"
_PROBES = 5  # frames by which an export is recognised


def _is_scanner_app(root: Path) -> bool:
    # Other programs name frames like that, too; a damaged file or two decide nothing.
    frames = root.glob("frame_*.json") if root.is_dir() else ()
    return any(_POSE in json_object(path) for path in islice(frames, _PROBES))


def _read_scanner_app(root: Path) -> Scene:
    poses = {path.stem for path in root.glob("frame_*.json")}
    shown = natural(path.stem for path in root.glob("frame_*.jpg"))
    # All pictures are of one camera, and no file says their size.
    size = first_size(root / f"{name}.jpg" for name in shown) or (2, 2)
    frames = []
    for name in shown:
        number = name.removeprefix("frame_")
        said = json_object(root / f"{name}.json")
        image, depth = root / f"{name}.jpg", root / f"depth_{number}.png"
        lens = found_lens(said.get("intrinsics"), size, 3, 3)
        pose = found_pose(said.get(_POSE), 4, 4)
        reader = lidar_reader(root / f"conf_{number}.png")
        frames.append(PosedFrame(image.name, image, lens, pose, depth, reader))
    line = f"of {len(poses)} frames were recorded without a picture: not used"
    findings = counted(len(poses - set(shown)), line, level="info")
    return phone_scene(root, "3D Scanner App", frames, findings=findings)


SCANNER_APP = Layout.of_folder(
    "3D Scanner App",
    "all data: frame_*.json, frame_*.jpg, depth_*.png",
    matches=_is_scanner_app,
    read=_read_scanner_app,
)


# --- Stray Scanner ----------------------------------------------------------------------------
#
# ``rgb.mp4``, ``odometry.csv``, ``camera_matrix.csv``, ``depth``, ``confidence``. A row of the
# odometry is a frame: its number names the depth map and the confidence map, its place among the
# rows is the frame's in the video. Poses are world_from_cam, quaternion x, y, z, w, and, unlike
# other apps', already of OpenCV's camera axes; the world has y up. Newer versions of the app write
# fx, fy, cx, cy with each row; ``camera_matrix.csv`` holds the last frame's.
#
# The app appends the first frame before the video's session begins, so that the file's edit list
# hides it. Players follow that list, which shifts every picture by one frame against the poses;
# here the list is ignored.

_VIDEO, _ODOMETRY, _MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
_MOST_FRAMES = 3e10  # of a recording: a year at a thousand a second


def _read_stray_scanner(root: Path) -> Scene:
    rows = _odometry(root / _ODOMETRY)
    video = root / _VIDEO
    seconds, size = frame_seconds(video, edits=False), video_header(video).size
    shared = None
    if (root / _MATRIX).is_file():
        shared = load_matrix(root / _MATRIX, (3, 3))[[0, 1, 0, 1], [0, 1, 2, 2]]
    frames = []
    for row in rows:
        place = int(row["frame"]) - int(rows[0]["frame"])
        number = f"{int(row['frame']):06d}"
        depth = root / "depth" / f"{number}.npy"  # of early versions of the app
        depth = depth if depth.is_file() else depth.with_suffix(".png")
        own = found_lens([row.get(key) for key in FLAT], size)
        inside = 0 <= place < len(seconds)
        turn = finite_array([row.get(key) for key in ("qw", "qx", "qy", "qz")], 4)
        centre = finite_array([row.get(key) for key in "xyz"], 3)
        lens = own or found_lens(shared, size)
        pose = None if turn is None or centre is None else quaternion_pose(turn, centre)
        reader = lidar_reader(root / "confidence" / f"{number}.png")
        image = video if inside else root / f"{_VIDEO}, frame {number}"
        read = partial(read_frame, seconds=seconds[place], edits=False) if inside else None
        frames.append(PosedFrame(number, image, lens, pose, depth, reader, read=read))
    findings = []
    if len(seconds) != len(rows):
        line = (
            f"{_VIDEO} has {len(seconds)} frames for {len(rows)} poses: pictures may belong to "
            "poses beside theirs; give the video as the app wrote it"
        )
        findings.append(Finding("warning", line))
    return phone_scene(root, "Stray Scanner", frames, findings=findings)


def _odometry(path: Path) -> list[dict[str, float]]:
    """The rows by the names of the header; what is no number is left out."""
    rows = []
    for line in csv_rows(path, again=AGAIN):
        row = {}
        for key, word in line.items():
            try:
                row[key.strip()] = float(word)
            except (AttributeError, TypeError, ValueError):
                continue  # a device without that value leaves it empty
        # A broken last line, of an export that was cut off, has no frame number.
        if abs(row.get("frame", np.nan)) < _MOST_FRAMES:
            rows.append(row)
    if not rows:
        raise ProjectError(
            f"{path}: no row with a frame number; expected columns timestamp, frame, x, y, z, qx, "
            f"qy, qz and qw; {AGAIN}"
        )
    return rows


STRAY_SCANNER = Layout.of_folder(
    "Stray Scanner",
    f"{_VIDEO}, {_ODOMETRY}, {_MATRIX}, depth",
    matches=lambda root: all((root / name).is_file() for name in (_ODOMETRY, _VIDEO)),
    read=_read_stray_scanner,
)


# --- Record3D ---------------------------------------------------------------------------------
#
# An ``.r3d`` archive, unpacked as every archive is, or an export of EXR and JPG.
#
# An archive (ZIP) has ``metadata``, a JSON, and ``rgbd/N.{jpg, depth, conf}``; depth is float32
# metres and confidence uint8, both compressed by LZFSE. The export has ``metadata.json``, ``rgb``
# and ``depth/N.exr`` (one float32 channel, metres) in a folder ``EXR_RGBD``, and no confidence.
#
# A frame's pose is the metadata's of its number: quaternion x, y, z, w and place of world_from_cam,
# OpenGL's axes. ``K`` is of the first frame, column by column; ``perFrameIntrinsicCoeffs`` has fx,
# fy, cx, cy of each. Both are of pictures of w x h. The world is where the recording began, so that
# none of its axes need be gravity's. Recordings of the selfie camera have no poses: each is the
# identity.

_EXPORT = "EXR_RGBD"
_PHOTOS = (".jpg", ".png")
_CHANNELS = ("R", "Y", "Z")
_NO_POSE = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
_LIDAR = (192, 256)  # width and height of depth maps where the metadata does not say


class Record3dMetadata(BaseModel):
    """What is read of a recording's metadata, named as there."""

    w: int = Field(gt=0)
    h: int = Field(gt=0)
    dw: int = Field(_LIDAR[0], gt=0)
    dh: int = Field(_LIDAR[1], gt=0)
    K: list[float] = Field(min_length=9, max_length=9)
    poses: list[list[float]] = Field(min_length=1)
    perFrameIntrinsicCoeffs: list[list[float]] = []

    def lens(self, number: int) -> LensParameters | None:
        """Of a frame, for pictures of ``w`` x ``h``; None where it is impossible."""
        given, size = self.perFrameIntrinsicCoeffs, (self.w, self.h)
        own = found_lens(given[number], size) if number < len(given) else None
        return own or found_lens([self.K[place] for place in (0, 4, 6, 7)], size)

    def pose(self, number: int) -> Float64 | None:
        """(4, 4) world_from_cam of a frame, OpenCV axes, metres; None where there is none."""
        values = finite_array(self.poses[number], 7) if number < len(self.poses) else None
        if values is None:
            return None
        return opencv_pose(quaternion_pose(values[[3, 0, 1, 2]], values[4:]))

    def frames(self, stems: set[str]) -> list[int]:
        """Numbers of frames that have a pose or a picture of that name."""
        return sorted({*range(len(self.poses)), *(int(stem) for stem in stems if stem.isdecimal())})


def _export(path: Path) -> Path | None:
    """The folder of an export of EXR and JPG, which may lie inside the one that is given."""
    for home in (path, path / _EXPORT):
        if (home / "metadata.json").is_file() and (home / "rgb").is_dir():
            return home
    return None


def _read_record3d(path: Path) -> Scene:
    export = _export(path)
    metadata = _metadata(path / "metadata" if export is None else export / "metadata.json")
    frames = _frames(export or path, metadata, exported=export is not None)
    line = "the world is where the recording began: which way is up is not said"
    findings = [Finding("info", line)]
    return phone_scene(path, "Record3D", frames, upright=False, findings=findings)


def _metadata(path: Path) -> Record3dMetadata:
    with reading(path, f"expected Record3D's form with w, h, K and poses; {AGAIN}"):
        metadata = Record3dMetadata.model_validate(read_json(path))
    if len(metadata.poses) > 1 and all(pose == _NO_POSE for pose in metadata.poses):
        raise ProjectError(
            f"{path}: no frame has a pose, as in recordings of the selfie camera; expected one of "
            "the LiDAR camera, or its pictures alone: gvtools capture finds their cameras"
        )
    return metadata


def _frames(home: Path, metadata: Record3dMetadata, *, exported: bool) -> list[PosedFrame]:
    """The frames of an export of EXR and JPG, or of a recording."""
    folder = home / ("rgb" if exported else "rgbd")
    images = {path.stem: path for path in folder.iterdir() if path.suffix in _PHOTOS}
    frames = []
    shape = metadata.dh, metadata.dw
    for number in metadata.frames(set(images)):
        depth, conf = folder / f"{number}.depth", folder / f"{number}.conf"
        read = partial(_lzfse_depth, confidence=conf if conf.is_file() else None, shape=shape)
        if exported:
            depth = home / "depth" / f"{number}.exr"
            read = partial(exr_depth, channels=_CHANNELS)
        image = images.get(str(number), folder / f"{number}.jpg")
        lens, pose = metadata.lens(number), metadata.pose(number)
        frames.append(PosedFrame(f"{number}.jpg", image, lens, pose, depth, read))
    return frames


def _lzfse_depth(path: Path, *, confidence: Path | None, shape: tuple[int, int]) -> Depth:
    """(h, w) depth of a map and, if there is any, its confidence."""
    depth = readings(_unpacked(path, "<f4", shape=shape))
    return depth if confidence is None else confident(
        depth, _unpacked(confidence, "u1", shape=shape) > 0
    )  # fmt: skip


def _unpacked(path: Path, dtype: str, *, shape: tuple[int, int]) -> NDArray[Any]:
    purpose = f"{path}: depth compressed by LZFSE"
    lzfse = require("lzfse", extra="phones", purpose=purpose, instead="or export EXR and JPG")
    expected = f"expected {shape[0]}x{shape[1]} values by LZFSE; {AGAIN}"
    with reading(path, expected, also=(lzfse.error,)):
        return np.frombuffer(lzfse.decompress(read_bytes(path)), dtype).reshape(shape)


RECORD3D = Layout.of_folder(
    "Record3D",
    f"an .r3d file, metadata with rgbd/, or {_EXPORT}/metadata.json",
    matches=lambda path: (
        ((path / "metadata").is_file() and (path / "rgbd").is_dir()) or _export(path) is not None
    ),
    read=_read_record3d,
)
