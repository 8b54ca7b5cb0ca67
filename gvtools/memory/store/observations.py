"""Observations of a memory or of one of its tiles: columns, segments, voxel index, agreements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.memory.store.voxel_index import VoxelIndex, extend, link_records, voxel_keys

if TYPE_CHECKING:
    import open3d as o3d

# Type and width of each column; the point cloud has all but ``next``, which is the voxel index's.
LAYOUT: dict[str, tuple[Any, int]] = {
    "positions": (np.float32, 3),
    "colors": (np.uint8, 3),
    "confidence": (np.float32, 1),
    "spacing": (np.float32, 1),
    "round": (np.uint16, 1),
    "view": (np.int32, 1),
    "generated": (np.uint8, 1),
    "level": (np.uint8, 1),
    "next": (np.int32, 1),
}
ROW_BYTES = sum(np.dtype(kind).itemsize * width for kind, width in LAYOUT.values())
ATTRIBUTES = tuple(name for name in LAYOUT if name != "next")
LAST_ROUND = int(np.iinfo(np.uint16).max)


class ColumnArrays(NamedTuple):
    """The columns as kernels take them: numpy views of the tensors' memory, spare rows included.

    ``view`` is called ``view_row``: numba takes the other for numpy's method.
    """

    positions: NDArray[np.float32]  # in the memory's frame
    colors: NDArray[np.uint8]
    confidence: NDArray[np.float32]  # with what later rounds added
    spacing: NDArray[np.float32]  # scene units
    round: NDArray[np.uint16]
    view_row: NDArray[np.int32]  # of the view table
    generated: NDArray[np.uint8]
    level: NDArray[np.uint8]
    next: NDArray[np.int32]  # observation of the same voxel, -1 at the end


class SplatColumns(NamedTuple):
    """The columns that splatting reads, as in ColumnArrays."""

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    spacing: NDArray[np.float32]


class Columns:
    """Observations as parallel Open3D tensors with spare capacity, on "cpu" or "cuda:0".

    The first ``count`` rows are in use. Attributes named as in LAYOUT give these rows, (N, 3) or
    (N,); they share the tensors' memory as long as these are on the CPU. Positions are contiguous
    rows of three: of strided ones Open3D's own projection would read the wrong numbers.
    """

    def __init__(self, device: str = "cpu") -> None:
        from gvtools.o3d import o3d

        device = "cpu" if device.lower() in ("cpu", "cpu:0") else device
        kind = device.split(":")[0].lower()
        if device != "cpu" and not (kind == "cuda" and o3d.core.cuda.is_available()):
            raise OptionError(
                f"memory device {device!r}; expected 'cpu', or 'cuda:0' where Open3D finds CUDA"
            )
        self.device = device
        self.count = 0
        self._tensors = {name: self._empty(name, 0) for name in LAYOUT}
        self._arrays: ColumnArrays | None = None

    def _empty(self, name: str, rows: int) -> o3d.core.Tensor:
        from gvtools.o3d import o3d

        dtype, width = LAYOUT[name]
        if self.device == "cpu":
            # In memory that numpy gives: Open3D ends a process with status 1 where tensors of its
            # own are still alive, such as those that a viewer's window holds.
            return o3d.core.Tensor.from_numpy(np.empty((rows, width), dtype))
        kind = getattr(o3d.core, np.dtype(dtype).name)
        return o3d.core.Tensor.empty((rows, width), kind, o3d.core.Device(self.device))

    @property
    def arrays(self) -> ColumnArrays:
        """Views of the tensors for kernels, which run on the CPU."""
        if self._arrays is None:
            self.require_cpu()
            self._arrays = ColumnArrays(*(_flat(self._tensors[name]) for name in LAYOUT))
        return self._arrays

    def require_cpu(self) -> None:
        """Refuse tensors on another device."""
        if self.device != "cpu":
            raise OptionError(
                f"the memory is on {self.device}; fusing, forgetting and the cpu and one-pixel "
                "back ends need it on 'cpu'; use memory.to('cpu')"
            )

    @property
    def splat(self) -> SplatColumns:
        """What splatting reads; spare rows included, where no copy to the CPU is needed."""
        of = self if self.device != "cpu" else self.arrays
        return SplatColumns(*(getattr(of, name) for name in SplatColumns._fields))

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name not in LAYOUT:
            raise AttributeError(name)
        return _flat(self.tensor(name).cpu())

    def tensor(self, name: str) -> o3d.core.Tensor:
        """The rows in use of a column, (N, 1) or (N, 3), in the store's own memory."""
        return self._tensors[name][: self.count]

    def reserve(self, extra: int) -> None:
        """Make room for ``extra`` more rows, doubling the capacity."""
        need = self.count + extra
        capacity = self._tensors["positions"].shape[0]
        if need > capacity:
            for name in LAYOUT:
                bigger = self._empty(name, max(need, 2 * capacity))
                bigger[: self.count] = self.tensor(name)
                self._tensors[name] = bigger
            self._arrays = None

    def replace(self, count: int, values: Callable[[str], NDArray[Any]]) -> None:
        """Hold other rows: ``values`` gives each column's."""
        fresh = Columns(self.device)
        fresh.reserve(count)
        arrays: tuple[NDArray[Any], ...] = fresh.arrays
        for name, array in zip(LAYOUT, arrays, strict=True):
            array[:count] = values(name)
        self._tensors, self._arrays, self.count = fresh._tensors, fresh._arrays, count

    def to(self, device: str) -> Columns:
        """A copy of the rows in use on a device."""
        from gvtools.o3d import o3d

        other = Columns(device)
        other.count = self.count
        there = o3d.core.Device(device)
        other._tensors = {name: other._empty(name, self.count) for name in LAYOUT}
        for name, tensor in other._tensors.items():
            tensor[:] = self.tensor(name).to(there)
        return other

    def with_colors(self, colors: NDArray[np.uint8]) -> Columns:
        """The rows in use with other colours (N, 3); the other columns are shared."""
        from gvtools.o3d import o3d

        other = Columns(self.device)
        other.count = self.count
        other._tensors = {name: self.tensor(name) for name in LAYOUT}
        other._tensors["colors"] = other._empty("colors", self.count)
        other._tensors["colors"][:] = o3d.core.Tensor.from_numpy(np.ascontiguousarray(colors))
        return other

    def cloud(self) -> o3d.t.geometry.PointCloud:
        """The rows in use as a point cloud in the store's own memory."""
        from gvtools.o3d import o3d

        cloud = o3d.t.geometry.PointCloud(o3d.core.Device(self.device))
        for name in ATTRIBUTES:
            cloud.point[name] = self.tensor(name)
        return cloud

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use."""
        return self.count * ROW_BYTES


def _flat(tensor: o3d.core.Tensor) -> NDArray[Any]:
    """(N, 3) as it is, (N, 1) as (N,); in the tensor's memory, which the view keeps alive."""
    array = tensor.numpy()
    return array if array.shape[1] == 3 else array.reshape(-1)


class GrowableTable:
    """Parallel arrays with spare capacity; the first ``count`` rows are in use."""

    # Type and width of each array.
    LAYOUT: ClassVar[dict[str, tuple[Any, int]]]

    def __init__(self) -> None:
        self.count = 0
        for name, (kind, width) in self.LAYOUT.items():
            setattr(self, name, np.empty((0, width) if width > 1 else 0, kind))

    def rows(self) -> dict[str, NDArray[Any]]:
        """The rows in use, by the arrays' names."""
        return {name: getattr(self, name)[: self.count] for name in self.LAYOUT}

    def append_rows(self, *columns: NDArray[Any]) -> None:
        """Add rows, one array for each of LAYOUT."""
        need = self.count + len(columns[0])
        capacity = len(getattr(self, next(iter(self.LAYOUT))))
        for name, rows in zip(self.LAYOUT, columns, strict=True):
            if need > capacity:
                longer = extend(getattr(self, name), max(need, 2 * capacity), self.count)
                setattr(self, name, longer)
            getattr(self, name)[self.count : need] = rows
        self.count = need

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use."""
        return sum(rows.nbytes for rows in self.rows().values())


class Segments(GrowableTable):
    """Contiguous observations of one block and one view: the unit of culling."""

    LAYOUT: ClassVar[dict[str, tuple[Any, int]]] = {
        "start": (np.int64, 1), "length": (np.int32, 1), "view": (np.int32, 1),
        "box": (np.float32, 7),
    }  # fmt: skip
    # First observation, observations, row of the view table.
    start: NDArray[np.int64]
    length: NDArray[np.int32]
    view: NDArray[np.int32]
    # Bounding box of the positions (min xyz, max xyz) and the largest spacing, scene units.
    box: NDArray[np.float32]

    # Consecutive segments lie near each other; culling asks groups of this many first.
    GROUP = 32

    def __init__(self) -> None:
        super().__init__()
        # Groups in use, and the box around each, as of segments.
        self.groups = 0
        self.group_box: NDArray[np.float32] = np.empty((0, 7), np.float32)

    def append(
        self,
        start: NDArray[np.int64],
        length: NDArray[np.int32],
        view: NDArray[np.int32],
        *,
        box: NDArray[np.float32],
        changed: int | None = None,
    ) -> None:
        """Add rows of equal number; ``changed`` is the first earlier segment whose box grew."""
        first = min(self.count if changed is None else changed, self.count) // self.GROUP
        self.append_rows(start, length, view, box)
        self._box_groups(first)

    def follow(
        self, length: NDArray[np.int32], view: NDArray[np.int32], box: NDArray[np.float32]
    ) -> None:
        """Add segments whose observations follow those of the segments there."""
        ends = self.observations + np.cumsum(length, dtype=np.int64)
        self.append(ends - length, length, view, box=box)

    def without_views(self, keep_view: NDArray[np.bool_]) -> Segments:
        """The segments of the views to be kept, (views,); each segment is one view's."""
        rows = self.rows()
        stays = keep_view[rows["view"]]
        new_view = (np.cumsum(keep_view) - 1).astype(np.int32)
        out = Segments()
        out.follow(rows["length"][stays], new_view[rows["view"][stays]], rows["box"][stays])
        return out

    def widen(self, rows: NDArray[np.int32], box: NDArray[np.float32]) -> None:
        """Give some segments boxes that hold their present ones."""
        self.box[rows] = box
        group = rows // self.GROUP
        np.minimum.at(self.group_box[:, :3], group, box[:, :3])
        np.maximum.at(self.group_box[:, 3:], group, box[:, 3:])

    def _box_groups(self, first: int) -> None:
        """Bring the groups' boxes from group ``first`` on up to date."""
        groups = -(-self.count // self.GROUP)
        if groups > len(self.group_box):
            self.group_box = extend(self.group_box, max(groups, 2 * len(self.group_box)), first)
        self.groups = groups
        box = self.box[first * self.GROUP : self.count]
        if len(box):
            starts = np.arange(0, len(box), self.GROUP)
            rows = self.group_box[first:groups]
            rows[:, :3] = np.minimum.reduceat(box[:, :3], starts)
            rows[:, 3:] = np.maximum.reduceat(box[:, 3:], starts)

    @property
    def observations(self) -> int:
        """Their number: segments lie one behind the other."""
        last = self.count - 1
        return int(self.start[last]) + int(self.length[last]) if self.count else 0

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use."""
        return super().nbytes + self.group_box[: self.groups].nbytes


class SegmentPlaces(GrowableTable):
    """Where the segments of a memory's table lie in its tiles, and the level of their voxels."""

    LAYOUT: ClassVar[dict[str, tuple[Any, int]]] = {
        "tile": (np.int32, 1), "local": (np.int32, 1), "row": (np.int64, 1), "level": (np.uint8, 1),
    }  # fmt: skip
    # Number of the tile; row in the tile's own table; first observation in the tile.
    tile: NDArray[np.int32]
    local: NDArray[np.int32]
    row: NDArray[np.int64]
    level: NDArray[np.uint8]

    def move(self, which: NDArray[np.int32], tile: int, segments: Segments) -> None:
        """Segments ``which`` are now all those of a tile, in this order."""
        self.tile[which] = tile
        self.local[which] = np.arange(len(which), dtype=np.int32)
        self.row[which] = segments.start[: segments.count]

    def select(self, keep: NDArray[np.bool_]) -> None:
        """Keep some rows, in their order."""
        for name, rows in self.rows().items():
            setattr(self, name, rows[keep])
        self.count = len(self.tile)


# Rows, confidence added and confidence before, of one view that agreed.
AgreementEntry = tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]
# Placeholder for the column ``next``: rebuild_index links the chains again.
NONE = np.full(1, -1, np.int32)


class Observations:
    """What was seen of a part of space; ``voxel`` is the edge of the finest voxels."""

    def __init__(self, voxel: float, weight_cap: float, device: str = "cpu") -> None:
        self.voxel, self.weight_cap = voxel, weight_cap
        self.columns = Columns(device)
        self.segments = Segments()
        self.index = VoxelIndex()
        # By round, one entry for each fused view that saw what earlier rounds had observed.
        self.agreements: dict[int, list[AgreementEntry]] = {}

    def __len__(self) -> int:
        return self.columns.count

    @property
    def nbytes(self) -> int:
        """Bytes in use, without spare capacity."""
        agreed = sum(array.nbytes for log in self.agreements.values() for e in log for array in e)
        return self.columns.nbytes + self.segments.nbytes + self.index.nbytes + agreed

    def agree(self, rows: NDArray[np.int32], weights: NDArray[np.float32], *, round: int) -> None:
        """Raise the confidence of ``rows``, each once, up to the cap; ``drop_views`` undoes it."""
        confidence = self.columns.arrays.confidence
        before = confidence[rows]
        with np.errstate(over="ignore"):
            confidence[rows] = np.minimum(before + weights, np.float32(self.weight_cap))
        self.agreements.setdefault(round, []).append((rows, weights, before))

    def agreement_log(self) -> list[tuple[int, AgreementEntry]]:
        """The agreements with their rounds, in order."""
        return [(r, entry) for r in sorted(self.agreements) for entry in self.agreements[r]]

    def own_confidence(self) -> NDArray[np.float32]:
        """(N,) float32, a copy: confidence without what later rounds added."""
        own = self.columns.confidence.copy()
        for _, (rows, _, before) in reversed(self.agreement_log()):
            own[rows] = before
        return own

    def drop_views(self, keep_view: NDArray[np.bool_], *, round: int) -> None:
        """Remove the views, all those of a round, that are not in ``keep_view`` (views,)."""
        columns = self.columns
        new_view = (np.cumsum(keep_view) - 1).astype(np.int32)
        keep = keep_view[columns.view]
        new_row = (np.cumsum(keep) - 1).astype(np.int32)
        # Reset confidence to what each observation had in its own round, remove the round's rows
        # and renumber the rest, then repeat what the other rounds added.
        columns.arrays.confidence[: len(self)] = self.own_confidence()
        log, self.agreements = self.agreement_log(), {}
        columns.replace(int(keep.sum()), lambda name: getattr(columns, name)[keep])
        columns.view[:] = new_view[columns.view]
        for number, (rows, weights, _) in log:
            if number != round:
                self.agree(new_row[rows[keep[rows]]], weights[keep[rows]], round=number)
        self.segments = self.segments.without_views(keep_view)
        self.rebuild_index()

    def rebuild_index(self) -> None:
        """Make the voxel index anew from the columns."""
        count, columns = len(self), self.columns
        keys, locals_ = np.empty(count, np.int64), np.empty(count, np.uint16)
        inverse = 1.0 / self.voxel
        if voxel_keys(columns.positions, columns.level, inverse, keys, locals_):
            raise OptionError(f"observations lie beyond the reach of voxels of {self.voxel:g}")
        self.index = VoxelIndex()
        self.index.top = int(columns.level.max(initial=0))
        blocks = self.index.block_numbers(keys)
        self.index.reserve_voxels(count, np.unique(blocks))
        link_records(locals_, self.index.arrays, blocks, columns.arrays.next)
        self.index.voxels = int(self.index.block_count[: self.index.blocks].sum())

    def part(self, rows: NDArray[np.int64]) -> Observations:
        """A copy of some segments, ``rows`` of their table, ascending."""
        segments, columns = self.segments, self.columns
        length = segments.length[rows]
        chosen = rows_of(segments.start[rows], length.astype(np.int64))
        part = Observations(self.voxel, self.weight_cap)
        part._fill(len(chosen), lambda name: getattr(columns, name).take(chosen, axis=0))
        part.segments.follow(length, segments.view[rows], segments.box[rows])
        new_row = np.full(len(self), -1, np.int32)
        new_row[chosen] = np.arange(len(chosen), dtype=np.int32)
        for number, log in self.agreements.items():
            for agreed, weights, before in log:
                there = new_row[agreed]
                keep = there >= 0
                if keep.any():
                    entry = (there[keep], weights[keep], before[keep])
                    part.agreements.setdefault(number, []).append(entry)
        part.rebuild_index()
        return part

    @staticmethod
    def concatenate(parts: Sequence[Observations]) -> Observations:
        """Copies of observations that share no voxel, one behind the other."""
        whole = Observations(parts[0].voxel, parts[0].weight_cap)
        first = np.cumsum([0, *(len(part) for part in parts)])
        whole._fill(
            int(first[-1]),
            lambda name: np.concatenate([getattr(part.columns, name) for part in parts]),
        )
        for at, part in zip(first.tolist(), parts, strict=False):
            segments = part.segments.rows()
            whole.segments.follow(segments["length"], segments["view"], segments["box"])
            for number, log in part.agreements.items():
                whole.agreements.setdefault(number, []).extend(
                    ((rows + at).astype(np.int32), weights, before) for rows, weights, before in log
                )
        whole.rebuild_index()
        return whole

    def _fill(self, count: int, values: Any) -> None:
        self.columns.replace(count, lambda name: values(name) if name in ATTRIBUTES else NONE)

    def snapshot(self) -> Observations:
        """The rows of now, in the same memory."""
        other = copy(self)
        other.columns, other.segments = copy(self.columns), copy(self.segments)
        return other

    def to(self, device: str) -> Observations:
        """A copy on a device, independent of this one."""
        other = copy(self)
        other.columns = self.columns.to(device)
        other.segments, other.index = deepcopy(self.segments), deepcopy(self.index)
        other.agreements = {round_: list(log) for round_, log in self.agreements.items()}
        return other


def rows_of(start: NDArray[np.int64], length: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the observations of segments (start, length), one segment after the other."""
    ends = np.cumsum(length)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total) + np.repeat(start - (ends - length), length)
