"""COLMAP's dense depth maps: ``width&height&channels&`` and then float32, row by row."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ProjectError, ShapeError
from gvtools.files import replaced_when_written
from gvtools.untrusted import is_file, regular

KINDS = ("geometric", "photometric")  # the first that exists is read
_HEAD = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")


def depth_map_path(folder: Path, name: str) -> tuple[Path, str] | None:
    """The depth map of the image called ``name`` and its kind; None when there is none."""
    for kind in KINDS:
        path = folder / f"{name}.{kind}.bin"
        if is_file(path):
            return path, kind
    return None


def depth_map_size(path: Path) -> tuple[int, int]:
    """Width and height of the depth map at ``path``, pixels, checked against the file's size."""
    return _head(path)[:2]


def _head(path: Path) -> tuple[int, int, int]:
    try:
        with regular(path).open("rb") as file:
            head = _HEAD.match(file.read(64))
        size = path.stat().st_size
    except OSError as error:
        raise ProjectError(f"{path}: unreadable ({error.strerror})") from None
    if head is None:
        raise ProjectError(
            f"{path}: no COLMAP depth map; expected it to start with 'width&height&1&'"
        )
    width, height, channels = (int(group) for group in head.groups())
    expected = head.end() + 4 * width * height * channels
    if channels != 1 or size != expected:
        raise ProjectError(
            f"{path}: {size} bytes with the head {width}x{height}x{channels}; expected {expected} "
            "bytes and one channel; the file is truncated or damaged; compute or copy it again"
        )
    return width, height, head.end()


def read_depth_map(path: Path) -> NDArray[np.float32]:
    """(H, W) float32 z-depth of the map at ``path``, scene units; 0 = none."""
    width, height, start = _head(path)
    values = np.fromfile(regular(path), "<f4", offset=start).reshape(height, width)
    return np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)


def write_depth_map(path: Path, depth: ArrayLike) -> None:
    """Write (H, W) z-depth, scene units, 0 = none, in COLMAP's form."""
    values = np.asarray(depth, "<f4")
    if values.ndim != 2:
        raise ShapeError(f"{path}: depth of shape {values.shape}; expected (H, W)")
    head = f"{values.shape[1]}&{values.shape[0]}&1&".encode()
    with replaced_when_written(path) as temporary:
        temporary.write_bytes(head + values.tobytes())
