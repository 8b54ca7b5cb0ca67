"""From where the memory's observations were seen."""

from __future__ import annotations

from collections.abc import Iterable
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

    def __init__(self, origin: NDArray[np.float64], views: Iterable[SourceView] = ()) -> None:
        self.origin = origin
        self._views: list[SourceView] = []
        self.round: NDArray[np.int32] = np.zeros(0, np.int32)
        self.generated: NDArray[np.bool_] = np.zeros(0, np.bool_)
        self.centers: NDArray[np.float64] = np.zeros((0, 3))
        self.cam_from_local: NDArray[np.float64] = np.zeros((0, 4, 4))
        for view in views:
            self.append(view)

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> SourceView:
        return self._views[index]

    @property
    def cameras(self) -> Cameras | None:
        """All cameras, in the world frame; None when there are no views."""
        return concatenate([view.camera for view in self._views]) if self._views else None

    def append(self, view: SourceView) -> int:
        """Add a view; returns its row."""
        self._views.append(view)
        self.round = np.append(self.round, np.int32(view.round))
        self.generated = np.append(self.generated, view.generated)
        self.centers = np.concatenate([self.centers, view.camera.centers - self.origin])
        local = view.camera.cam_from_world.copy()
        # x_cam = R x_world + t = R (x_local + origin) + t
        local[:, :3, 3] += local[0, :3, :3] @ self.origin
        self.cam_from_local = np.concatenate([self.cam_from_local, local])
        return len(self._views) - 1
