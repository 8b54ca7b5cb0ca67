"""The files of a COLMAP model: where they are, and whether a reader got all that they hold.

pycolmap refuses most damage by itself, but takes whatever memory a wrong count asks for, and does
not notice that a binary file ends early.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import ProjectError
from gvtools.untrusted import number_key, read_bytes, read_text, regular

if TYPE_CHECKING:
    import pycolmap

REQUIRED = ("cameras", "images", "points3D")
RIGGED = ("rigs", "frames")
# Where a model lies inside a workspace, best first. A place may hold several, numbered from 0.
PLACES = ("sparse", ".", "colmap/sparse", "sparse_txt")
# Bytes of the smallest record of each binary file.
LEAST_BYTES = {"cameras": 24, "images": 73, "points3D": 51, "rigs": 8, "frames": 68}


@dataclass(frozen=True)
class ModelFiles:
    """A model on disk.

    Attributes:
        folder: where its files are.
        suffix: ".bin" or ".txt".
        others: further models of the workspace that are not read, with their image counts.
    """

    folder: Path
    suffix: str
    others: tuple[tuple[str, int], ...] = ()


def has_model(folder: Path) -> bool:
    """Whether a folder holds a camera file of COLMAP."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def find_model(root: Path, *, number: int | None = None) -> Path | None:
    """The model folder of a workspace, or ``root`` when it is one; None when there is none.

    Args:
        root: the workspace.
        number: of the model, where the workspace holds several (``sparse/0``, ``sparse/1``, ...);
            None takes the one with most images, the first of equals.
    """
    for place in PLACES:
        numbered = _numbered(root / place)
        if number is not None:
            if number in numbered:
                return numbered[number]
            continue
        if numbered:
            return max(numbered.values(), key=_count_images)
        if has_model(root / place):
            return root / place
    if number is None:
        return None
    known = [str(key) for place in PLACES for key in _numbered(root / place)]
    raise ProjectError(
        f"{root}: no COLMAP model of number {number}; it holds {', '.join(known) or 'none'}"
    )


def _numbered(folder: Path) -> dict[int, Path]:
    """Models in sub-folders that are numbers, by these, ascending."""
    if folder.name not in ("sparse", "sparse_txt") or not folder.is_dir():
        return {}
    found = [path for path in folder.iterdir() if path.name.isdecimal() and has_model(path)]
    return {int(path.name): path for path in sorted(found, key=lambda path: int(path.name))}


def model_files(folder: Path) -> ModelFiles:
    """The files of the model in ``folder``, complete and with counts that they can hold."""
    suffix = _suffix(folder)
    rigged = [stem for stem in RIGGED if (folder / f"{stem}{suffix}").is_file()]
    if len(rigged) == 1:
        missing = next(stem for stem in RIGGED if stem not in rigged)
        raise ProjectError(
            f"{folder}: has {rigged[0]}{suffix} without {missing}{suffix}; "
            "expected both or none; copy the whole model again"
        )
    if suffix == ".bin":
        for stem in (*REQUIRED, *rigged):
            path = folder / f"{stem}.bin"
            size, count = path.stat().st_size, _count(path)
            if size < 8 or count * LEAST_BYTES[stem] + 8 > size:
                raise _damaged(path, f"{count} records that its head names cannot be in it")
        for stem in (*REQUIRED, *rigged):
            if stem != "cameras":
                _check_records(folder / f"{stem}.bin")
    else:
        _check_points(folder / "points3D.txt")
    return ModelFiles(folder, suffix, _siblings(folder))


def check_cameras(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Compare the size of cameras.bin with the cameras that a reader got from it."""
    path = folder / "cameras.bin"
    expected = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if path.stat().st_size != expected:
        raise _damaged(path, f"its cameras take {expected}")


def _check_records(path: Path) -> None:
    """Walk a file by the counts in each record."""
    data = read_bytes(path)
    offset, record_end = 8, _RECORD_ENDS[path.stem]
    try:
        for _ in range(_count(path)):
            offset = record_end(data, offset)
            if offset > len(data):
                break
    except (struct.error, ValueError):
        offset = -1
    if offset != len(data):
        raise _damaged(path, "its records take another number")


def _image_end(data: bytes, at: int) -> int:
    name_end = data.index(b"\0", at + 64)
    return name_end + 9 + 24 * int(struct.unpack_from("<Q", data, name_end + 1)[0])


def _point_end(data: bytes, at: int) -> int:
    return at + 51 + 8 * int(struct.unpack_from("<Q", data, at + 43)[0])


def _rig_end(data: bytes, at: int) -> int:
    """Its id, and its sensors: the first is the reference, the others may have a pose to it."""
    sensors = int(struct.unpack_from("<I", data, at + 4)[0])
    at += 8 + (8 if sensors else 0)
    for _ in range(sensors - 1):
        if at >= len(data):
            break
        at += 9 + (56 if struct.unpack_from("<B", data, at + 8)[0] else 0)
    return at


def _frame_end(data: bytes, at: int) -> int:
    return at + 68 + 16 * int(struct.unpack_from("<I", data, at + 64)[0])


_RECORD_ENDS: dict[str, Callable[[bytes, int], int]] = {
    "images": _image_end,
    "points3D": _point_end,
    "rigs": _rig_end,
    "frames": _frame_end,
}


def _check_points(path: Path) -> None:
    """Refuse a line of points3D.txt that lacks a number: pycolmap would read the rest shifted."""
    for at, line in enumerate(read_text(path, errors="replace").splitlines(), 1):
        words = 0 if line.startswith("#") else len(line.split())
        if words and (words < 8 or words % 2):
            raise ProjectError(
                f"{path}, line {at}: {words} values; expected id, x, y, z, r, g, b, error, pairs "
                "of image and feature; export the model again"
            )


def _damaged(path: Path, reason: str) -> ProjectError:
    return ProjectError(
        f"{path}: {path.stat().st_size} bytes, and {reason}; the file is truncated or damaged; "
        "copy or export it again"
    )


def _suffix(folder: Path) -> str:
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in REQUIRED):
            return suffix
    found = sorted(path.name for path in folder.iterdir() if path.suffix in (".bin", ".txt"))
    raise ProjectError(
        f"{folder}: an incomplete model, with {', '.join(found)}; expected cameras, images and "
        "points3D, all .bin or all .txt; copy the whole model again"
    )


def _siblings(folder: Path) -> tuple[tuple[str, int], ...]:
    if folder.parent.name not in ("sparse", "sparse_txt"):
        return ()
    return tuple(
        (path.name, _count_images(path))
        for path in sorted(folder.parent.iterdir())
        if path != folder and path.is_dir() and has_model(path)
    )


def _count_images(folder: Path) -> int:
    """How many images the model in ``folder`` claims to hold; 0 when that cannot be told."""
    if (folder / "images.bin").is_file():
        return _count(folder / "images.bin")
    return len(text_names(folder)) if (folder / "images.txt").is_file() else 0


def _count(path: Path) -> int:
    """The count of records that a binary file begins with."""
    with regular(path).open("rb") as file:
        head = file.read(8)
    return int(struct.unpack("<Q", head)[0]) if len(head) == 8 else 0


def text_names(folder: Path) -> dict[int, str]:
    """The images' whole names in a text model, by id; pycolmap stops at the first blank."""
    path = folder / "images.txt"
    try:
        lines = read_text(path).splitlines()
    except UnicodeDecodeError as error:
        raise ProjectError(f"{path}: no text in UTF-8 ({error.reason})") from None
    # An image has two lines, the second of which may be empty; empty ones before it do not count.
    names, rest = {}, iter(lines)
    for line in rest:
        if line.strip() and not line.startswith("#"):
            row = line.split(maxsplit=9)
            if len(row) == 10 and row[0].isdecimal():
                names[number_key(row[0])] = row[9].strip()
            next(rest, None)
    return names
