"""A scan of any known format, read within a bounded memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError, MemoryFileError, OptionError
from gvtools.glb import GLTF_ENDS
from gvtools.ranges import CLOUD_OUTLIERS, OF_CLOUDS, said_of, to_bytes, white_of
from gvtools.scans.lidar import open_lidar
from gvtools.scans.points import Chunk, Scan, ScanFile
from gvtools.scans.tables import open_glb, open_pcd, open_ply, open_splats, open_text

GAUSSIANS = (".spz", ".sog", ".splat", ".ksplat")
OPENERS: dict[str, Callable[[Path], ScanFile]] = {
    ".ply": open_ply, **dict.fromkeys((".las", ".laz", ".e57"), open_lidar), ".pcd": open_pcd,
    **dict.fromkeys(GLTF_ENDS, open_glb), **dict.fromkeys(GAUSSIANS, open_splats),
    **dict.fromkeys((".xyz", ".xyzrgb", ".asc", ".txt"), open_text),
}  # fmt: skip
# Points that are kept at once, 36 bytes each and as much again for work; more are thinned.
MOST_POINTS = 8_000_000
# Thinning begins with so many cells along the longest side.
CELLS = 1 << 14
# Shares of the points whose intensities become black and white, and the grey of what has none.
DARK, BRIGHT, GREY = 0.01, 0.99, 128
# Points that are looked at for their precision, and rows of a chunk for rays without a return;
# fewer than so many tell nothing.
SAMPLE, NO_RETURN_ROWS, FEW = 20_000, 5_000, 10
# Beyond it no unit is meant.
FARTHEST = 1e15


def open_scan(path: Path, *, generated: bool = False) -> ScanFile:
    """The scan in a file, its header read and checked against the file's size."""
    suffix = path.suffix.lower()
    if suffix not in OPENERS:
        raise OptionError(f"{path}: expected a scan that ends with {', '.join(OPENERS)}")
    if not path.is_file():
        raise MemoryFileError(f"{path}: no such file; expected a scan")
    with _one_line(path):
        opener = OPENERS[suffix]
        file = open_lidar(path, generated=generated) if opener is open_lidar else opener(path)
    if not file.count:
        raise MemoryFileError(f"{path}: no points in it; expected a scan")
    return file


def read_scan(path: Path, *, most: int = MOST_POINTS, generated: bool = False) -> Scan:
    """The points of a scan, at most ``most``: beyond it one of each cell of a grid."""
    file = open_scan(path, generated=generated)
    reading = _Reading(most)
    with _one_line(path):
        for chunk in file.chunks:
            reading.add(chunk)
    held = reading.whole()
    if held is None:
        raise MemoryFileError(f"{path}: none of its {file.count} points is usable; expected some")
    notes = (*file.notes, *_precision(path, held["positions"], reading.origin))
    colors, colored_by, color_range = _colors(held)
    return Scan(
        path.name, reading.origin, held["positions"], colors, held["station"], file.stations,
        colored_by, file.count, dict(reading.dropped), color_range,
        file.crs, notes,
    )  # fmt: skip


def _precision(
    path: Path, positions: NDArray[np.float64], origin: NDArray[np.float64]
) -> Iterator[str]:
    """What was lost of coordinates when they were written; all of them are refused."""
    from scipy.spatial import cKDTree

    some = positions[len(positions) // 2 :][:SAMPLE] if len(positions) > 2 * SAMPLE else positions
    if len(positions) > 1 and not np.ptp(positions, axis=0).any():
        raise MemoryFileError(
            f"{path}: all of its {len(positions)} points lie at {origin.tolist()}; expected a "
            "scan; its coordinates were lost (a LAS with steps that are too coarse?)"
        )
    places = np.unique(some, axis=0)
    world = some + origin
    if len(some) > FEW and len(places) < len(some) / 2:
        yield (
            f"{len(some):,} points have only {len(places):,} places: coordinates were rounded too "
            "coarsely, or points occur several times; save it with finer steps"
        )
    elif len(some) > FEW and (world == world.astype(np.float32)).all():
        step = float(np.spacing(np.abs(world).max(axis=0).astype(np.float32)).max())
        apart = float(np.median(cKDTree(places).query(places, 2)[0][:, 1]))
        if step > apart / 2:
            yield (
                f"coordinates are single precision, in steps of {step:.3g} that far from 0, points "
                f"{apart:.3g} apart; save it as double, or shifted towards 0"
            )


def _no_return(positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Points that all lie at one place, as scanners write rays without a return."""
    some = positions[:: max(1, len(positions) // NO_RETURN_ROWS)]
    places, counts = np.unique(some, axis=0, return_counts=True)
    most = int(counts.argmax())
    usual = float(np.median(counts))
    if len(places) < FEW or counts[most] < max(FEW, len(some) / 100, 20 * usual):
        return np.zeros(len(positions), np.bool_)
    return np.asarray((positions == places[most]).all(axis=1))


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """What any reader complains of, in one line; the words of a format's library tell nothing."""
    try:
        yield
    except GvError:
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or "its parts contradict each other"
        if isinstance(error, MemoryError):
            reason = "asks for more memory than there is"
        raise MemoryFileError(
            f"{path}: cannot be read ({reason}); expected a whole {path.suffix.upper()[1:]} point "
            "cloud; the file is damaged, or of a kind that is not known; save it again"
        ) from error


class _Reading:
    """The points that were read so far, thinned whenever they become too many."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.dropped: Counter[str] = Counter()
        self.origin = np.zeros(3)
        self._parts: list[dict[str, NDArray[Any]]] = []
        self._held = 0
        self._cells = 0.0

    def add(self, chunk: Chunk) -> None:
        """Take points in."""
        self.dropped.update(chunk.dropped)
        usable = np.asarray((np.abs(chunk.positions) < FARTHEST).all(axis=1))
        if not usable.all():
            self.dropped["no finite coordinates"] += int((~usable).sum())
        nowhere = _no_return(chunk.positions[usable]) if usable.any() else usable[usable]
        if nowhere.any():
            self.dropped["at one place (no return)"] += int(nowhere.sum())
            usable[usable] = ~nowhere
        positions = chunk.positions[usable]
        if not len(positions):
            return
        if not self._parts:
            self.origin = np.round(np.median(positions, axis=0))
        count = len(positions)
        colors, intensity = chunk.colors, chunk.intensity
        part: dict[str, NDArray[Any]] = {
            "positions": positions - self.origin,
            "station": np.full(count, chunk.station, np.int32),
            # 1 where they are known.
            "with_color": np.zeros(count, np.bool_),
            "colors": np.zeros((count, 3), np.uint8),
            "intensity": np.zeros(count, np.float32) if intensity is None else intensity[usable],
        }
        if colors is not None:
            part["colors"] = colors[usable]
            part["with_color"] = np.isfinite(part["colors"]).all(axis=1)
        self._parts.append(part)
        self._held += count
        if self._held > self.most:
            self._thin()

    def whole(self) -> dict[str, NDArray[Any]] | None:
        """All points, by column; None without any."""
        if not self._parts:
            return None
        names = self._parts[0]
        # Station by station a scan may have colours of other types.
        return {name: np.concatenate([part[name] for part in self._parts]) for name in names}

    def _thin(self) -> None:
        """Leave one point of each cell, of cells that grow until half as many points are left."""
        held = self.whole()
        assert held is not None
        positions = held["positions"]
        low, extent = positions.min(axis=0), float(np.ptp(positions, axis=0).max())
        edge = max(self._cells, extent / CELLS)
        while True:
            cells = np.floor((positions - low) / edge).astype(np.int64)
            keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
            _, first = np.unique(keys, return_index=True)
            if len(first) <= max(self.most // 2, 1):
                break
            edge *= max(1.1, float(np.sqrt(len(first) / (self.most // 2))))
        self.dropped["thinned out"] += len(positions) - len(first)
        first.sort()
        self._cells = edge
        self._parts = [{name: column[first] for name, column in held.items()}]
        self._held = len(first)


def _colors(held: dict[str, NDArray[Any]]) -> tuple[NDArray[np.uint8], str, str]:
    """(N, 3) colours, what they are made from (black ones were not recorded), and their range."""
    colors, said = held["colors"], ""
    if colors.any():
        white = white_of(colors, tops=OF_CLOUDS, outliers=CLOUD_OUTLIERS)
        rgb, by, said = to_bytes(colors, white), "colour", said_of(colors, white)
        if held["with_color"].all():
            return rgb, by, said
    else:
        rgb, by = np.zeros((len(colors), 3), np.uint8), "nothing"
    bare = ~held["with_color"] if by == "colour" else np.ones(len(rgb), np.bool_)
    intensity = np.nan_to_num(held["intensity"][bare])
    low, high = np.quantile(intensity, (DARK, BRIGHT))
    if high > low:
        share = np.clip((intensity - low) / (high - low), 0, 1)
        grey = np.rint(255 * share).astype(np.uint8)
        by = "intensity" if by == "nothing" else by
    else:
        grey = np.full(len(intensity), GREY, np.uint8)
    rgb = rgb.copy()
    rgb[bare] = grey[:, None]
    if by == "colour":
        none = f"{bare.mean():.2%} of the points have no colour: grey"
        said = f"{said}, {none}" if said else none
    return rgb, by, said
