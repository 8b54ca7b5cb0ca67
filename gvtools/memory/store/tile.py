"""One tile of a memory: observations in RAM, or a file of checksummed arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.memory.store.array_file import ArrayFile, write_arrays
from gvtools.memory.store.columns import LAYOUT, Segments, SplatColumns
from gvtools.memory.store.observations import Agreement, Observations
from gvtools.memory.store.octree import Node
from gvtools.memory.store.thinned_copies import DOUBLINGS, ThinnedCopy, thinned_copy
from gvtools.memory.store.views import ViewTable
from gvtools.memory.store.voxel_index import MOST_LEVEL

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
        file = self._open()
        rows = SplatColumns(*(file.array(name) for name in SplatColumns._fields))
        check(file, _finite(rows))
        return rows

    def thinned(self, doublings: int) -> ThinnedCopy:
        """The thinned copy whose cubes are 2**doublings voxels wide."""
        if self.store is None:
            file, head = self._open(), f"thinned{doublings}_"
            rows = SplatColumns(*(file.array(f"{head}{name}") for name in SplatColumns._fields))
            start = file.array(f"{head}start")
            check(file, len(start) == len(self.segments) + 1 and _alike(file, head, rows))
            check(file, start[0] == 0 and start[-1] == len(rows.spacing))
            check(file, bool((np.diff(start) >= 0).all()) and _finite(rows))
            return ThinnedCopy(start, rows)
        if doublings not in self._copies:
            self._copies[doublings] = thinned_copy(self.store, doublings)
        return self._copies[doublings]

    def column(self, name: str) -> NDArray[Any]:
        """A column of all observations."""
        if self.store is not None:
            return np.asarray(getattr(self.store.columns, name))
        file = self._open()
        column = file.array(name)
        check(file, column.dtype.kind != "f" or bool(np.isfinite(column).all()))
        return column

    def agreements(self) -> list[tuple[int, Agreement]]:
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
            _check(file, len(views))
            arrays = {name: file.array(name) for name in COLUMNS}
            arrays |= {f"segment_{name}": file.array(f"segment_{name}") for name in Segments.LAYOUT}
            fill(empty, arrays, views)
            for number, entry in read_agreements(file):
                empty.agreements.setdefault(number, []).append(entry)
            empty.rebuild_index()
        self.store = empty

    def _open(self) -> ArrayFile:
        assert self.file is not None
        if self.mapped is None:
            self.mapped = ArrayFile(self.file)
            check_shapes(self.mapped)
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


def read_agreements(file: ArrayFile) -> list[tuple[int, Agreement]]:
    """The agreements in a tile's file, see ``Observations.agreement_log``."""
    ends = file.array("agreement_start").tolist()
    row, weight, before = (file.array(f"agreement_{name}") for name in ("row", "weight", "before"))
    return [
        (number, (row[a:b].copy(), weight[a:b].copy(), before[a:b].copy()))
        for number, a, b in zip(
            file.array("agreement_round").tolist(), ends[:-1], ends[1:], strict=True
        )
    ]


def read_segments(file: ArrayFile) -> Segments:
    """The segments of a tile's file."""
    segments = Segments()
    start, length, view, box = (file.array(f"segment_{name}") for name in Segments.LAYOUT)
    segments.append(start, length, view, box=box)
    return segments


def check(file: ArrayFile, fits: bool) -> None:
    """Refuse a file whose arrays contradict each other."""
    if not fits:
        raise MemoryFileError(f"{file.path}: the tile's parts do not fit together; run again")


def check_shapes(file: ArrayFile) -> None:
    """Whether the columns have as many rows as the file says."""
    count = file.meta.get("count")
    for name in COLUMNS:
        kind, width = LAYOUT[name]
        check(file, file.shape(name) == ((count, width) if width > 1 else (count,)))
        check(file, file.kind(name) == np.dtype(kind))


def check_segments(file: ArrayFile, segments: Segments, views: int) -> None:
    """Whether segments cover the observations, one behind the other."""
    start, length, view, box = segments.rows().values()
    ends = np.cumsum(length, dtype=np.int64)
    check(file, bool((length > 0).all()) and np.array_equal(start, ends - length))
    check(file, segments.observations == file.meta.get("count"))
    # A box of nothing is infinite.
    check(file, not np.isnan(box).any())
    check(file, not len(view) or bool(0 <= view.min() <= view.max() < views))


def _check(file: ArrayFile, views: int) -> None:
    """Whether the values of a tile's file fit together."""
    view, level, row = (file.array(name) for name in ("view", "level", "agreement_row"))
    count = len(view)
    check(file, not count or bool(0 <= view.min() <= view.max() < views))
    check(file, int(level.max(initial=0)) <= MOST_LEVEL)
    check(file, not len(row) or bool(0 <= row.min() <= row.max() < count))
    check_segments(file, read_segments(file), views)
    splat = SplatColumns(*(file.array(name) for name in SplatColumns._fields))
    check(file, _finite(splat) and bool((splat.confidence >= 0).all()))
    check(file, bool((splat.spacing >= 0).all()))
    number, start = file.array("agreement_round"), file.array("agreement_start")
    check(file, start.shape == (len(number) + 1,) and int(start[0]) == 0)
    check(file, int(start[-1]) == len(row) and bool((np.diff(start) >= 0).all()))
    for name in ("weight", "before"):
        values = file.array(f"agreement_{name}")
        check(file, values.shape == row.shape and bool(np.isfinite(values).all()))


def _finite(rows: SplatColumns) -> bool:
    """Whether the values of observations are finite."""
    return bool(all(np.isfinite(column).all() for column in rows if column.dtype.kind == "f"))


def _alike(file: ArrayFile, head: str, rows: SplatColumns) -> bool:
    """Whether a thinned copy's columns have one length and their types."""
    count = len(rows.spacing)
    return all(
        column.shape == ((count, 3) if LAYOUT[name][1] == 3 else (count,))
        and file.kind(f"{head}{name}") == np.dtype(LAYOUT[name][0])
        for name, column in rows._asdict().items()
    )
