"""From where the memory's observations were seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate


@dataclass(frozen=True, eq=False)
class SourceView:
    """One fused view.

    Attributes:
        camera: a batch of one, in the world frame.
        round: the round it was fused in.
        generated: True when a completer made it.
        free_depth: (h, w) float32, see PointSet; (0, 0) when unknown.
    """

    camera: Cameras
    round: int
    generated: bool
    free_depth: NDArray[np.float32]


class ViewTable:
    """The fused views in order, and their columns as arrays for the kernels."""

    def __init__(self, origin: NDArray[np.float64], views: list[SourceView] | None = None) -> None:
        self.origin = origin
        self._views: list[SourceView] = list(views or [])
        self._columns()

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> SourceView:
        return self._views[index]

    def append(self, view: SourceView) -> int:
        """Add a view; returns its row."""
        self._views.append(view)
        self._columns()
        return len(self._views) - 1

    def drop_last(self) -> None:
        """Take the last view back (its points turned out to be none)."""
        self._views.pop()
        self._columns()

    def _columns(self) -> None:
        views = self._views
        self.round: NDArray[np.int32] = np.array([v.round for v in views], np.int32)
        self.generated: NDArray[np.bool_] = np.array([v.generated for v in views], np.bool_)
        if views:
            cameras = concatenate([v.camera for v in views])
            self.cameras: Cameras | None = cameras
            self.centers: NDArray[np.float64] = cameras.centers - self.origin
            local = cameras.cam_from_world.copy()
            # x_cam = R (x_world) + t = R (x_local + origin) + t
            local[:, :3, 3] += np.einsum("vij,j->vi", local[:, :3, :3], self.origin)
            self.cam_from_local: NDArray[np.float64] = local
        else:
            self.cameras = None
            self.centers = np.zeros((0, 3))
            self.cam_from_local = np.zeros((0, 4, 4))
