"""Points of scan files, read in chunks in the file's frame, with the stations that saw them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Points that are read at once.
CHUNK = 1 << 20
# Name of the attribute that marks a completer's points in files of gvtools; they are left out.
GENERATED = "generated"


@dataclass(frozen=True)
class Station:
    """Where a scanner stood."""

    name: str  # of the scan taken there
    # x, y, z in the file's frame; None if the file does not say
    center: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Chunk:
    """Some points of a file."""

    positions: NDArray[np.float64]  # (N, 3) float64, the file's frame and unit; may hold NaN
    # (N, 3) of any type, whose range the whole scan tells; None without colours
    colors: NDArray[Any] | None = None
    intensity: NDArray[np.float32] | None = None  # (N,) float32, any unit; None without intensity
    station: int = 0  # index into the file's stations
    # number of points that the file itself marks as unusable, by reason
    dropped: dict[str, int] = field(default_factory=dict)

    def without(self, flags: NDArray[np.bool_], reason: str) -> Chunk:
        """The points without the flagged ones (N,), which are counted as dropped for a reason."""
        if not flags.any():
            return self
        keep = ~flags
        return Chunk(
            self.positions[keep],
            None if self.colors is None else self.colors[keep],
            None if self.intensity is None else self.intensity[keep],
            self.station,
            {**self.dropped, reason: int(flags.sum())},
        )


@dataclass(frozen=True, eq=False)
class ScanFile:
    """A scan that was opened: its header is read and checked, its points are not."""

    path: Path  # the file
    count: int  # number of points, including unusable ones
    stations: tuple[Station, ...]  # at least one
    chunks: Iterator[Chunk]  # all points, in the order of the file, read as they are asked for
    crs: str = ""  # the coordinate system that it names, WKT or "EPSG:N"
    notes: tuple[str, ...] = ()  # what of its header was ignored


@dataclass(frozen=True, eq=False)
class Scan:
    """N points of a scan, in its own frame and unit."""

    name: str  # of the file
    # (3,) float64, subtracted from positions, so that georeferenced ones keep their precision
    origin: NDArray[np.float64]
    positions: NDArray[np.float64]  # (N, 3) float64, relative to ``origin``
    colors: NDArray[np.uint8]  # (N, 3) uint8
    station: NDArray[np.int32]  # (N,) int32, indices into ``stations``
    stations: tuple[Station, ...]  # where they were scanned from
    colored_by: str  # source of the colours: "colour", "intensity" (grey) or "nothing" (one grey)
    count: int  # number of points in the file
    dropped: dict[str, int]  # number of points of the file that are left out, by reason
    color_range: str = ""  # what was decided of the colours' range, where their type does not tell
    crs: str = ""  # as of ScanFile
    notes: tuple[str, ...] = ()  # as of ScanFile, and what may be wrong with the points

    def __len__(self) -> int:
        return len(self.positions)
