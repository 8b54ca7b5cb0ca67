"""Views of a memory: points on their way in, the cameras that saw them, and their table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate
from gvtools.errors import ShapeError
from gvtools.memory.store.local_frame import LocalFrame

# K (3, 3), cam_from_world (4, 4) and free-space grid (h, w) of one view (see PointSet).
FreeGrid = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class PointSet:
    """N points seen by one camera, a batch of one, in ``frame``."""

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    # > 0.
    confidence: NDArray[np.float32]
    # The width of the surface patch that a point stands for, scene units.
    spacing: NDArray[np.float32]
    camera: Cameras
    frame: LocalFrame
    # (h, w) scene units, a coarse grid over the camera's image: space nearer than this along a
    # cell's rays was seen to be empty; 0 where nothing is known.
    free_depth: NDArray[np.float32] | None
    # How many pixels gave no point, by reason.
    dropped: dict[str, int]

    def __post_init__(self) -> None:
        count = len(self.positions)
        shapes = {"positions": (count, 3), "colors": (count, 3), "confidence": (count,)}
        for name, shape in {**shapes, "spacing": (count,)}.items():
            found = getattr(self, name).shape
            if found != shape:
                raise ShapeError(f"points: {name} has shape {found}; expected {shape}")

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, eq=False)
class SourceView:
    """One fused view: its camera is a batch of one, in the world frame."""

    camera: Cameras
    round: int
    generated: bool
    # See PointSet; (0, 0) when unknown.
    free_depth: NDArray[np.float32]
    # True for a station of a scan, which has no photograph.
    scanned: bool = False


class ViewTable:
    """The fused views in order, and their columns as arrays for the kernels."""

    def __init__(self, frame: LocalFrame, views: Iterable[SourceView] = ()) -> None:
        self.frame = frame
        self._views: list[SourceView] = []
        self.round: NDArray[np.int32] = np.zeros(0, np.int32)
        self.generated: NDArray[np.bool_] = np.zeros(0, np.bool_)
        self.scanned: NDArray[np.bool_] = np.zeros(0, np.bool_)
        self.centers: NDArray[np.float64] = np.zeros((0, 3))
        self.cam_from_local: NDArray[np.float64] = np.zeros((0, 4, 4))
        for view in views:
            self.append(view)

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> SourceView:
        return self._views[index]

    def __iter__(self) -> Iterator[SourceView]:
        return iter(self._views)

    @property
    def cameras(self) -> Cameras | None:
        """All cameras, in the world frame; None when there are no views."""
        return concatenate([view.camera for view in self._views]) if self._views else None

    @property
    def photographed(self) -> list[SourceView]:
        """The views that a camera took: neither generated nor a scan's."""
        return [view for view in self._views if not (view.generated or view.scanned)]

    def row_for(self, view: SourceView) -> int:
        """The row of a view: the last one's where both are parts of one fusion, else a new one."""
        if not self._views or not _continues(self._views[-1], view):
            return self.append(view)
        last = self._views[-1]
        if last.free_depth.shape == view.free_depth.shape:
            # Each knows a part; what both know is free as far as both saw.
            one, two = last.free_depth, view.free_depth
            free = np.where((one > 0) & (two > 0), np.minimum(one, two), np.maximum(one, two))
            self._views[-1] = replace(last, free_depth=free)
        return len(self._views) - 1

    def append(self, view: SourceView) -> int:
        """Add a view; returns its row."""
        self._views.append(view)
        self.round = np.append(self.round, np.int32(view.round))
        self.generated = np.append(self.generated, view.generated)
        self.scanned = np.append(self.scanned, view.scanned)
        self.centers = np.concatenate([self.centers, self.frame.from_world(view.camera.centers)])
        local = self.frame.cam_from_local(view.camera.cam_from_world)
        self.cam_from_local = np.concatenate([self.cam_from_local, local])
        return len(self._views) - 1

    def select(self, keep: NDArray[np.bool_]) -> None:
        """Keep some views, in their order."""
        self._views = [view for view, stays in zip(self._views, keep, strict=True) if stays]
        for name in ("round", "generated", "scanned", "centers", "cam_from_local"):
            setattr(self, name, getattr(self, name)[keep])


def _continues(last: SourceView, view: SourceView) -> bool:
    """Whether both are parts of one fusion: of one camera, round and source."""
    one, two = last.camera, view.camera
    return (
        (last.round, last.generated, last.scanned) == (view.round, view.generated, view.scanned)
        and one.names == two.names
        and np.array_equal(one.cam_from_world, two.cam_from_world)
        and np.array_equal(one.K, two.K)
        and (int(one.width[0]), int(one.height[0])) == (int(two.width[0]), int(two.height[0]))
    )
