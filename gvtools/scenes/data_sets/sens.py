"""ScanNet's ``.sens`` files, version 4: a head with the cameras, then frames one after another."""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.images import UNREADABLE
from gvtools.scenes.photographs import Depth
from gvtools.scenes.scene import Frame
from gvtools.untrusted import open_picture, regular

Float64 = NDArray[np.float64]

VERSION = 4
COLOR_CODES = {1: "png", 2: "jpeg"}
ZLIB_USHORT, RAW_USHORT = 1, 0
FRAME_HEAD = struct.Struct("<16fQQQQ")  # pose, two time stamps, sizes of colour and depth


@dataclass(frozen=True, eq=False)
class SensFrame:
    """Where one frame lies in the file.

    Attributes:
        world_from_cam: (4, 4) float64, metres; infinite where tracking was lost.
        offset: of the colour's bytes, which depth's follow.
        color_bytes: how many.
        depth_bytes: how many.
    """

    world_from_cam: Float64
    offset: int
    color_bytes: int
    depth_bytes: int


@dataclass(frozen=True, eq=False)
class SensFile:
    """The head of a file and the index of its frames; no picture is held.

    Attributes:
        color_K: (4, 4) float64, pixels, first pixel's centre (0, 0).
        color_extrinsic: (4, 4) float64.
        depth_K: (4, 4), as ``color_K``.
        depth_extrinsic: (4, 4).
        color_size: width and height, pixels.
        depth_size: width and height, pixels.
        depth_code: how depth is compressed.
        depth_unit: metres in a stored unit.
        count: of frames, as the head says.
        frames: those that are there whole.
    """

    color_K: Float64
    color_extrinsic: Float64
    depth_K: Float64
    depth_extrinsic: Float64
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_code: int
    depth_unit: float
    count: int
    frames: tuple[SensFrame, ...]

    @staticmethod
    def open(path: Path) -> SensFile:
        """The head and the index of a file, which may end early."""
        try:
            with regular(path).open("rb") as file:
                (version,) = _unpack(file, "<I")
                if version != VERSION:
                    raise ProjectError(
                        f"{path}: version {version}; expected {VERSION} of a .sens file"
                    )
                (length,) = _unpack(file, "<Q")
                file.seek(length, io.SEEK_CUR)
                matrices = np.array(_unpack(file, "<64f")).reshape(4, 4, 4)
                color_code, depth_code, *sizes = _unpack(file, "<iiIIII")
                shift, count = _unpack(file, "<fQ")
                frames = _index(file, count, path.stat().st_size)
        except (OSError, OverflowError, ValueError, struct.error) as error:
            raise ProjectError(f"{path}: no readable .sens file ({error}); copy it again") from None
        if not shift > 0:
            raise ProjectError(f"{path}: {shift:g} depth steps a metre; expected a positive number")
        if color_code not in COLOR_CODES or depth_code not in (ZLIB_USHORT, RAW_USHORT):
            raise ProjectError(
                f"{path}: colour of compression {color_code} and depth of {depth_code}; expected "
                "PNG or JPEG, and zlib or none"
            )
        return SensFile(
            matrices[0], matrices[1], matrices[2], matrices[3],
            (sizes[0], sizes[1]), (sizes[2], sizes[3]),
            depth_code, 1.0 / shift, count, tuple(frames),
        )  # fmt: skip


def _unpack(file: BinaryIO, form: str) -> tuple[int, ...]:
    return struct.unpack(form, file.read(struct.calcsize(form)))


def _index(file: BinaryIO, count: int, end: int) -> list[SensFrame]:
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


def read_color(path: Path, *, frame: SensFrame) -> Frame:
    """The picture of a frame."""
    try:
        with regular(path).open("rb") as file:
            file.seek(frame.offset)
            image = open_picture(file.read(frame.color_bytes))
            return Frame(np.array(image.convert("RGB")))
    except UNREADABLE as error:
        raise ProjectError(f"{path}: unreadable picture ({error}); copy it again") from None


def read_sens_depth(path: Path, *, frame: SensFrame, sens: SensFile) -> Depth:
    """(h, w) float32 z-depth of the depth camera, metres, 0 for none."""
    width, height = sens.depth_size
    try:
        with regular(path).open("rb") as file:
            file.seek(frame.offset + frame.color_bytes)
            data = file.read(frame.depth_bytes)
        if sens.depth_code == ZLIB_USHORT:
            data = zlib.decompress(data)
        raw = np.frombuffer(data, "<u2").reshape(height, width)
    except (OSError, ValueError, zlib.error) as error:
        raise ProjectError(f"{path}: unreadable depth ({error}); copy it again") from None
    depth = raw.astype(np.float32) * np.float32(sens.depth_unit)
    return np.where(raw == np.uint16(65535), np.float32(0), depth)
