"""The web viewer: a run in a browser, served to this machine alone unless it is told otherwise."""

from __future__ import annotations

import io
import threading
from contextlib import redirect_stdout
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError
from viz.run_view.detail import detail
from viz.run_view.from_outside import FIELD_OF_VIEW
from viz.run_view.point_colors import MODES, Legend
from viz.run_view.view import MESH, POINTS, RENDERED, SPLATS, RunView, ShownCamera
from viz.web.camera_path import CameraPath
from viz.web.cameras import CameraNodes, fly_to
from viz.web.frame import PageFrame, home
from viz.web.gaussians import GaussianNodes, add_surface
from viz.web.panel import Panel
from viz.web.pictures import shown_pictures
from viz.web.points import PointNodes
from viz.web.rendered import RenderedLook
from viz.web.server import LOCAL, address_of, is_loopback, make_server

if TYPE_CHECKING:
    import viser

PORT = 8080
# Of the whole run, 15 bytes each; with all colour modes looked at once, 30 MB.
BUDGET = 1_000_000


class WebViewer:
    """Serves one run.

    Positions are sent in the page's own frame, so that float32 keeps its digits and scenes of any
    scale fit its units.

    Args:
        run: as it is now.
        host: address to listen at.
        port: the first one tried; where it is taken, the next free one is used.
        budget: points drawn at most; a larger run is thinned evenly in space.
        round: to begin with; None for the last.
        mode: colours to begin with, of viz.run_view.point_colors.MODES.
    """

    def __init__(
        self,
        run: RunView,
        *,
        host: str = LOCAL,
        port: int = PORT,
        budget: int = BUDGET,
        round: int | None = None,
        mode: str = "color",
    ) -> None:
        self.run = run
        self.budget = budget
        # Callbacks come from several threads.
        self._lock = threading.RLock()
        # Of the cameras selected so far the last, over all and of each client.
        self._selecting = threading.Lock()
        self._selected = 0
        self._flights: dict[int, int] = {}
        self.frame = PageFrame.of(run)
        self.server = make_server(host, port, run.title)
        self._points = PointNodes(self.server, self.frame)
        self._cameras = CameraNodes(self.server, self.frame, self._clicked)
        self._gaussians = GaussianNodes(self.server, self.frame)
        self._mesh = (
            None if run.surface is None else add_surface(self.server, self.frame, run.surface)
        )
        self._rendered = RenderedLook(self.server, self.frame)
        self._look = run.looks[0]
        self._panel = Panel(
            self.server,
            mode=mode,
            looks=run.looks,
            on_round=self._show_round,
            on_mode=self._show_mode,
            on_look=self._show_look,
            on_camera=self._select,
            on_size=self._set_size,
            on_kinds=self._cameras.set_kinds,
        )
        self.path = CameraPath(self.server, self.frame, run, saves=is_loopback(host))
        self.server.scene.set_up_direction(tuple(run.up()))
        self.server.scene.world_axes.visible = False
        self._set_home()
        self.server.on_client_connect(self._follow)
        self._show(run, go_to=run.last_round if round is None else round)

    @property
    def url(self) -> str:
        """Where the page is."""
        return address_of(self.server.get_host(), self.server.get_port())

    def update(self, run: RunView) -> None:
        """Show a run as it is by now; whoever looks at the last round goes on to the new one."""
        with self._lock:
            last = self._panel.round >= self.run.last_round
            self._show(run, go_to=run.last_round if last else self._panel.round)

    def _show(self, run: RunView, *, go_to: int) -> None:
        with self._lock:
            self.run = run
            drawn = detail(run.memory, self.budget)
            self._rendered.set_run(run)
            self._panel.set_run(run, drawn, go_to=go_to)
            self._points.set_points(run, drawn, self._colors(drawn.rows))
            self._panel.set_size(self._points.size)
            self._gaussians.clear()
            self._show_look(self._look)
            self._show_round(self._panel.round)
            self._cameras.set_cameras(run)

    def set_note(self, text: str) -> None:
        """Something that the user should know of the run."""
        self._panel.set_note(text)

    def stop(self) -> None:
        """End the server."""
        self._rendered.stop()
        self._cameras.stop()
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def _colors(self, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        colors = self.run.colors(self._panel.mode, rows)
        self._panel.set_legend(colors.legend)
        return colors.rgb

    def _show_round(self, number: int) -> None:
        with self._lock:
            with self.server.atomic():
                self._points.show(number)
                self._gaussians.show(number)
                self._cameras.show(number)
            self._panel.set_counts(self.run, number, self._points.drawn(number))
            self._rendered.set_state(number, self._panel.mode)

    def _show_mode(self, mode: str) -> None:
        with self._lock:
            if mode in MODES:
                self._panel.set_legend(Legend("..."))
                self._points.recolor(self._colors(self._points.rows))
                self._rendered.set_state(self._panel.round, mode)

    def _show_look(self, look: str) -> None:
        with self._lock:
            self._look = look
            if look == SPLATS and not self._gaussians and self.run.gaussians_of is not None:
                try:
                    self._gaussians.set_gaussians(self.run.gaussians_of(self.budget))
                except GvError as error:
                    self._panel.set_note(f"no splats: {error}")
            self._points.set_visible(look == POINTS)
            self._gaussians.set_visible(look == SPLATS)
            self._rendered.set_on(look == RENDERED)
            if self._mesh is not None:
                self._mesh.visible = look == MESH

    def _set_size(self, scale: float) -> None:
        with self._lock:
            self._points.set_size(scale)

    def _clicked(self, shown: ShownCamera, client: viser.ClientHandle | None) -> None:
        self._select(shown, client, clicked=True)

    def _select(
        self, shown: ShownCamera, client: viser.ClientHandle | None, *, clicked: bool = False
    ) -> None:
        """Show a camera and fly there, unless another one has been selected meanwhile."""
        with self._selecting:
            self._selected += 1
            number = self._selected
            if clicked:
                self._panel.select(shown)
            self._cameras.mark(shown)
            if client is not None:
                self._flights[client.client_id] = number
        # Photographs may take their time.
        pictures = shown_pictures(self.run, shown)
        with self._selecting:
            if number != self._selected:
                return
            self._panel.set_pictures(pictures)
            if client is not None:
                self._cameras.enter(self.frame.placement(shown.camera)[1])
        if client is not None:
            flight = client.client_id
            fly_to(
                client,
                shown.camera,
                self.frame,
                goes_on=lambda: self._flights[flight] == number,
            )

    def _follow(self, client: viser.ClientHandle) -> None:
        def moved(seen: viser.CameraHandle) -> None:
            self._cameras.moved(np.array(seen.position))

        client.camera.on_update(moved)

    def _set_home(self) -> None:
        """Where a page starts, and returns to."""
        home_view = self.server.initial_camera
        home_view.position, home_view.look_at = home(self.run, self.frame)
        home_view.up = self.run.up()
        home_view.fov = FIELD_OF_VIEW
