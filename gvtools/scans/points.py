"""Points of scan files, read in chunks in the file's frame, with the stations that saw them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

# Points that are read at once.
CHUNK = 1 << 20
# Name of the attribute that marks a completer's points in files of gvtools; they are left out.
GENERATED = "generated"


@dataclass(frozen=True)
class Station:
    """Where a scanner stood.

    Attributes:
        name: of the scan taken there.
        center: x, y, z in the file's frame; None if the file does not say.
    """

    name: str
    center: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Chunk:
    """Some points of a file.

    Attributes:
        positions: (N, 3) float64, the file's frame and unit; may hold NaN.
        colors: (N, 3) uint8, or uint16 if the file may mean 8 or 16 bits; None without colours.
        intensity: (N,) float32, any unit; None without intensity.
        station: index into the file's stations.
        dropped: number of points that the file itself marks as unusable, by reason.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8] | NDArray[np.uint16] | None = None
    intensity: NDArray[np.float32] | None = None
    station: int = 0
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
    """A scan that was opened: its header is read and checked, its points are not.

    Attributes:
        path: the file.
        count: number of points, including unusable ones.
        stations: at least one.
        chunks: all points, in the order of the file, read as they are asked for.
    """

    path: Path
    count: int
    stations: tuple[Station, ...]
    chunks: Iterator[Chunk]


@dataclass(frozen=True, eq=False)
class Scan:
    """N points of a scan, in its own frame and unit.

    Attributes:
        name: of the file.
        origin: (3,) float64, subtracted from positions, so that georeferenced ones keep their
            precision.
        positions: (N, 3) float64, relative to ``origin``.
        colors: (N, 3) uint8.
        station: (N,) int32, indices into ``stations``.
        stations: where they were scanned from.
        colored_by: source of the colours: "colour", "intensity" (grey) or "nothing" (one grey).
        count: number of points in the file.
        dropped: number of points of the file that are left out, by reason.
    """

    name: str
    origin: NDArray[np.float64]
    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    station: NDArray[np.int32]
    stations: tuple[Station, ...]
    colored_by: str
    count: int
    dropped: dict[str, int]

    def __len__(self) -> int:
        return len(self.positions)
