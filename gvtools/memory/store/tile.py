"""A tile of a memory: observations in RAM or in a checksummed file, and thinned copies."""

# mypy: no-check-untyped-defs

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.kernels import compiled
from gvtools.memory.store.array_file import ArrayFile, write_arrays
from gvtools.memory.store.observations import (
    LAYOUT,
    AgreementEntry,
    Observations,
    Segments,
    SplatColumns,
)
from gvtools.memory.store.views import ViewTable
from gvtools.memory.store.voxel_index import LOCAL_MASK, MOST_LEVEL

# A cube of space: its level (edge of 2**level cells) and its coordinates in such edges.
Node = tuple[int, int, int, int]
# In a copy, the observations of a segment that lie in one cube of 2**2, or of 2**4, voxels a side
# become one, their mean weighted by confidence. So its segments have the same block and view.
DOUBLINGS = (2, 4)


class ThinnedCopy(NamedTuple):
    """One copy: the observations, and where each segment's begin, (S + 1,) int32."""

    start: NDArray[np.int32]
    rows: SplatColumns


def empty_columns(count: int) -> SplatColumns:
    """Uninitialised columns for ``count`` observations."""
    single = np.float32
    return SplatColumns(
        np.empty((count, 3), single), np.empty((count, 3), np.uint8),
        np.empty(count, single), np.empty(count, single),
    )  # fmt: skip


def thinned_copy(observations: Observations, doublings: int) -> ThinnedCopy:
    """The copy whose cubes are 2**doublings voxels wide."""
    segments, arrays = observations.segments, observations.columns.arrays
    rows = empty_columns(len(observations))
    start = np.zeros(segments.count + 1, np.int32)
    n = _thin(
        segments.start[: segments.count], segments.length, *observations.columns.splat,
        arrays.level, 1.0 / observations.voxel, doublings, start, *rows,
    )  # fmt: skip
    return ThinnedCopy(start, SplatColumns(
        rows.positions[:n].copy(), rows.colors[:n].copy(),
        rows.confidence[:n].copy(), rows.spacing[:n].copy(),
    ))  # fmt: skip


@compiled()
def _thin(
    first, length, positions, colors, confidence, spacing, level, inverse_edge, doublings,
    start, out_positions, out_colors, out_confidence, out_spacing,
):  # fmt: skip
    side = (LOCAL_MASK + 1) >> doublings
    place = np.full(side * side * side, -1, np.int64)
    used = np.empty(side * side * side, np.int64)
    # Weighted position and colour, weight, weighted spacing.
    total = np.empty((side * side * side, 8), np.float64)
    n = 0
    for s in range(len(first)):
        cubes = 0
        inverse = inverse_edge / (1 << np.int64(level[first[s]]))
        for r in range(first[s], first[s] + length[s]):
            cube = np.int64(0)
            for k in range(3):
                voxel = np.int64(np.floor(np.float64(positions[r, k]) * inverse))
                cube = cube * side + ((voxel & LOCAL_MASK) >> doublings)
            t = place[cube]
            if t < 0:
                t = place[cube] = cubes
                used[cubes] = cube
                cubes += 1
                total[t] = 0
                out_confidence[n + t] = 0
            w = np.float64(confidence[r])
            for k in range(3):
                total[t, k] += w * positions[r, k]
                total[t, 3 + k] += w * colors[r, k]
            total[t, 6] += w
            total[t, 7] += w * spacing[r]
            out_confidence[n + t] = max(out_confidence[n + t], confidence[r])
        for t in range(cubes):
            weight = total[t, 6]
            for k in range(3):
                out_positions[n, k] = total[t, k] / weight
                out_colors[n, k] = np.uint8(total[t, 3 + k] / weight + 0.5)
            out_spacing[n] = max(total[t, 7] / weight, (1 << doublings) / inverse)
            place[used[t]] = -1
            n += 1
        start[s + 1] = n
    return n


@compiled()
def copy_rows(begin, end, which, start, length, source, at, target):
    """Copy segments ``which[begin:end]`` from ``start`` in ``source`` to ``at`` in ``target``."""
    for i in range(begin, end):
        j = which[i]
        a, b, n = start[j], at[j], length[j]
        for r in range(n):
            for k in range(3):
                target.positions[b + r, k] = source.positions[a + r, k]
                target.colors[b + r, k] = source.colors[a + r, k]
            target.confidence[b + r] = source.confidence[a + r]
            target.spacing[b + r] = source.spacing[a + r]


# ``round`` and ``generated`` follow from the view, ``next`` from the voxels.
COLUMNS = ("positions", "colors", "confidence", "spacing", "view", "level")
# Bytes of an observation that projection maps.
SPLAT_BYTES = 23


@dataclass(eq=False)
class Tile:
    """A cube of voxels."""

    node: Node
    # (S,) its segments by their row in the memory's table, in its own order.
    segments: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    # Its observations while they are in RAM; where they lie otherwise, or an older state of them.
    store: Observations | None = None
    file: Path | None = None
    # Whether the file lies in the working folder, so that nobody else reads it.
    owned: bool = True
    # Whether ``store`` has changed since it was written.
    dirty: bool = False
    # Bytes, observations, occupied voxels, and rounds that added confidence here; in RAM or not.
    size: int = 0
    count: int = 0
    voxels: int = 0
    agreed: tuple[int, ...] = ()
    # Bytes at which it was found not to divide; 0 otherwise.
    indivisible: int = 0
    mapped: ArrayFile | None = None
    _copies: dict[int, ThinnedCopy] = field(default_factory=dict)

    @property
    def resident(self) -> int:
        """Bytes that it takes in RAM now."""
        total = 0
        if self.store is not None:
            total += self.store.nbytes
            total += sum(sum(c.nbytes for c in copy.rows) for copy in self._copies.values())
        if self.mapped is not None:
            total += SPLAT_BYTES * int(self.mapped.meta["count"])
        return total

    def changed(self) -> None:
        """Its store has changed."""
        assert self.store is not None
        self.dirty = True
        self._copies.clear()
        self.mapped = None
        self.size, self.count = self.store.nbytes, len(self.store)
        self.voxels = self.store.index.voxels
        self.agreed = tuple(sorted(self.store.agreements))

    def splat_columns(self) -> SplatColumns:
        """All observations, as splatting reads them."""
        if self.store is not None:
            return self.store.columns.splat
        return _splat_columns(self._open(), rows=self.count)

    def thinned(self, doublings: int) -> ThinnedCopy:
        """The thinned copy whose cubes are 2**doublings voxels wide."""
        if self.store is None:
            file, head = self._open(), f"thinned{doublings}_"
            start = file.array(f"{head}start")
            rows = _splat_columns(file, head, rows=len(file.array(f"{head}spacing")))
            if len(start) != len(self.segments) + 1 or not _covers(start, len(rows.spacing)):
                raise _misfit(file, f"{head}start")
            return ThinnedCopy(start, rows)
        if doublings not in self._copies:
            self._copies[doublings] = thinned_copy(self.store, doublings)
        return self._copies[doublings]

    def column(self, name: str) -> NDArray[Any]:
        """A column of all observations."""
        if self.store is not None:
            return np.asarray(getattr(self.store.columns, name))
        return _column(self._open(), name, self.count)

    def agreements(self) -> list[tuple[int, AgreementEntry]]:
        """(round, (rows, confidence added, confidence before)) of each view that agreed here."""
        if self.store is not None:
            return self.store.agreement_log()
        return read_agreements(self._open())

    def write(self, path: Path) -> None:
        """Write its store to a file, which it is then read from."""
        store = self.store
        assert store is not None
        arrays = observation_arrays(store)
        for doublings in DOUBLINGS:
            copy = self.thinned(doublings)
            arrays[f"thinned{doublings}_start"] = copy.start
            for name, column in copy.rows._asdict().items():
                arrays[f"thinned{doublings}_{name}"] = column
        write_arrays(path, {"count": len(store)}, arrays, flush=False)
        self.file, self.owned, self.dirty, self.mapped = path, True, False, None

    def release(self) -> None:
        """Take it out of RAM; the caller knows that it is written."""
        self.store = self.mapped = None
        self._copies.clear()

    def load(self, empty: Observations, views: ViewTable) -> None:
        """Bring its observations into RAM; ``empty`` is filled."""
        if self.file is not None:
            file = self._open()
            self.mapped = None
            arrays = {name: file.array(name) for name in observation_arrays(empty)}
            try:
                check_observations(arrays, len(views))
            except ValueError as error:
                raise _misfit(file, error) from None
            fill(empty, arrays, views)
            for number, entry in read_agreements(file):
                empty.agreements.setdefault(number, []).append(entry)
            empty.rebuild_index()
        self.store = empty

    def _open(self) -> ArrayFile:
        assert self.file is not None
        if self.mapped is None:
            self.mapped = ArrayFile(self.file)
        return self.mapped


def observation_arrays(observations: Observations) -> dict[str, NDArray[Any]]:
    """Columns, segments and agreements as files hold them."""
    columns = observations.columns
    arrays: dict[str, NDArray[Any]] = {name: getattr(columns, name) for name in COLUMNS}
    arrays |= {f"segment_{k}": rows for k, rows in observations.segments.rows().items()}
    log = observations.agreement_log()
    lengths = [len(entry[0]) for _, entry in log]
    arrays["agreement_round"] = np.array([number for number, _ in log], np.int32)
    arrays["agreement_start"] = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    kinds = {"row": np.int32, "weight": np.float32, "before": np.float32}
    for k, (name, kind) in enumerate(kinds.items()):
        parts = [np.empty(0, kind), *(entry[k] for _, entry in log)]
        arrays[f"agreement_{name}"] = np.concatenate(parts)
    return arrays


def fill(empty: Observations, arrays: dict[str, NDArray[Any]], views: ViewTable) -> None:
    """Take columns and segments of ``observation_arrays``; the index is to be built."""
    view = arrays["view"]
    columns = {name: arrays[name] for name in COLUMNS} | of_views(view, views)
    empty.columns.replace(len(view), columns.__getitem__)
    empty.segments.append(*(arrays[f"segment_{k}"] for k in ("start", "length", "view")),
                          box=arrays["segment_box"])  # fmt: skip


def of_views(view: NDArray[np.int32], views: ViewTable) -> dict[str, NDArray[Any]]:
    """The columns that follow from the view: round, generated, and empty chains."""
    none = np.full(len(view), -1, np.int32)
    return {"round": views.round[view], "generated": views.generated[view], "next": none}


def read_agreements(file: ArrayFile) -> list[tuple[int, AgreementEntry]]:
    """The agreements in a tile's file, see ``Observations.agreement_log``."""
    ends = file.array("agreement_start").tolist()
    row, weight, before = (file.array(f"agreement_{name}") for name in ("row", "weight", "before"))
    return [
        (number, (row[a:b].copy(), weight[a:b].copy(), before[a:b].copy()))
        for number, a, b in zip(
            file.array("agreement_round").tolist(), ends[:-1], ends[1:], strict=True
        )
    ]


def read_segments(file: ArrayFile, views: int) -> Segments:
    """The segments of a tile's file, checked."""
    arrays = {f"segment_{name}": file.array(f"segment_{name}") for name in Segments.LAYOUT}
    try:
        _check_segments(arrays, views, file.meta.get("count"))
    except ValueError as error:
        raise _misfit(file, error) from None
    segments = Segments()
    start, length, view, box = arrays.values()
    segments.append(start, length, view, box=box)
    return segments


def check_observations(arrays: Mapping[str, NDArray[Any]], views: int) -> None:
    """Refuse arrays of ``observation_arrays`` that contradict each other, by a ValueError."""
    count = len(arrays["view"])
    for name in COLUMNS:
        width, shape = LAYOUT[name][1], arrays[name].shape
        fits = shape == ((count, width) if width > 1 else (count,))
        check_fit(fits, f"{name} has shape {shape} beside {count} views")
    level, row = arrays["level"], arrays["agreement_row"]
    check_fit(_within(arrays["view"], views), "an observation names a view that is not there")
    known = level.dtype == np.uint8 and _within(level, MOST_LEVEL + 1)
    check_fit(known, "an observation is of a level that is not there")
    for name in ("spacing", "confidence"):
        check_fit(not (arrays[name] < 0).any(), f"{name} is negative in places")
    _check_segments(arrays, views, count)
    start = arrays["agreement_start"]
    check_fit(_within(row, count), "an agreement names an observation that is not there")
    log = len(start) == len(arrays["agreement_round"]) + 1 and _covers(start, len(row))
    check_fit(log, "agreements do not fill their log")
    for name, array in arrays.items():
        if name in ("agreement_weight", "agreement_before"):
            check_fit(array.shape == row.shape, f"{name} has shape {array.shape}, not {row.shape}")
        # A box of nothing is infinite.
        finite = array.dtype.kind != "f" or name == "segment_box" or np.isfinite(array).all()
        check_fit(finite, f"{name} holds numbers that are not finite")


def _check_segments(arrays: Mapping[str, NDArray[Any]], views: int, count: Any) -> None:
    """Refuse segments that do not cover ``count`` observations, one behind the other."""
    start, length, view, box = (arrays[f"segment_{name}"] for name in Segments.LAYOUT)
    ends = np.cumsum(length, dtype=np.int64)
    behind = bool((length > 0).all()) and np.array_equal(start, ends - length)
    check_fit(behind, "segments are not contiguous")
    check_fit(length.sum(dtype=np.int64) == count, "segments do not cover the observations")
    check_fit(_within(view, views), "a segment names a view that is not there")
    check_fit(not np.isnan(box).any(), "segment_box holds numbers that are not finite")


def _within(numbers: NDArray[Any], end: int) -> bool:
    return not len(numbers) or bool(0 <= numbers.min() <= numbers.max() < end)


def _covers(start: NDArray[Any], count: int) -> bool:
    """Whether parts that begin at ``start`` follow each other from 0 to ``count``."""
    return bool(start[0] == 0 and start[-1] == count and (np.diff(start) >= 0).all())


def check_fit(fits: Any, fault: str) -> None:
    """Refuse parts of a memory that contradict each other."""
    if not fits:
        raise ValueError(fault)


def _misfit(file: ArrayFile, fault: Exception | str) -> MemoryFileError:
    return MemoryFileError(
        f"{file.path}: the tile's parts do not fit together ({fault}); run again"
    )


def _splat_columns(file: ArrayFile, head: str = "", *, rows: int) -> SplatColumns:
    return SplatColumns(*(_column(file, name, rows, head) for name in SplatColumns._fields))


def _column(file: ArrayFile, name: str, rows: int, head: str = "") -> NDArray[Any]:
    """A column of so many observations, or of their thinned copy."""
    column, (kind, width) = file.array(f"{head}{name}"), LAYOUT[name]
    fits = column.shape == ((rows, width) if width > 1 else (rows,)) and column.dtype == kind
    if not fits or (column.dtype.kind == "f" and not np.isfinite(column).all()):
        raise _misfit(file, f"{head}{name}")
    return column
