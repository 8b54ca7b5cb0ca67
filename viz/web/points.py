"""The memory's points in the web viewer: one node a round, shown as the slider says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from viz.run_view.detail import Detail
from viz.run_view.view import RunView
from viz.web.frame import PageFrame

if TYPE_CHECKING:
    import viser


class PointNodes:
    """What is drawn of the memory, the same for all who look.

    Args:
        server: that shows the points.
        frame: of the page.
    """

    def __init__(self, server: viser.ViserServer, frame: PageFrame) -> None:
        self._server = server
        self._frame = frame
        self._nodes: dict[int, viser.PointCloudHandle] = {}
        # By round, places within ``rows``.
        self._places: dict[int, NDArray[np.int64]] = {}
        self._visible, self._round, self._scale = True, 0, 1.0
        self.rows: NDArray[np.int64] = np.zeros(0, np.int64)
        self.size = 0.0

    def set_points(self, run: RunView, drawn: Detail, rgb: NDArray[np.uint8]) -> None:
        """Show other points; rounds whose points have not changed are not sent again.

        Args:
            run: that the points are of.
            drawn: which observations.
            rgb: (P, 3) uint8, their colours.
        """
        memory = run.memory
        before = {key: self.rows[places] for key, places in self._places.items()}
        same_size = drawn.size == self.size
        self.rows, self.size = drawn.rows, drawn.size
        rounds = memory.views.round[memory.columns.view[drawn.rows]]
        self._places = {int(key): np.flatnonzero(rounds == key) for key in np.unique(rounds)}
        for key in [k for k in self._nodes if k not in self._places]:
            self._nodes.pop(key).remove()
        for key, places in self._places.items():
            rows = drawn.rows[places]
            if same_size and key in before and np.array_equal(before[key], rows):
                self._recolor(key, rgb[places])
                continue
            self._nodes[key] = self._server.scene.add_point_cloud(
                f"/points/round_{key:03d}",
                self._frame.points(memory.columns.positions[rows]),
                rgb[places],
                point_size=self._point_size(),
                point_shape="square",
                point_shading="flat",
                precision="float32",
                visible=self._visible and key <= self._round,
            )

    def recolor(self, rgb: NDArray[np.uint8]) -> None:
        """Other colours (P, 3) uint8 of the same points."""
        for key, places in self._places.items():
            self._recolor(key, rgb[places])

    def _recolor(self, key: int, rgb: NDArray[np.uint8]) -> None:
        node = self._nodes[key]
        if not np.array_equal(node.colors, rgb):
            node.colors = rgb

    def show(self, number: int) -> None:
        """Show the rounds up to ``number``."""
        self._round = number
        for round, node in self._nodes.items():
            node.visible = self._visible and round <= number

    def set_visible(self, visible: bool) -> None:
        """Show or hide all points."""
        self._visible = visible
        self.show(self._round)

    def set_size(self, scale: float) -> None:
        """Draw points ``scale`` times their spacing wide."""
        self._scale = scale
        for node in self._nodes.values():
            node.point_size = self._point_size()

    def _point_size(self) -> float:
        return self._frame.scale * self.size * self._scale

    def drawn(self, number: int) -> int:
        """How many points there are of the rounds up to ``number``."""
        return sum(len(places) for round, places in self._places.items() if round <= number)
