"""The memory's points in the web viewer: a node a chunk and round, shown as the slider says."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from viz.run_view.chunks import Chunks
from viz.run_view.detail import Detail
from viz.run_view.view import RunView
from viz.web.frame import PageFrame

if TYPE_CHECKING:
    import viser

    from gvtools.memory.spatial_memory import SpatialMemory

Key = tuple[int, int]


class PointNodes:
    """What is drawn of the whole memory, for all who look; by chunk and round.

    Args:
        server: that shows them.
        frame: to show them in.
    """

    def __init__(self, server: viser.ViserServer, frame: PageFrame) -> None:
        self._server = server
        self._frame = frame
        self._nodes: dict[Key, viser.PointCloudHandle] = {}
        # By node, places within ``rows``.
        self._places: dict[Key, NDArray[np.int64]] = {}
        self._visible, self._round, self._scale = True, 0, 1.0
        self.rows: NDArray[np.int64] = np.zeros(0, np.int64)
        self.size = 0.0

    def set_points(
        self, run: RunView, drawn: Detail, chunks: Chunks, rgb: NDArray[np.uint8]
    ) -> None:
        """Show other points; nodes whose points are what they were are not sent again.

        Args:
            run: whose they are.
            drawn: which.
            chunks: that they are divided into.
            rgb: (P, 3) uint8, their colours.
        """
        memory = run.memory
        before = {key: self.rows[places] for key, places in self._places.items()}
        same_size = drawn.size == self.size
        self.rows, self.size = drawn.rows, drawn.size
        rounds = memory.views.round[memory.columns.view[drawn.rows]]
        span = int(rounds.max(initial=0)) + 1
        keys = chunks.number(memory, drawn.rows).astype(np.int64) * span + rounds
        self._places = {divmod(key, span): places for key, places in groups(keys)}
        for key in [k for k in self._nodes if k not in self._places]:
            self._nodes.pop(key).remove()
        for key, places in self._places.items():
            rows = drawn.rows[places]
            if same_size and key in before and np.array_equal(before[key], rows):
                self._recolor(key, rgb[places])
                continue
            self._nodes[key] = add_points(
                self._server.scene,
                key,
                positions_on_page(memory, rows, self._frame),
                rgb[places],
                size=self._point_size(),
                visible=self._visible and key[1] <= self._round,
            )

    def recolor(self, rgb: NDArray[np.uint8]) -> None:
        """Other colours (P, 3) uint8 of the same points."""
        for key, places in self._places.items():
            self._recolor(key, rgb[places])

    def _recolor(self, key: Key, rgb: NDArray[np.uint8]) -> None:
        node = self._nodes[key]
        if not np.array_equal(node.colors, rgb):
            node.colors = rgb

    def show(self, number: int) -> None:
        """Show the rounds up to ``number``."""
        self._round = number
        for (_, round), node in self._nodes.items():
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

    def drawn(self, number: int, chunks: Collection[int] | None = None) -> int:
        """How many points there are of the rounds up to ``number``, in all chunks or in some."""
        return sum(
            len(places)
            for (chunk, round), places in self._places.items()
            if round <= number and (chunks is None or chunk in chunks)
        )


def add_points(
    scene: viser.SceneApi,
    key: Key,
    points: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    *,
    size: float,
    visible: bool,
    around: NDArray[np.float32] | None = None,
) -> viser.PointCloudHandle:
    """A node of points (P, 3) in the page's frame with colours (P, 3).

    In the scene of one client it takes the place of the node that all have under its key. Points
    near ``around`` (3,), if given, are sent in half precision relative to it: 9 bytes each, not 15.
    """
    middle = np.zeros(3, np.float32) if around is None else around
    return scene.add_point_cloud(
        f"/points/{key[0]:04d}/round_{key[1]:03d}",
        points - middle,
        rgb,
        point_size=size,
        point_shape="square",
        point_shading="flat",
        precision="float32" if around is None else "float16",
        position=middle,
        visible=visible,
    )


def positions_on_page(
    memory: SpatialMemory, rows: NDArray[np.int64], frame: PageFrame
) -> NDArray[np.float32]:
    """(P, 3) float32, where observations are on the page."""
    return frame.points(memory.columns.positions[rows])


def groups(values: NDArray[np.integer]) -> list[tuple[int, NDArray[np.int64]]]:
    """Each value (P,) with its places, ascending."""
    order = np.argsort(values, kind="stable")
    found, first = np.unique(values[order], return_index=True)
    return list(zip(found.tolist(), np.split(order, first[1:]), strict=True))
