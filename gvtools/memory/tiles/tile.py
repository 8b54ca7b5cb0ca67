"""One tile: a store of its own while it is in RAM, a file of checksummed arrays otherwise."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.memory.store.columns import LAYOUT, Segments
from gvtools.memory.store.store import Store
from gvtools.memory.store.voxel_index import MOST_LEVEL
from gvtools.memory.tiles.array_file import ArrayFile, write_arrays
from gvtools.memory.tiles.octree import Node
from gvtools.memory.tiles.thinned_copies import DOUBLINGS, Drawn, ThinnedCopy, thinned_copy

SEGMENT_ARRAYS = ("start", "length", "view", "box")
COLUMNS = ("positions", "colors", "confidence", "spacing", "view", "level")
# Bytes of an observation that projection maps.
DRAWN_BYTES = 23
# Rows, confidence added and confidence before, of one view that agreed.
Agreement = tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]


@dataclass(eq=False)
class Tile:
    """A cube of voxels.

    Attributes:
        node: the cube.
        segments: (S,) int32, its segments by their row in the memory's table, in its own order.
        store: its observations while they are in RAM.
        file: where they lie otherwise; of an older state while ``dirty``.
        owned: whether the file lies in the working folder, so that nobody else reads it.
        dirty: whether ``store`` has changed since it was written.
        size: bytes of its store, in RAM or not.
        count: observations.
        voxels: occupied ones.
        agreed: rounds that added confidence here.
        indivisible: bytes at which it was found not to divide; 0 otherwise.
    """

    node: Node
    segments: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    store: Store | None = None
    file: Path | None = None
    owned: bool = True
    dirty: bool = False
    size: int = 0
    count: int = 0
    voxels: int = 0
    agreed: tuple[int, ...] = ()
    indivisible: int = 0
    mapped: ArrayFile | None = None
    _copies: dict[int, ThinnedCopy] = field(default_factory=dict)

    @property
    def resident(self) -> int:
        """Bytes that it takes in RAM now."""
        total = 0
        if self.store is not None:
            total += self.store.stored_bytes
            total += sum(sum(c.nbytes for c in copy.rows) for copy in self._copies.values())
        if self.mapped is not None:
            total += DRAWN_BYTES * int(self.mapped.meta["count"])
        return total

    def changed(self) -> None:
        """Its store has changed."""
        assert self.store is not None
        self.dirty = True
        self._copies.clear()
        self.mapped = None
        self.size, self.count = self.store.stored_bytes, len(self.store)
        self.voxels = self.store.voxels
        self.agreed = tuple(sorted(self.store.agreements))

    def drawn(self) -> Drawn:
        """All observations, as splatting reads them."""
        if self.store is not None:
            arrays = self.store.columns.arrays
            return Drawn(arrays.positions, arrays.colors, arrays.confidence, arrays.spacing)
        file = self._open()
        rows = Drawn(*(file.array(name) for name in Drawn._fields))
        check(file, _numbers(rows))
        return rows

    def thinned(self, doublings: int) -> ThinnedCopy:
        """The thinned copy whose cubes are 2**doublings voxels wide."""
        if self.store is None:
            file, head = self._open(), f"thinned{doublings}_"
            rows = Drawn(*(file.array(f"{head}{name}") for name in Drawn._fields))
            start = file.array(f"{head}start")
            check(file, len(start) == len(self.segments) + 1 and _alike(file, head, rows))
            check(file, start[0] == 0 and start[-1] == len(rows.spacing))
            check(file, bool((np.diff(start) >= 0).all()) and _numbers(rows))
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
            log = self.store.agreements
            return [(number, entry) for number in sorted(log) for entry in log[number]]
        return read_agreements(self._open())

    def write(self, path: Path) -> None:
        """Write its store to a file, which it is then read from."""
        store = self.store
        assert store is not None
        columns, segments = store.columns, store.segments
        arrays: dict[str, NDArray[Any]] = {name: getattr(columns, name) for name in COLUMNS}
        for name in SEGMENT_ARRAYS:
            arrays[f"segment_{name}"] = getattr(segments, name)[: segments.count]
        entries = self.agreements()
        lengths = [len(entry[0]) for _, entry in entries]
        arrays["agreement_round"] = np.array([number for number, _ in entries], np.int32)
        arrays["agreement_start"] = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        kinds = {"row": np.int32, "weight": np.float32, "before": np.float32}
        for k, (name, kind) in enumerate(kinds.items()):
            parts = [np.empty(0, kind), *(entry[k] for _, entry in entries)]
            arrays[f"agreement_{name}"] = np.concatenate(parts)
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

    def load(self, empty: Store) -> None:
        """Bring its store into RAM; ``empty``, which knows the views, is filled."""
        if self.file is not None:
            file = self._open()
            self.mapped = None
            _check(file, len(empty.views))
            fill_store(empty, file)
            for number, (rows, weights, before) in read_agreements(file):
                empty.agreements.setdefault(number, []).append((rows, weights, before))
        self.store = empty

    def _open(self) -> ArrayFile:
        assert self.file is not None
        if self.mapped is None:
            self.mapped = ArrayFile(self.file)
            check_shapes(self.mapped)
        return self.mapped


def fill_store(store: Store, file: ArrayFile) -> None:
    """Columns, segments and index of a tile's store from its file."""
    view, views = file.array("view"), store.views
    made = {"round": views.round[view], "generated": views.generated[view]}
    made["next"] = np.full(len(view), -1)
    store.columns.replace(len(view), lambda name: made[name] if name in made else file.array(name))
    store.segments = read_segments(file)
    store.rebuild_index()


def read_agreements(file: ArrayFile) -> list[tuple[int, Agreement]]:
    """See ``Tile.agreements``."""
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
    start, length, view, box = (file.array(f"segment_{name}") for name in SEGMENT_ARRAYS)
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
    n = segments.count
    start, length, view = (
        segments.start[:n],
        segments.length[:n].astype(np.int64),
        segments.view[:n],
    )
    ends = np.cumsum(length)
    check(file, bool((length > 0).all()) and np.array_equal(start, ends - length))
    check(file, (int(ends[-1]) if n else 0) == file.meta.get("count"))
    # A box of nothing is infinite.
    check(file, not np.isnan(segments.box[:n]).any())
    check(file, not n or bool(0 <= view.min() <= view.max() < views))


def _check(file: ArrayFile, views: int) -> None:
    """Whether the values of a tile's file fit together."""
    view, level, row = (file.array(name) for name in ("view", "level", "agreement_row"))
    count = len(view)
    check(file, not count or bool(0 <= view.min() <= view.max() < views))
    check(file, int(level.max(initial=0)) <= MOST_LEVEL)
    check(file, not len(row) or bool(0 <= row.min() <= row.max() < count))
    check_segments(file, read_segments(file), views)
    drawn = Drawn(*(file.array(name) for name in Drawn._fields))
    check(file, _numbers(drawn) and bool((drawn.confidence >= 0).all()))
    check(file, bool((drawn.spacing >= 0).all()))
    number, start = file.array("agreement_round"), file.array("agreement_start")
    check(file, start.shape == (len(number) + 1,) and int(start[0]) == 0)
    check(file, int(start[-1]) == len(row) and bool((np.diff(start) >= 0).all()))
    for name in ("weight", "before"):
        values = file.array(f"agreement_{name}")
        check(file, values.shape == row.shape and bool(np.isfinite(values).all()))


def _numbers(rows: Drawn) -> bool:
    """Whether the values of observations are finite."""
    return bool(all(np.isfinite(column).all() for column in rows if column.dtype.kind == "f"))


def _alike(file: ArrayFile, head: str, rows: Drawn) -> bool:
    """Whether a thinned copy's columns have one length and their types."""
    count = len(rows.spacing)
    return all(
        column.shape == ((count, 3) if LAYOUT[name][1] == 3 else (count,))
        and file.kind(f"{head}{name}") == np.dtype(LAYOUT[name][0])
        for name, column in rows._asdict().items()
    )
