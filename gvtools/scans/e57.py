"""Points of E57 files, through pye57: one station for each of its scans."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.scans.e57_parts import check_e57
from gvtools.scans.points import CHUNK, Chunk, ScanFile, Station

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLORS = ("colorRed", "colorGreen", "colorBlue")
INVALID: dict[tuple[str, ...], str] = {
    CARTESIAN: "cartesianInvalidState",
    SPHERICAL: "sphericalInvalidState",
}
INTENSITY = "intensity"
# Quaternions are unit to this.
UNIT = 1e-3


def open_e57(path: Path) -> ScanFile:
    """An E57, the headers of its scans read."""
    import pye57

    check_e57(path)
    with pye57.E57(str(path)) as file:
        headers = [file.get_header(index) for index in range(file.scan_count)]
        if not headers:
            raise MemoryFileError(f"{path}: no scan in it; expected at least one")
        bits = [_check_fields(path, header) for header in headers]
        counts = [int(header.point_count) for header in headers]
        room = 8 * path.stat().st_size
        needed = sum(count * each for count, each in zip(counts, bits, strict=True))
        if min(counts) < 0 or needed > room:
            raise MemoryFileError(
                f"{path}: {path.stat().st_size} bytes, but its scans say {sum(counts)} points, "
                f"that is {needed // 8}; the file is damaged; save it again"
            )
        poses = [_pose(path, header) for header in headers]
        stations = tuple(
            Station(_name(header, index), _center(header, pose))
            for index, (header, pose) in enumerate(zip(headers, poses, strict=True))
        )

    def chunks() -> Iterator[Chunk]:
        with pye57.E57(str(path)) as file:
            for index, pose in enumerate(poses):
                yield from _read(file, index, pose)

    return ScanFile(path, sum(counts), stations, chunks)


def _check_fields(path: Path, header: Any) -> int:
    """The bits that a point's coordinates take."""
    axes = _axes(header.point_fields)
    if axes is None:
        raise MemoryFileError(
            f"{path}: a scan of {', '.join(header.point_fields) or 'nothing'}; expected "
            f"{', '.join(CARTESIAN)} or {', '.join(SPHERICAL)}"
        )
    from pye57 import libe57

    prototype = libe57.StructureNode(header.points.prototype())
    bits = sum(_bits(prototype, axis) for axis in axes)
    if not bits and header.point_count:
        raise MemoryFileError(f"{path}: a scan whose points take no bytes; expected several points")
    return bits


def _axes(fields: list[str]) -> tuple[str, ...] | None:
    return next((axes for axes in (CARTESIAN, SPHERICAL) if set(axes) <= set(fields)), None)


def _bits(prototype: Any, field: str) -> int:
    from pye57 import libe57

    node = prototype.get(field)
    if node.type() == libe57.NodeType.E57_FLOAT:
        single = libe57.FloatNode(node).precision() == libe57.FloatPrecision.E57_SINGLE
        return 32 if single else 64
    scaled = node.type() == libe57.NodeType.E57_SCALED_INTEGER
    number = libe57.ScaledIntegerNode(node) if scaled else libe57.IntegerNode(node)
    return int(number.maximum() - number.minimum()).bit_length()


def _name(header: Any, index: int) -> str:
    name = header.node["name"].value() if header.node.isDefined("name") else ""
    return str(name) or f"scan {index + 1}"


def _pose(path: Path, header: Any) -> NDArray[np.float64]:
    """(4, 4) from the scan's frame to the file's."""
    pose = np.eye(4)
    if not header.has_pose():
        return pose
    node = header.node["pose"]
    if node.isDefined("rotation"):
        q = np.array([node["rotation"][axis].value() for axis in "wxyz"], np.float64)
        length = float(np.linalg.norm(q))
        if not abs(length - 1) < UNIT:
            raise MemoryFileError(
                f"{path}: a scan's rotation is the quaternion {q.tolist()}; expected length 1"
            )
        from scipy.spatial.transform import Rotation

        pose[:3, :3] = Rotation.from_quat(np.roll(q, -1)).as_matrix()
    if node.isDefined("translation"):
        pose[:3, 3] = [node["translation"][axis].value() for axis in "xyz"]
    if not np.isfinite(pose).all():
        raise MemoryFileError(f"{path}: a scan's position is {pose[:3, 3].tolist()}")
    return pose


def _center(header: Any, pose: NDArray[np.float64]) -> tuple[float, float, float] | None:
    """Where the scanner stood; unknown without a pose, unless ranges count from there."""
    if not header.has_pose() and _axes(header.point_fields) == CARTESIAN:
        return None
    x, y, z = pose[:3, 3].tolist()
    return x, y, z


def _read(file: Any, index: int, pose: NDArray[np.float64]) -> Iterator[Chunk]:
    from pye57 import libe57

    header = file.get_header(index)
    held = set(header.point_fields)
    axes = _axes(header.point_fields)
    assert axes is not None
    names = [*axes]
    names += COLORS if set(COLORS) <= held else ()
    names += [name for name in (INTENSITY, INVALID[axes]) if name in held]
    rows = min(CHUNK, max(int(header.point_count), 1))
    arrays = {name: np.empty(rows, np.float64 if name in axes else np.float32) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, array, rows, True, True))
    limits = _color_limits(header)
    reader = header.points.reader(buffers)
    left = int(header.point_count)
    while left > 0 and (count := int(reader.read())):
        left -= count
        columns = {name: array[:count].copy() for name, array in arrays.items()}
        yield _chunk(columns, axes, pose, station=index, limits=limits)
    reader.close()
    if left:
        raise MemoryFileError(
            f"{file.path}: {header.point_count - left} points could be read; expected "
            f"{header.point_count}; the file is damaged; save it again"
        )


def _chunk(
    columns: dict[str, NDArray[Any]],
    axes: tuple[str, ...],
    pose: NDArray[np.float64],
    *,
    station: int,
    limits: tuple[NDArray[np.float32], NDArray[np.float32]],
) -> Chunk:
    first, second, third = (columns[axis] for axis in axes)
    if axes == SPHERICAL:
        # Range, azimuth from x towards y, elevation above the xy plane; radians.
        flat = first * np.cos(third)
        own = np.stack([flat * np.cos(second), flat * np.sin(second), first * np.sin(third)], 1)
    else:
        own = np.stack([first, second, third], axis=1)
    colors = None
    if set(COLORS) <= set(columns):
        rgb = np.stack([columns[name] for name in COLORS], axis=1)
        low, high = limits
        share = np.clip((rgb - low) / np.maximum(high - low, 1e-12), 0, 1)
        colors = np.rint(255 * np.nan_to_num(share)).astype(np.uint8)
    positions = own @ pose[:3, :3].T + pose[:3, 3]
    chunk = Chunk(positions, colors, columns.get(INTENSITY), station)
    state = columns.get(INVALID[axes])
    return chunk if state is None else chunk.without(state != 0, "invalid")


def _color_limits(header: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(3,) each: the least and the greatest values that colours may have; bytes where not told."""
    low, high = np.zeros(3, np.float32), np.full(3, 255, np.float32)
    if header.node.isDefined("colorLimits"):
        node = header.node["colorLimits"]
        for k, name in enumerate(COLORS):
            if node.isDefined(f"{name}Minimum") and node.isDefined(f"{name}Maximum"):
                low[k] = node[f"{name}Minimum"].value()
                high[k] = node[f"{name}Maximum"].value()
    return low, high
