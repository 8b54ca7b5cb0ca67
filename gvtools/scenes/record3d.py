"""Record3D: an ``.r3d`` archive, the folder that it was unpacked into, or an export of EXR and JPG.

An archive (ZIP) has ``metadata``, a JSON, and ``rgbd/N.{jpg, depth, conf}``; depth is float32
metres and confidence uint8, both compressed by LZFSE. The export has ``metadata.json``, ``rgb`` and
``depth/N.exr`` (one float32 channel, metres) in a folder ``EXR_RGBD``, and no confidence.

A frame's pose is the metadata's of its number: quaternion x, y, z, w and place of world_from_cam,
OpenGL's axes. ``K`` is of the first frame, column by column; ``perFrameIntrinsicCoeffs`` has fx,
fy, cx, cy of each. Both are of pictures of w x h. The world is where the recording began, so that
none of its axes need be gravity's. Recordings of the selfie camera have no poses: each is the
identity.
"""

from __future__ import annotations

import ctypes
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError

from gvtools.errors import ProjectError
from gvtools.optional import require
from gvtools.scenes.calibration import (
    Float64,
    finite_array,
    opencv_pose,
    pinhole_lens,
    quaternion_pose,
    scaled_lens,
)
from gvtools.scenes.depth_files import exr_depth
from gvtools.scenes.images import decode_picture, readings
from gvtools.scenes.layout import Layout
from gvtools.scenes.phones import confident, phone_scene
from gvtools.scenes.photographs import Depth, PosedFrame
from gvtools.scenes.scene import Finding, Frame, Scene
from gvtools.scenes.undistort import LensParameters
from gvtools.untrusted import archive, open_picture, parse_json, read_bytes

ARCHIVE, EXPORT = ".r3d", "EXR_RGBD"
PICTURES = (".jpg", ".png")
CHANNELS = ("R", "Y", "Z")
NO_POSE = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
# LZFSE packs no more bytes than this into one.
LZFSE_RATIO = 4000
LIDAR = (192, 256)  # width and height of depth maps where the metadata does not say


class Metadata(BaseModel):
    """What is read of a recording's metadata, named as there."""

    w: int = Field(gt=0)
    h: int = Field(gt=0)
    dw: int = Field(LIDAR[0], gt=0)
    dh: int = Field(LIDAR[1], gt=0)
    K: list[float] = Field(min_length=9, max_length=9)
    poses: list[list[float]] = Field(min_length=1)
    perFrameIntrinsicCoeffs: list[list[float]] = []

    def lens(self, number: int) -> LensParameters | None:
        """Of a frame, for pictures of ``w`` x ``h``; None where it is impossible."""
        given = self.perFrameIntrinsicCoeffs
        own = finite_array(given[number], 4) if number < len(given) else None
        K = finite_array([self.K[place] for place in (0, 4, 6, 7)], 4) if own is None else own
        return None if K is None else pinhole_lens(K, (self.w, self.h))

    def pose(self, number: int) -> Float64 | None:
        """(4, 4) world_from_cam of a frame, OpenCV axes, metres; None where there is none."""
        values = finite_array(self.poses[number], 7) if number < len(self.poses) else None
        if values is None:
            return None
        return opencv_pose(quaternion_pose(values[[3, 0, 1, 2]], values[4:]))

    def frames(self, stems: set[str]) -> list[int]:
        """Numbers of frames that have a pose or a picture of that name."""
        return sorted({*range(len(self.poses)), *(int(stem) for stem in stems if stem.isdecimal())})


def _matches(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() == ARCHIVE
    unpacked = (path / "metadata").is_file() and (path / "rgbd").is_dir()
    return unpacked or _export(path) is not None


def _export(path: Path) -> Path | None:
    """The folder of an export of EXR and JPG, which may lie inside the one that is given."""
    for home in (path, path / EXPORT):
        if (home / "metadata.json").is_file() and (home / "rgb").is_dir():
            return home
    return None


def _read(path: Path) -> Scene:
    home = _export(path)
    if home is None:
        pictures, bare = _from_archive(path, _metadata(path, "metadata"))
    else:
        pictures, bare = _from_export(home, _metadata(home, "metadata.json"))
    findings = [
        Finding("info", "the world is where the recording began: which way is up is not said")
    ]
    if bare:
        line = f"{bare} depth maps have no confidence map: all of their depth is used"
        findings.append(Finding("info", line))
    return phone_scene(path, "Record3D", pictures, upright=False, findings=findings)


def _metadata(home: Path, name: str) -> Metadata:
    try:
        metadata = Metadata.model_validate(parse_json(_stored(home, name)))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ProjectError(
            f"{home}: {name} of another form ({place}: {first['msg']}); expected Record3D's with "
            "w, h, K and poses; export the recording again"
        ) from None
    except ValueError as error:
        raise ProjectError(
            f"{home}: {name} is no JSON ({error}); export the recording again"
        ) from None
    if len(metadata.poses) > 1 and all(pose == NO_POSE for pose in metadata.poses):
        raise ProjectError(
            f"{home}: no frame has a pose, as in recordings of the selfie camera; expected one of "
            "the LiDAR camera, or its pictures alone: gvtools capture finds their cameras"
        )
    return metadata


def _from_export(home: Path, metadata: Metadata) -> tuple[list[PosedFrame], int]:
    """The frames, and how many depth maps lack confidence."""
    images = {path.stem: path for path in (home / "rgb").iterdir() if path.suffix in PICTURES}
    pictures, bare = [], 0
    for number in metadata.frames(set(images)):
        depth = home / "depth" / f"{number}.exr"
        bare += depth.is_file()
        pictures.append(
            PosedFrame(
                f"{number}.jpg",
                images.get(str(number), home / "rgb" / f"{number}.jpg"),
                metadata.lens(number),
                metadata.pose(number),
                depth,
                partial(exr_depth, channels=CHANNELS),
            )
        )
    return pictures, bare


def _from_archive(path: Path, metadata: Metadata) -> tuple[list[PosedFrame], int]:
    """The frames, and how many depth maps lack confidence."""
    held, packed = _members(path), path.is_file()
    stems = {Path(name).stem for name in held if name.endswith(".jpg")}
    size = _picture_size(path, held) if packed else None
    pictures, bare = [], 0
    for number in metadata.frames(stems):
        image, depth, conf = (f"rgbd/{number}.{kind}" for kind in ("jpg", "depth", "conf"))
        lens = metadata.lens(number)
        bare += depth in held and conf not in held
        maps = [name for name in (depth, conf) if name in held]
        pictures.append(
            PosedFrame(
                f"{number}.jpg",
                # What an archive lacks is given as a path that does not exist.
                path if packed and image in held else path / image,
                lens if lens is None or size is None else scaled_lens(lens, size),
                metadata.pose(number),
                path if packed and depth in held else path / depth,
                partial(_lzfse_depth, path, maps, shape=(metadata.dh, metadata.dw)),
                read=partial(_picture, member=image) if packed and image in held else None,
            )
        )
    return pictures, bare


def _members(path: Path) -> set[str]:
    """Names of the frames' files, in an archive or the folder that it was unpacked into."""
    if not path.is_file():
        return {f"rgbd/{item.name}" for item in (path / "rgbd").iterdir()}
    try:
        with archive(path) as opened:
            return {item.filename for item in opened.infolist() if item.file_size}
    except (OSError, ValueError) as error:
        raise _damaged(path, error) from None


def _stored(home: Path, name: str) -> bytes:
    """A file of a folder or of an archive."""
    try:
        if not home.is_file():
            return read_bytes(home / name)
        with archive(home) as opened:
            return opened.read(name)
    except (OSError, KeyError, ValueError) as error:
        raise _damaged(home / name, error) from None


def _damaged(path: Path, error: Exception) -> ProjectError:
    return ProjectError(f"{path}: unreadable ({error}); export the recording again")


def _picture_size(path: Path, held: set[str]) -> tuple[int, int] | None:
    """Width and height of an archive's first readable picture."""
    for name in sorted(held):
        if name.endswith(".jpg"):
            try:
                return open_picture(_stored(path, name)).size
            except (OSError, ValueError, ProjectError):
                continue
    return None


def _picture(path: Path, *, member: str) -> Frame:
    return decode_picture(_stored(path, member), where=str(path / member))


def _lzfse_depth(home: Path, maps: list[str], _: Path, *, shape: tuple[int, int]) -> Depth:
    """(h, w) depth; ``maps`` are names of it and, if there is any, its confidence in ``home``."""
    depth = readings(_unpacked(home, maps[0], "<f4", shape=shape))
    if len(maps) == 1:
        return depth
    return confident(depth, _unpacked(home, maps[1], "u1", shape=shape) > 0)


def _unpacked(home: Path, name: str, dtype: str, *, shape: tuple[int, int]) -> NDArray[Any]:
    lzfse = require(
        "lzfse",
        extra="phones",
        purpose=f"{home}: depth compressed by LZFSE",
        instead="or export EXR and JPG",
    )
    try:
        data = _decompressed(_stored(home, name), np.dtype(dtype).itemsize * shape[0] * shape[1])
        return np.frombuffer(data, dtype).reshape(shape)
    except (lzfse.error, ValueError, MemoryError) as error:
        raise ProjectError(
            f"{home / name}: unreadable ({error}); expected {shape[0]}x{shape[1]} values by LZFSE; "
            "export the recording again"
        ) from None


def _decompressed(data: bytes, size: int) -> bytes:
    """What LZFSE packed, which has to be of so many bytes.

    The package's own function takes ever more memory for damaged data. The library inside it, which
    takes a buffer of fixed size, is called where it can be found.
    """
    import lzfse

    try:
        decode = ctypes.CDLL(lzfse.__file__).lzfse_decode_buffer
    except (OSError, AttributeError):
        return bytes(lzfse.decompress(data))
    if size > LZFSE_RATIO * len(data):
        raise ValueError(f"{len(data)} bytes for {size}")
    decode.restype = ctypes.c_size_t
    decode.argtypes = [
        ctypes.c_void_p, ctypes.c_size_t, ctypes.c_char_p, ctypes.c_size_t, ctypes.c_void_p,
    ]  # fmt: skip
    buffer = ctypes.create_string_buffer(size + 1)
    found = decode(buffer, size + 1, data, len(data), None)
    if found != size:
        raise ValueError(f"damaged, or {found} bytes")
    return buffer.raw[:size]


RECORD3D = Layout.of_folder(
    "Record3D",
    f"an .r3d file, metadata with rgbd/, or {EXPORT}/metadata.json",
    matches=_matches,
    read=_read,
)
