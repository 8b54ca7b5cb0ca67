"""Near the viewer's own camera all observations are drawn, in place of the coarse points there.

Each client has a camera of its own, so each is sent its own nodes, under the names of the coarse
ones: viser then shows a client its own node, and the one that all have again once it is removed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from viz.run_view.chunks import ChunkRows, Chunks
from viz.run_view.view import RunView
from viz.web.frame import PageFrame
from viz.web.points import add_points, groups, positions_on_page

if TYPE_CHECKING:
    import viser

# Near a camera, as a share of the budget for the whole memory; so many chunks fill it.
NEAR_SHARE, NEAR_CHUNKS = 0.3, 12
# A camera stands still that has not moved for so long.
REST_SECONDS = 0.25
# Where coarse points are no wider than this on the screen, finer ones would hardly show.
COARSE_PIXELS = 2.0
# More pixels than any screen has.
WHOLE_SCREEN = 100_000
_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Source:
    """What near points are taken from.

    Attributes:
        run: whose.
        chunks: that its coarse points are divided into.
        coarse: edge of a coarse point, scene units.
        mode: of colours.
    """

    run: RunView
    chunks: Chunks
    coarse: float
    mode: str

    def divided_as(self, other: Source) -> bool:
        """Whether both have the same observations in the same chunks."""
        return self.run is other.run and self.chunks is other.chunks


@dataclass(eq=False)
class NearChunk:
    """A chunk as one client is shown it: its observations, their colours' source, its nodes."""

    rows: NDArray[np.int64]
    source: Source
    places: dict[int, NDArray[np.int64]]
    nodes: dict[int, viser.PointCloudHandle]
    size: float


class NearPoints:
    """Draws them for each client once its camera stands still; what was there stays until then.

    Args:
        server: whose clients look.
        frame: that they look in.
        budget: points near a camera at most.
        colors: of observations, (P, 3) uint8.
        on_change: told the client for which other points are drawn now.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        frame: PageFrame,
        *,
        budget: int,
        colors: Callable[[RunView, str, NDArray[np.int64]], NDArray[np.uint8]],
        on_change: Callable[[viser.ClientHandle], None],
    ) -> None:
        self._server, self._frame, self._budget = server, frame, budget
        self._colors, self._on_change = colors, on_change
        self._source: Source | None = None
        self._round, self._visible, self._scale = 0, True, 1.0
        self._drawn: dict[int, dict[int, NearChunk]] = {}
        # When each client's camera will have stood still for long enough.
        self._due: dict[int, float] = {}
        self._stopped = False
        self._asked = threading.Condition(threading.RLock())
        server.on_client_disconnect(self._forget)
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    def set_source(self, source: Source | None) -> None:
        """Take near points from another memory, or the same one grown; from None there are none."""
        with self._asked:
            before, self._source = self._source, source
            if before is not None and (source is None or source.chunks is not before.chunks):
                for drawn in self._drawn.values():
                    for chunk in drawn.values():
                        _remove(chunk)
                    drawn.clear()
            self._ask()

    def show(self, number: int) -> None:
        """Show the rounds up to ``number``."""
        with self._asked:
            self._round = number
            for chunk in self._chunks():
                for round, node in chunk.nodes.items():
                    node.visible = self._visible and round <= number

    def set_visible(self, visible: bool) -> None:
        """Show or hide all near points."""
        with self._asked:
            self._visible = visible
            self.show(self._round)
            self._ask()

    def set_size(self, scale: float) -> None:
        """Draw points ``scale`` times their spacing wide."""
        with self._asked:
            self._scale = scale
            for chunk in self._chunks():
                for node in chunk.nodes.values():
                    node.point_size = self._point_size(chunk.size)

    def moved(self, client: viser.ClientHandle) -> None:
        """A client's camera is elsewhere now."""
        with self._asked:
            if self._source is not None:
                self._due[client.client_id] = time.monotonic() + REST_SECONDS
                self._asked.notify()

    def drawn(self, client: viser.ClientHandle, number: int) -> tuple[int, set[int]]:
        """How many near points of the rounds up to ``number`` a client has, in which chunks."""
        with self._asked:
            chunks = self._drawn.get(client.client_id, {})
            near = [
                len(places)
                for chunk in chunks.values()
                for round, places in chunk.places.items()
                if round <= number
            ]
            return sum(near), set(chunks)

    def stop(self) -> None:
        """End for good."""
        with self._asked:
            self._stopped = True
            self._asked.notify()
        self._worker.join()

    def _chunks(self) -> list[NearChunk]:
        return [chunk for drawn in self._drawn.values() for chunk in drawn.values()]

    def _point_size(self, size: float) -> float:
        return self._frame.scale * size * self._scale

    def _ask(self) -> None:
        """Look anew at what each client sees, without delay."""
        if self._source is not None:
            self._due.update(dict.fromkeys(self._server.get_clients(), 0.0))
        self._asked.notify()

    def _forget(self, client: viser.ClientHandle) -> None:
        with self._asked:
            self._due.pop(client.client_id, None)
            self._drawn.pop(client.client_id, None)

    def _work(self) -> None:
        table: ChunkRows | None = None
        of: Source | None = None
        while True:
            client = None
            with self._asked:
                while not self._stopped and (source := self._source) is None:
                    self._asked.wait()
                if self._stopped or source is None:
                    return
                if table is not None and of is not None and source.divided_as(of):
                    client = self._next_client()
                    if client is None:
                        continue
            if client is None or table is None:
                # Before the first client is there, so that none waits for it.
                table, of = ChunkRows.of(source.run.memory, source.chunks), source
            elif self._draw(client, source, table):
                self._on_change(client)

    def _next_client(self) -> viser.ClientHandle | None:
        """A client whose camera stands still; None after having waited for one for a while."""
        wait = min(self._due.values(), default=np.inf) - time.monotonic()
        if wait > 0:
            self._asked.wait(wait if wait < np.inf else None)
            return None
        number = min(self._due, key=self._due.__getitem__)
        del self._due[number]
        return self._server.get_clients().get(number)

    def _draw(self, client: viser.ClientHandle, source: Source, table: ChunkRows) -> bool:
        """Draw what is near a client's camera, unless something else is asked for meanwhile.

        Returns:
            Whether anything has changed.
        """
        with self._asked:
            if self._source is not source or not self._visible:
                return False
            drawn = self._drawn.setdefault(client.client_id, {})
        camera = self._frame.client_camera(client, longest=WHOLE_SCREEN)
        reach = float(camera.K[0, 1, 1]) * source.coarse / COARSE_PIXELS
        local = source.run.memory.frame.seen_from(camera)
        wanted = table.near(local, reach=reach, budget=self._budget)
        new = {
            chunk: table.rows(chunk)
            for chunk in wanted
            if chunk not in drawn or drawn[chunk].source is not source
        }
        rgb = self._colors(source.run, source.mode, np.concatenate([_NONE, *new.values()]))
        for chunk, rows in new.items():
            with self._asked:
                if self._asked_for_else(client, source):
                    return True
                drawn[chunk] = self._placed(client, chunk, rows, rgb[: len(rows)], source)
            rgb = rgb[len(rows) :]
        with self._asked:
            gone = [chunk for chunk in drawn if chunk not in wanted]
            if not self._asked_for_else(client, source):
                for chunk in gone:
                    _remove(drawn.pop(chunk))
        return bool(new or gone)

    def _asked_for_else(self, client: viser.ClientHandle, source: Source) -> bool:
        """Whether the client has moved on or left, or other points are to be shown."""
        number = client.client_id
        return self._source is not source or number in self._due or number not in self._drawn

    def _placed(
        self,
        client: viser.ClientHandle,
        chunk: int,
        rows: NDArray[np.int64],
        rgb: NDArray[np.uint8],
        source: Source,
    ) -> NearChunk:
        """A chunk drawn for a client; points that it has already are not sent again."""
        before = self._drawn[client.client_id].get(chunk)
        if before is not None and np.array_equal(before.rows, rows):
            for round, node in before.nodes.items():
                colors = rgb[before.places[round]]
                if not np.array_equal(node.colors, colors):
                    node.colors = colors
            before.source = source
            return before
        memory = source.run.memory
        size = float(np.median(memory.columns.spacing[rows]))
        places = dict(groups(memory.views.round[memory.columns.view[rows]]))
        points = positions_on_page(memory, rows, self._frame)
        # A chunk is some hundred spacings wide, of which half precision keeps hundredths.
        around = np.median(points, axis=0)
        # Points and whether they are seen arrive together.
        with client.atomic():
            if before is not None:
                _remove(before)
            nodes = {
                round: add_points(
                    client.scene,
                    (chunk, round),
                    points[mine],
                    rgb[mine],
                    size=self._point_size(size),
                    visible=self._visible and round <= self._round,
                    around=around,
                )
                for round, mine in places.items()
            }
        return NearChunk(rows, source, places, nodes, size)


def _remove(chunk: NearChunk) -> None:
    for node in chunk.nodes.values():
        node.remove()
