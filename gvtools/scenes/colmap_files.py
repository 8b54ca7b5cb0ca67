"""The files of a COLMAP model: where they are, and whether they are whole before they are read.

A wrong count in a binary file makes a reader reserve any amount of memory, a short text line takes
its numbers from elsewhere, and neither raises an error by itself; so every record is walked first.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from gvtools.errors import ProjectError

REQUIRED = ("cameras", "images", "points3D")
RIGGED = ("rigs", "frames")
# Where a model lies inside a workspace, best first.
PLACES = ("sparse/0", "sparse", ".", "colmap/sparse/0", "colmap/sparse")

_POSE_DOUBLES = 7 * 8


@dataclass(frozen=True)
class ModelFiles:
    """A model on disk.

    Attributes:
        folder: where its files are.
        suffix: ".bin" or ".txt".
        names: for text, each image id's whole name: readers stop at the first blank.
        others: further models of the workspace that are not read, with their image counts.
    """

    folder: Path
    suffix: str
    names: dict[int, str] = field(default_factory=dict)
    others: tuple[tuple[str, int], ...] = ()


def has_model(folder: Path) -> bool:
    """Whether a folder holds a camera file of COLMAP."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def find_model(root: Path) -> Path | None:
    """The model folder of a workspace, or ``root`` when it is one; None when there is none."""
    for place in PLACES:
        if has_model(root / place):
            return root / place
    numbered = sorted(
        (path for path in root.glob("sparse/*") if path.name.isdecimal() and has_model(path)),
        key=lambda path: int(path.name),
    )
    return numbered[0] if numbered else None


def check_model(folder: Path) -> ModelFiles:
    """Walk every record of the model in ``folder``.

    Raises:
        ProjectError: files are missing, empty, truncated, oversized or malformed.
    """
    suffix = _suffix(folder)
    rigged = [stem for stem in RIGGED if (folder / f"{stem}{suffix}").is_file()]
    if len(rigged) == 1:
        missing = next(stem for stem in RIGGED if stem not in rigged)
        raise ProjectError(
            f"{folder}: has {rigged[0]}{suffix} without {missing}{suffix}; "
            "expected both or none; copy the whole model again"
        )
    names: dict[int, str] = {}
    if suffix == ".bin":
        _check_count(folder / "cameras.bin", least=24)
        for stem in ("images", "points3D", *rigged):
            _walk(folder / f"{stem}.bin", _WALKERS[stem])
    else:
        names = _check_text_images(folder / "images.txt")
        _check_text(folder / "cameras.txt", minimum=5, numeric=(0, 2, 3))
        _check_text(folder / "points3D.txt", minimum=8, pairs_from=8)
    return ModelFiles(folder, suffix, names, _siblings(folder))


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
    if folder.parent.name != "sparse":
        return ()
    return tuple(
        (path.name, count_images(path))
        for path in sorted(folder.parent.iterdir())
        if path != folder and path.is_dir() and has_model(path)
    )


def count_images(folder: Path) -> int:
    """How many images the model in ``folder`` claims to hold; 0 when that cannot be told."""
    if (folder / "images.bin").is_file():
        head = (folder / "images.bin").open("rb").read(8)
        return int(struct.unpack("<Q", head)[0]) if len(head) == 8 else 0
    if not (folder / "images.txt").is_file():
        return 0
    lines = _lines(folder / "images.txt")
    return sum(not line.startswith("#") for line in lines) // 2


def _check_count(path: Path, *, least: int) -> None:
    """Refuse a count of more records, of ``least`` bytes each, than the file can hold."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(8)
    count = struct.unpack("<Q", head)[0] if len(head) == 8 else 1
    if count * least + 8 > size:
        raise ProjectError(
            f"{path}: {size} bytes cannot hold the {count} records that its head names; the file "
            "is truncated or damaged; copy or export it again"
        )


def _walk(path: Path, step: Callable[[bytes, int], int]) -> None:
    data = path.read_bytes()
    count = struct.unpack_from("<Q", data)[0] if len(data) >= 8 else 0
    offset, done = 8, 0
    try:
        while done < count and offset < len(data):
            offset = step(data, offset)
            done += 1
    except (struct.error, ValueError):
        offset = len(data) + 1
    if done != count or offset != len(data):
        raise ProjectError(
            f"{path}: {len(data)} bytes do not hold exactly the {count} records that its head "
            f"names ({done} read); the file is truncated or damaged; copy or export it again"
        )


def check_cameras_size(path: Path, parameter_counts: list[int]) -> None:
    """Compare a camera file's size with the cameras that a reader got from it.

    Raises:
        ProjectError: the sizes differ, so parameters were cut off.
    """
    expected = 8 + sum(24 + 8 * count for count in parameter_counts)
    if path.stat().st_size != expected:
        raise ProjectError(
            f"{path}: {path.stat().st_size} bytes; expected {expected} for "
            f"{len(parameter_counts)} cameras; the file is damaged; copy or export it again"
        )


def _step_image(data: bytes, offset: int) -> int:
    end = data.index(b"\0", offset + 4 + _POSE_DOUBLES + 4)
    return int(end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0])


def _step_point(data: bytes, offset: int) -> int:
    return int(offset + 51 + 8 * struct.unpack_from("<Q", data, offset + 43)[0])


def _step_rig(data: bytes, offset: int) -> int:
    sensors = struct.unpack_from("<I", data, offset + 4)[0]
    offset += 8 + (8 if sensors else 0)
    for _ in range(1, sensors):
        offset += 9 + (_POSE_DOUBLES if data[offset + 8 : offset + 9] == b"\1" else 0)
        if offset > len(data):
            raise ValueError(offset)
    return int(offset)


def _step_frame(data: bytes, offset: int) -> int:
    ids = offset + 8 + _POSE_DOUBLES
    return int(ids + 4 + 16 * struct.unpack_from("<I", data, ids)[0])


_WALKERS: dict[str, Callable[[bytes, int], int]] = {
    "images": _step_image,
    "points3D": _step_point,
    "rigs": _step_rig,
    "frames": _step_frame,
}


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ProjectError(f"{path}: no text in UTF-8 ({error.reason})") from None


def _check_text_images(path: Path) -> dict[int, str]:
    """Every image's name, after checking that its two lines are whole."""
    names: dict[int, str] = {}
    lines = enumerate(_lines(path), start=1)
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        tokens = line.split(maxsplit=9)
        whole = len(tokens) == 10 and _are_whole((tokens[0], tokens[8]))
        if not whole or not _are_numbers(tokens[:9]):
            raise _malformed(path, number, line, "ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        names[int(tokens[0])] = tokens[9].strip()
        number, points = next(lines, (number + 1, ""))
        if len(points.split()) % 3:
            raise _malformed(
                path, number, points, "X Y POINT3D_ID triplets (an image has two lines)"
            )
    return names


def _check_text(
    path: Path, *, minimum: int, numeric: tuple[int, ...] = (), pairs_from: int | None = None
) -> None:
    for number, line in enumerate(_lines(path), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        tokens = line.split()
        if (
            len(tokens) < minimum
            or (pairs_from is not None and (len(tokens) - pairs_from) % 2)
            or not _are_numbers([tokens[i] for i in numeric])
        ):
            form = "ID X Y Z R G B ERROR and pairs" if pairs_from else "ID MODEL WIDTH HEIGHT ..."
            raise _malformed(path, number, line, form)


def _are_numbers(tokens: list[str]) -> bool:
    try:
        return all(float(token) == float(token) for token in tokens)
    except ValueError:
        return False


def _are_whole(tokens: Iterable[str]) -> bool:
    try:
        return all(int(token) >= 0 for token in tokens)
    except ValueError:
        return False


def _malformed(path: Path, number: int, line: str, form: str) -> ProjectError:
    shown = line if len(line) <= 60 else line[:57] + "..."
    return ProjectError(
        f"{path}, line {number}: malformed: {shown!r}; expected {form}; export the model again"
    )
