"""The memory's points in the web viewer: one node a round, shown up to the round looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from viz.run_view import RunView
from viz.run_view_detail import Detail
from viz.web_viewer_frame import PageFrame

if TYPE_CHECKING:
    import viser


class PointNodes:
    """Points by round.

    Args:
        server: that shows them.
        frame: to show them in.
    """

    def __init__(self, server: viser.ViserServer, frame: PageFrame) -> None:
        self._server = server
        self._frame = frame
        self._nodes: dict[int, viser.PointCloudHandle] = {}
        # Per round, places within ``rows``.
        self._places: dict[int, NDArray[np.int64]] = {}
        self._visible, self._round, self._scale = True, 0, 1.0
        self.rows: NDArray[np.int64] = np.zeros(0, np.int64)
        self.size = 0.0

    def set_points(self, run: RunView, drawn: Detail, rgb: NDArray[np.uint8]) -> None:
        """Show other points; rounds whose points are what they were are not sent again.

        Args:
            run: whose they are.
            drawn: which.
            rgb: (P, 3) uint8, their colours.
        """
        memory = run.memory
        before = {number: self.rows[places] for number, places in self._places.items()}
        same_size = drawn.size == self.size
        rounds = memory.views.round[memory.records.view[drawn.rows]]
        self.rows, self.size = drawn.rows, drawn.size
        self._places = {int(k): np.flatnonzero(rounds == k) for k in np.unique(rounds)}
        for number in [k for k in self._nodes if k not in self._places]:
            self._nodes.pop(number).remove()
        for number, places in self._places.items():
            rows = drawn.rows[places]
            if same_size and number in before and np.array_equal(before[number], rows):
                self._recolor(number, rgb[places])
                continue
            records = memory.records
            local = np.stack([records.x[rows], records.y[rows], records.z[rows]], axis=1)
            self._nodes[number] = self._server.scene.add_point_cloud(
                f"/points/round_{number:03d}",
                self._frame.points(local),
                rgb[places],
                point_size=self._point_size(),
                point_shape="square",
                point_shading="flat",
                precision="float32",
                visible=self._visible and number <= self._round,
            )

    def recolor(self, rgb: NDArray[np.uint8]) -> None:
        """Other colours (P, 3) uint8 of the same points."""
        for number, places in self._places.items():
            self._recolor(number, rgb[places])

    def _recolor(self, number: int, rgb: NDArray[np.uint8]) -> None:
        node = self._nodes[number]
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
        """How many points are drawn of the rounds up to ``number``."""
        return sum(len(places) for round, places in self._places.items() if round <= number)
