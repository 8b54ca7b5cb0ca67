"""What the readers of drawn (synthetic) data sets share: numbered files, tables, their cameras."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.posed_pictures import natural, pinhole_lens
from gvtools.scenes.images import read_header
from gvtools.scenes.transforms_frame import LensParameters
from gvtools.untrusted import read_text

Float64 = NDArray[np.float64]

# Stands in for the camera of a frame that has none and, since it has no pose either, is left out.
NO_LENS = pinhole_lens([1.0, 1.0, 0.5, 0.5], (1, 1))
SAME_PLACE = 0.01  # pixels; a principal point as near as this to the middle is meant to be there


def folders_with(root: Path, patterns: Iterable[str]) -> tuple[str, ...]:
    """Folders below ``root`` that hold something, relative and in natural order.

    Args:
        root: of the download.
        patterns: of what they hold, relative to ``root``: "*/images" finds "0000", not
            "0000/images".
    """
    found = (path.parent for pattern in patterns for path in root.glob(pattern))
    return natural(path.relative_to(root).as_posix() for path in found)


def numbers_in(folder: Path, template: str) -> set[int]:
    """Which numbers the files of a folder have; none where there is no such folder.

    Args:
        folder: holds the files.
        template: their names, such as "rgb_{:05d}.jpg".
    """
    before, after = re.split(r"\{.*\}", template)
    name = re.compile(f"{re.escape(before)}([0-9]+){re.escape(after)}")
    try:
        matches = [name.fullmatch(entry) for entry in os.listdir(folder)]
    except (FileNotFoundError, NotADirectoryError):
        return set()
    return {int(match[1]) for match in matches if match}


def number_table(path: Path, columns: int, *, header: bool = False) -> Float64:
    """(N, columns) float64 of a text file with one row a line; no rows where it is absent.

    Args:
        path: the file.
        columns: that each row has.
        header: whether the first line holds names.
    """
    try:
        lines = read_text(path).splitlines()[int(header) :]
    except FileNotFoundError:
        lines = []
    except (OSError, UnicodeDecodeError) as error:
        raise ProjectError(f"{path}: unreadable ({error}); download it again") from None
    rows = [line.split() for line in lines if line.strip()]
    for number, row in enumerate(rows, start=1):
        if len(row) != columns:
            raise ProjectError(
                f"{path}: row {number} of {len(rows)} has {len(row)} numbers; expected {columns}; "
                "download it again"
            )
    try:
        return np.array(rows, np.float64).reshape(-1, columns)
    except ValueError as error:
        raise ProjectError(f"{path}: {error}; expected {columns} numbers in each row") from None


def picture_size(pictures: Iterable[Path]) -> tuple[int, int]:
    """Width and height of the first picture that can be read, pixels; 1 x 1 where none can.

    For layouts that do not store the size which their intrinsics are of.
    """
    for path in pictures:
        try:
            header = read_header(path)
        except ProjectError:
            continue
        return header.width, header.height
    return 1, 1


def drawn_lens(values: Iterable[float], size: tuple[int, int]) -> LensParameters:
    """A renderer's camera, whichever way its data set counts pixels.

    It looks through the middle of its picture. So a principal point at ((W - 1) / 2, (H - 1) / 2)
    says that the first pixel's centre is meant to be (0, 0), and is moved by half a pixel; one at
    (W / 2, H / 2), or anywhere else, stays.

    Args:
        values: fx, fy, cx, cy, pixels.
        size: width and height of the picture, pixels.

    >>> drawn_lens([725.0, 725.0, 620.5, 187.0], (1242, 375)).values
    (725.0, 725.0, 621.0, 187.5)
    """
    fx, fy, cx, cy = values
    off = abs(cx - (size[0] - 1) / 2), abs(cy - (size[1] - 1) / 2)
    if max(off) < SAME_PLACE:
        cx, cy = cx + 0.5, cy + 0.5
    return pinhole_lens([fx, fy, cx, cy], size)


def pose_of(rotation: Float64, translation: Float64) -> Float64:
    """(N, 4, 4) rigid transforms of (N, 3, 3) rotations and (N, 3) translations."""
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation, translation
    return poses
