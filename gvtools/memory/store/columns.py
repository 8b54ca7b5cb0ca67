"""The memory's observations as Open3D tensors, and the segments of them that culling works on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.memory.store.voxel_index import extended

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

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    spacing: NDArray[np.float32]
    round: NDArray[np.uint16]
    view_row: NDArray[np.int32]
    generated: NDArray[np.uint8]
    level: NDArray[np.uint8]
    next: NDArray[np.int32]


class Columns:
    """Observations as parallel Open3D tensors with spare capacity.

    The first ``count`` rows are in use. Attributes named as in LAYOUT give these rows: (N, 3)
    ``positions`` float32, scene units, in the memory's frame, and ``colors`` uint8; (N,)
    ``confidence`` float32, what later rounds added included; ``spacing`` float32, scene units;
    ``round`` uint16; ``view`` int32, row of the view table; ``generated`` uint8; ``level`` uint8,
    of the voxel; ``next`` int32, the next observation of the same voxel, -1 at the end. They share
    the tensors' memory as long as these are on the CPU.

    Positions are contiguous rows of three, as Open3D's own: of strided ones its projection would
    read the wrong numbers.

    Args:
        device: of the tensors, such as "cpu" or "cuda:0".
    """

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    spacing: NDArray[np.float32]
    round: NDArray[np.uint16]
    view: NDArray[np.int32]
    generated: NDArray[np.uint8]
    level: NDArray[np.uint8]
    next: NDArray[np.int32]

    def __init__(self, device: str = "cpu") -> None:
        import open3d as o3d

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
        import open3d as o3d

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
            if not self._tensors["positions"].is_cpu:
                raise OptionError(
                    f"the memory is on {self.device}; fusing, forgetting and the cpu and one-pixel "
                    "back ends need it on 'cpu'; use memory.to('cpu')"
                )
            self._arrays = ColumnArrays(*(_flat(self._tensors[name]) for name in LAYOUT))
        return self._arrays

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

    def take_drawn(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Hold other rows, in these arrays themselves; columns that are not given have none."""
        import open3d as o3d

        self.count, self._arrays = len(arrays["positions"]), None
        for name, array in arrays.items():
            column = array.reshape(self.count, LAYOUT[name][1])
            self._tensors[name] = o3d.core.Tensor.from_numpy(column)

    def to(self, device: str) -> Columns:
        """A copy of the rows in use on a device."""
        import open3d as o3d

        other = Columns(device)
        other.count = self.count
        there = o3d.core.Device(device)
        other._tensors = {name: other._empty(name, self.count) for name in LAYOUT}
        for name, tensor in other._tensors.items():
            tensor[:] = self.tensor(name).to(there)
        return other

    def __deepcopy__(self, _: dict[int, Any]) -> Columns:
        return self.to(self.device)

    def with_colors(self, colors: NDArray[np.uint8]) -> Columns:
        """The rows in use with other colours (N, 3); the other columns are shared."""
        import open3d as o3d

        other = Columns(self.device)
        other.count = self.count
        other._tensors = {name: self.tensor(name) for name in LAYOUT}
        other._tensors["colors"] = other._empty("colors", self.count)
        other._tensors["colors"][:] = o3d.core.Tensor.from_numpy(np.ascontiguousarray(colors))
        return other

    def cloud(self) -> o3d.t.geometry.PointCloud:
        """The rows in use as a point cloud in the store's own memory."""
        import open3d as o3d

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


@dataclass(eq=False)
class Segments:
    """Contiguous observations of one block and one view: the unit of culling.

    Attributes:
        count: rows in use.
        start: (C,) int64, first observation.
        length: (C,) int32, observations.
        view: (C,) int32, row of the view table.
        box: (C, 7) float32, scene units: bounding box of the positions (min xyz, max xyz) and the
            largest spacing.
        groups: rows of ``group_box`` in use.
        group_box: (D, 7) float32, the box around each GROUP consecutive segments.
    """

    count: int = 0
    start: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    length: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    view: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    box: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 7), np.float32))
    groups: int = 0
    group_box: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 7), np.float32))

    ARRAYS = ("start", "length", "view", "box")

    # Consecutive segments lie near each other; culling asks groups of this many first.
    GROUP = 32

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
        need = self.count + len(start)
        if need > len(self.start):
            size = max(need, 2 * len(self.start))
            for name in self.ARRAYS:
                setattr(self, name, extended(getattr(self, name), size, self.count))
        for name, rows in zip(self.ARRAYS, (start, length, view, box), strict=True):
            getattr(self, name)[self.count : need] = rows
        first = min(self.count if changed is None else changed, self.count) // self.GROUP
        self.count = need
        self._box_groups(first)

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
            self.group_box = extended(self.group_box, max(groups, 2 * len(self.group_box)), first)
        self.groups = groups
        box = self.box[first * self.GROUP : self.count]
        if len(box):
            starts = np.arange(0, len(box), self.GROUP)
            rows = self.group_box[first:groups]
            rows[:, :3] = np.minimum.reduceat(box[:, :3], starts)
            rows[:, 3:] = np.maximum.reduceat(box[:, 3:], starts)

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use."""
        rows = sum(getattr(self, name)[: self.count].nbytes for name in self.ARRAYS)
        return rows + self.group_box[: self.groups].nbytes
