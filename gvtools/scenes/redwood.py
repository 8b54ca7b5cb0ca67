"""The Redwood and Open3D layout: ``color/``, ``depth/`` and a ``.log`` trajectory.

Each pose of the ``.log`` trajectory is camera-to-world; its first integer is the number of its
picture in natural order. Of several ``.log`` files ``trajectory.log`` is read. Intrinsics come from
a JSON file in Open3D's form (column by column), which counts pixel centres as integers, or are the
PrimeSense default.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.photographs import named
from gvtools.scenes.rgbd import RgbdLayout
from gvtools.scenes.rgbd_recording import (
    Recording,
    RgbdFrame,
    RgbdOptions,
    open3d_intrinsics,
    pictures_in,
    pinhole,
)
from gvtools.scenes.scene import Finding
from gvtools.untrusted import read_bytes, read_text

Float64 = NDArray[np.float64]

COLOR_FOLDERS = ("color", "image", "rgb")
PREFERRED_LOG = "trajectory.log"
# The sensor of these recordings, as Open3D's own "PrimeSense default".
PRIMESENSE = pinhole((525.0, 525.0, 319.5, 239.5))


def _matches(root: Path) -> bool:
    folders = (root / "depth").is_dir() and color_folder(root) is not None
    return folders and any(root.glob("*.log"))


def _record(root: Path, options: RgbdOptions) -> Recording:
    findings = []
    folder = color_folder(root)
    logs = sorted(root.glob("*.log"), key=lambda path: (path.name != PREFERRED_LOG, path.name))
    if folder is None or not logs:
        raise ProjectError(f"{root}: expected folders color and depth and a .log trajectory")
    if len(logs) > 1:
        others = named([path.name for path in logs[1:]])
        findings.append(Finding("warning", f"poses are read from {logs[0].name}, not {others}"))
    colors, depths = pictures_in(folder), pictures_in(root / "depth")
    depth_of = pair_by_name(colors, depths)
    unpaired = len(depths) - len(depth_of)
    if unpaired:
        findings.append(Finding("warning", f"{unpaired} depth maps belong to no picture"))
    numbers, poses = read_log(logs[0])
    rows = _rows_of(numbers, len(colors), logs[0])
    if len(rows) < len(colors):
        message = f"{len(colors) - len(rows)} of {len(colors)} pictures have no pose: dropped"
        findings.append(Finding("warning", message))
    frames = [
        RgbdFrame(
            colors[row].name,
            colors[row],
            depth_of.get(colors[row]),
            pose,
            f"{logs[0]}, pose {number}",
        )
        for number, row, pose in zip(numbers, rows, poses, strict=True)
    ]
    K, met = intrinsics(root, options)
    return Recording(root, frames, K, findings=[*findings, *met])


def intrinsics(root: Path, options: RgbdOptions) -> tuple[Float64, list[Finding]]:
    """(3, 3) of the colour camera as published, and where they come from."""
    cameras = sorted(
        path
        for path in root.glob("*.json")
        if path.is_file() and b"intrinsic_matrix" in read_bytes(path)
    )
    if cameras:
        return open3d_intrinsics(cameras[0]), [Finding("info", f"intrinsics: {cameras[0].name}")]
    if options.color_K is not None:
        return np.asarray(options.color_K), []
    message = "no intrinsics file: the PrimeSense default 525, 525, 319.5, 239.5 is taken"
    return PRIMESENSE, [Finding("warning", message)]


def read_log(path: Path) -> tuple[list[int], list[Float64]]:
    """A ``.log`` trajectory: blocks of three integers and a 4x4 camera-to-world matrix.

    Returns:
        Each block's first integer and its (4, 4) matrix, as read.
    """
    try:
        rows = [line.split() for line in read_text(path).splitlines()]
        rows = [row for row in rows if row]
        for at, row in enumerate(rows):
            if len(row) != (3 if at % 5 == 0 else 4):
                raise ValueError(f"line {at + 1} that is not empty has {len(row)} numbers")
        if len(rows) % 5:
            raise ValueError("the last block is not whole")
        numbers = [int(row[0]) for row in rows[::5]]
        matrices = np.array([row for at, row in enumerate(rows) if at % 5], np.float64)
    except (OSError, ValueError) as error:
        raise ProjectError(
            f"{path}: {error}; expected blocks of three integers and four lines of four numbers"
        ) from None
    return numbers, list(matrices.reshape(-1, 4, 4))


def pair_by_name(colors: list[Path], depths: list[Path]) -> dict[Path, Path]:
    """For each picture its depth map: of the same stem, else of the same leading number."""
    stems = {path.stem: path for path in depths}
    if any(path.stem in stems for path in colors):
        return {path: stems[path.stem] for path in colors if path.stem in stems}
    leading = {_leading_number(path): path for path in depths}
    return {
        path: leading[_leading_number(path)] for path in colors if _leading_number(path) in leading
    }


def _leading_number(path: Path) -> int | str:
    match = re.match(r"\D*(\d+)", path.stem)
    return int(match.group(1)) if match else path.stem


def _rows_of(numbers: list[int], pictures: int, path: Path) -> list[int]:
    if len(set(numbers)) == len(numbers) and all(0 <= number < pictures for number in numbers):
        return numbers
    if len(numbers) == pictures:
        return list(range(pictures))
    raise ProjectError(
        f"{path}: {len(numbers)} poses numbered {named(numbers)} for {pictures} pictures; expected "
        "one pose a picture, or numbers of pictures counted from 0"
    )


def color_folder(root: Path) -> Path | None:
    """The folder of the pictures, None where there is none."""
    return next((root / name for name in COLOR_FOLDERS if (root / name).is_dir()), None)


REDWOOD = RgbdLayout("Redwood (color, depth, a .log trajectory)", _matches, _record)
read_redwood = REDWOOD.read
