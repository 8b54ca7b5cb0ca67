"""LAS and LAZ through laspy, E57 through pye57, each in a child process of limited memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.optional import require
from gvtools.sandbox import Item, ReaderError, read_apart
from gvtools.scans.points import CHUNK, GENERATED, Chunk, ScanFile, Station
from gvtools.untrusted import regular

# Classes of points that are no surface: noise, low and high.
NOISE = (7, 18)
COLORS = ("red", "green", "blue")
# Bits that a compressed point takes at least; LASzip spends far more on coordinates.
LEAST_BITS = 1
# Of points that are read at once.
CHUNK_BYTES = 1 << 26

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
E57_COLORS = ("colorRed", "colorGreen", "colorBlue")
INVALID: dict[tuple[str, ...], str] = {
    CARTESIAN: "cartesianInvalidState",
    SPHERICAL: "sphericalInvalidState",
}
INTENSITY = "intensity"
# Quaternions are unit to this.
UNIT = 1e-3


NEWEST_LAS = (1, 4)
# Keys of GeoTIFF whose values are EPSG numbers, and the number of none.
PROJECTED, GEOGRAPHIC, VERTICAL, OWN_CRS = 3072, 2048, 4096, 32767


def open_lidar(path: Path, *, generated: bool = False) -> ScanFile:
    """A LAS, LAZ or E57, its header read; ``generated`` keeps a completer's points of a LAS."""
    suffix = path.suffix.lower()
    packages = {".las": ("laspy",), ".laz": ("laspy", "lazrs"), ".e57": ("pye57",)}[suffix]
    for package in packages:
        require(package, extra="scan", purpose=f"{path}: {suffix[1:].upper()}")
    if suffix == ".e57":
        items = read_apart(f"{__name__}:read_e57", path)
    else:
        _check_version(path)
        items = read_apart(f"{__name__}:read_las", path, generated=generated)
    head = next(items, None)
    if head is None:
        raise ReaderError("no header")
    stations = tuple(
        Station(item["name"], None if item["center"] is None else tuple(item["center"]))
        for item in head[0]["stations"]
    )
    chunks = (Chunk(**{**facts, **arrays}) for facts, arrays in items)
    return ScanFile(path, head[0]["count"], stations, chunks, head[0].get("crs", ""))


def _check_version(path: Path) -> None:
    """Refuse a LAS newer than its reader knows."""
    with regular(path).open("rb") as file:
        head = file.read(26)
    if head[:4] == b"LASF" and tuple(head[24:26]) > NEWEST_LAS:
        major, minor = head[24:26]
        raise MemoryFileError(
            f"{path}: LAS version {major}.{minor}; expected 1.4 at most; it is newer than this "
            "program: update gvtools, or save it in version 1.4"
        )


def _sent(chunk: Chunk) -> Item:
    arrays = {"positions": chunk.positions, "colors": chunk.colors, "intensity": chunk.intensity}
    facts = {"station": chunk.station, "dropped": chunk.dropped}
    return facts, {name: array for name, array in arrays.items() if array is not None}


def read_las(path: Path, *, generated: bool) -> Iterator[Item]:
    """The header and the points of a LAS or LAZ, for ``read_apart``."""
    import laspy

    yield {}, {}
    with laspy.open(path) as reader:
        header = reader.header
        count, size = int(header.point_count), int(header.point_format.size)
        bits = LEAST_BITS if header.are_points_compressed else 8 * size
        room = path.stat().st_size - int(header.offset_to_point_data)
        if count * bits > 8 * max(room, 0):
            raise MemoryFileError(
                f"{path}: {room} bytes of points, but its header says {count} points of at least "
                f"{bits} bits; the file is truncated or damaged; save it again"
            )
        # Since 1.3 more may come behind the points.
        bare = header.version.minor < 3 and not header.are_points_compressed
        if bare and room >= (count + 1) * size:
            raise MemoryFileError(
                f"{path}: its header says {count} points, but there is room for {room // size}: "
                "the file was not closed when it was written; repair its header"
            )
        stations = [{"name": path.stem, "center": None}]
        yield {"count": count, "stations": stations, "crs": _crs(header)}, {}
        for points in reader.chunk_iterator(min(CHUNK, max(1, CHUNK_BYTES // max(size, 1)))):
            yield _sent(_las_chunk(points, generated=generated))


def _crs(header: Any) -> str:
    """The coordinate system that a LAS names: WKT, or EPSG numbers of older files; else ""."""
    codes: dict[int, int] = {}
    for record in (*header.vlrs, *(header.evlrs or ())):
        if text := str(getattr(record, "string", "") or "").strip("\0 "):
            return text
        keys = getattr(record, "geo_keys", ())
        codes |= {int(key.id): int(key.value_offset) for key in keys if not key.tiff_tag_location}
    flat, height = codes.get(PROJECTED) or codes.get(GEOGRAPHIC), codes.get(VERTICAL)
    numbers = [code for code in (flat, height) if code and code != OWN_CRS]
    return f"EPSG:{'+'.join(map(str, numbers))}" if flat and flat != OWN_CRS else ""


def _las_chunk(points: Any, *, generated: bool) -> Chunk:
    names = set(points.point_format.dimension_names)
    positions = np.stack([np.asarray(points[axis], np.float64) for axis in "xyz"], axis=1)
    colors = None
    if set(COLORS) <= names:
        colors = np.stack([np.asarray(points[name], np.uint16) for name in COLORS], axis=1)
    chunk = Chunk(positions, colors, np.asarray(points["intensity"], np.float32))
    bad = np.asarray(points["withheld"]) != 0
    bad |= np.isin(np.asarray(points["classification"]), NOISE)
    if GENERATED in names and not generated:
        made = np.asarray(points[GENERATED]) != 0
        chunk, bad = chunk.without(made, GENERATED), bad[~made]
    return chunk.without(bad, "withheld or noise")


def read_e57(path: Path) -> Iterator[Item]:
    """The headers and the points of an E57's scans, for ``read_apart``."""
    import pye57
    from scipy.spatial.transform import Rotation  # noqa: F401 (loaded before memory is limited)

    yield {}, {}
    with pye57.E57(str(path)) as file:
        headers = [file.get_header(index) for index in range(file.scan_count)]
        if not headers:
            raise MemoryFileError(f"{path}: no scan in it; expected at least one")
        for header in headers:
            if _axes(header) is None:
                raise MemoryFileError(
                    f"{path}: a scan of {', '.join(header.point_fields) or 'nothing'}; expected "
                    f"{', '.join(CARTESIAN)} or {', '.join(SPHERICAL)}"
                )
        poses = [_e57_pose(path, header) for header in headers]
        stations = []
        for index, (header, pose) in enumerate(zip(headers, poses, strict=True)):
            name = header.node["name"].value() if header.node.isDefined("name") else ""
            # Without a pose the scanner's place is unknown, unless ranges count from there.
            known = header.has_pose() or _axes(header) != CARTESIAN
            center = pose[:3, 3].tolist() if known else None
            stations.append({"name": str(name) or f"scan {index + 1}", "center": center})
        total = sum(int(header.point_count) for header in headers)
        yield {"count": total, "stations": stations}, {}
        for index, pose in enumerate(poses):
            yield from map(_sent, _e57_chunks(file, index, pose))


def _axes(header: Any) -> tuple[str, ...] | None:
    held = set(header.point_fields)
    return next((axes for axes in (CARTESIAN, SPHERICAL) if set(axes) <= held), None)


def _e57_pose(path: Path, header: Any) -> NDArray[np.float64]:
    """(4, 4) from the scan's frame to the file's."""
    pose = np.eye(4)
    if not header.has_pose():
        return pose
    node = header.node["pose"]
    if node.isDefined("rotation"):
        from scipy.spatial.transform import Rotation

        q = np.array([node["rotation"][axis].value() for axis in "wxyz"], np.float64)
        unit = abs(float(np.linalg.norm(q)) - 1) < UNIT
        pose[:3, :3] = Rotation.from_quat(np.roll(q, -1)).as_matrix() if unit else np.nan
    if node.isDefined("translation"):
        pose[:3, 3] = [node["translation"][axis].value() for axis in "xyz"]
    if not np.isfinite(pose).all():
        raise MemoryFileError(
            f"{path}: a scan's pose {pose[:3].tolist()}; expected a unit quaternion and a place"
        )
    return pose


def _e57_chunks(file: Any, index: int, pose: NDArray[np.float64]) -> Iterator[Chunk]:
    from pye57 import libe57

    header = file.get_header(index)
    held, axes = set(header.point_fields), _axes(header)
    assert axes is not None
    names = [*axes]
    names += E57_COLORS if set(E57_COLORS) <= held else ()
    names += [name for name in (INTENSITY, INVALID[axes]) if name in held]
    left = int(header.point_count)
    rows = min(CHUNK, max(left, 1))
    arrays = {name: np.empty(rows, np.float64 if name in axes else np.float32) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, array, rows, True, True))
    limits = _color_limits(header)
    reader = header.points.reader(buffers)
    while left > 0 and (count := int(reader.read())):
        left -= count
        columns: dict[str, Any] = {name: array[:count].copy() for name, array in arrays.items()}
        positions = _e57_positions(columns, axes) @ pose[:3, :3].T + pose[:3, 3]
        colors = None
        if set(E57_COLORS) <= held:
            rgb = np.stack([columns[name] for name in E57_COLORS], axis=1)
            low, high = limits
            share = np.clip((rgb - low) / np.maximum(high - low, 1e-12), 0, 1)
            colors = np.rint(255 * np.nan_to_num(share)).astype(np.uint8)
            if not header.node.isDefined("colorLimits"):
                colors = rgb  # the whole scan tells their range
        chunk = Chunk(positions, colors, columns.get(INTENSITY), index)
        state = columns.get(INVALID[axes])
        yield chunk if state is None else chunk.without(state != 0, "invalid")
    reader.close()
    if left:
        raise MemoryFileError(
            f"{file.path}: {header.point_count - left} points could be read; expected "
            f"{header.point_count}; the file is damaged; save it again"
        )


def _e57_positions(columns: dict[str, Any], axes: tuple[str, ...]) -> NDArray[np.float64]:
    first, second, third = (columns[axis] for axis in axes)
    if axes == CARTESIAN:
        return np.stack([first, second, third], axis=1)
    # Range, azimuth from x towards y, elevation above the xy plane; radians.
    flat = first * np.cos(third)
    return np.stack([flat * np.cos(second), flat * np.sin(second), first * np.sin(third)], axis=1)


def _color_limits(header: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(3,) each: the least and greatest values that colours may have; of bytes where unsaid."""
    low, high = np.zeros(3, np.float32), np.full(3, 255, np.float32)
    if header.node.isDefined("colorLimits"):
        node = header.node["colorLimits"]
        for k, name in enumerate(E57_COLORS):
            if node.isDefined(f"{name}Minimum") and node.isDefined(f"{name}Maximum"):
                low[k] = node[f"{name}Minimum"].value()
                high[k] = node[f"{name}Maximum"].value()
    return low, high
