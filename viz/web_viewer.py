"""The web viewer: a run in a browser, served to this machine alone unless it is told otherwise."""

from __future__ import annotations

import io
import socket
import threading
from contextlib import redirect_stdout
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from viz.point_colors import MODES, Legend, point_colors
from viz.run_view import RunView, ShownCamera
from viz.run_view_detail import detail
from viz.web_viewer_cameras import CameraNodes, fly_to, placement
from viz.web_viewer_panel import Panel
from viz.web_viewer_points import PointNodes
from viz.web_viewer_splats import SplatLook

if TYPE_CHECKING:
    import viser

LOCAL = "127.0.0.1"
PORT = 8080
# 15 bytes each; with all colour modes looked at once, 30 MB.
BUDGET = 1_000_000


class WebViewer:
    """Serves one run.

    Positions are sent relative to the memory's origin, so that float32 keeps its digits.

    Args:
        run: as it is now.
        host: address to listen at.
        port: the first one tried; where it is taken, the next free one is used.
        budget: points drawn at most.
        round: to begin with; None for the last.
        mode: colours to begin with, of viz.point_colors.MODES.

    Raises:
        OptionError: the web viewer's package is not installed, or the address is none of ours.
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
        self.server = _serve(host, port, run.title)
        self._points = PointNodes(self.server)
        self._cameras = CameraNodes(self.server, self._clicked)
        self._splats = SplatLook(self.server)
        self._panel = Panel(
            self.server,
            mode=mode,
            on_round=self._show_round,
            on_mode=self._show_mode,
            on_look=self._show_look,
            on_camera=self._select,
            on_size=self._points.set_size,
            on_kinds=self._cameras.set_kinds,
        )
        self.server.scene.set_up_direction(tuple(run.up()))
        self.server.scene.world_axes.visible = False
        self._set_home()
        self.server.on_client_connect(self._follow)
        self._show(run, go_to=run.last_round if round is None else round)

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def update(self, run: RunView) -> None:
        """Show a run as it is by now; whoever looks at the last round goes on to the new one."""
        with self._lock:
            last = self._panel.round >= self.run.last_round
            self._show(run, go_to=run.last_round if last else self._panel.round)

    def _show(self, run: RunView, *, go_to: int) -> None:
        with self._lock:
            self.run = run
            drawn = detail(run.memory, self.budget)
            self._splats.set_run(run)
            self._panel.set_run(run, drawn, go_to=go_to)
            self._points.set_points(run, drawn, self._colors(drawn.rows))
            self._panel.set_size(self._points.size)
            self._show_round(self._panel.round)
            self._cameras.set_cameras(run)

    def set_note(self, text: str) -> None:
        """Something that the user should know of the run."""
        self._panel.set_note(text)

    def stop(self) -> None:
        """End the server."""
        self._splats.stop()
        self._cameras.stop()
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def _colors(self, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        run = self.run
        colors = point_colors(
            run.memory, self._panel.mode, rows=rows, true_depth=run.recorded_depth
        )
        self._panel.set_legend(colors.legend)
        return colors.rgb

    def _show_round(self, number: int) -> None:
        with self._lock:
            with self.server.atomic():
                self._points.show(number)
                self._cameras.show(number)
            self._panel.set_counts(self.run, number, self._points.drawn(number))
            self._splats.set_state(number, self._panel.mode)

    def _show_mode(self, mode: str) -> None:
        with self._lock:
            if mode in MODES:
                self._panel.set_legend(Legend("..."))
                self._points.recolor(self._colors(self._points.rows))
                self._splats.set_state(self._panel.round, mode)

    def _show_look(self, splats: bool) -> None:
        with self._lock:
            self._points.set_visible(not splats)
            self._splats.set_on(splats)

    def _clicked(self, shown: ShownCamera, client: viser.ClientHandle | None) -> None:
        self._panel.select(shown)
        self._select(shown, client)

    def _select(self, shown: ShownCamera, client: viser.ClientHandle | None) -> None:
        self._cameras.mark(shown)
        self._panel.set_pictures(self.run, shown)
        if client is not None:
            self._cameras.enter(placement(shown.camera, self.run)[1])
            fly_to(client, shown.camera, self.run)

    def _follow(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda seen: self._cameras.moved(np.array(seen.position)))

    def _set_home(self) -> None:
        """Start, and return to, a place behind the first camera from which the scene is in view."""
        run = self.run
        if not run.cameras:
            return
        pose = run.cameras[0].camera.world_from_cam[0]
        depth = run.typical_depth
        center = pose[:3, 3] - run.memory.origin
        home = self.server.initial_camera
        home.position = center - 0.5 * depth * pose[:3, 2] + 0.25 * depth * run.up()
        home.look_at = center + depth * pose[:3, 2]
        home.up = run.up()


def _serve(host: str, port: int, title: str) -> viser.ViserServer:
    try:
        import viser
    except ImportError:
        raise OptionError(
            "the web viewer needs viser, which is not installed; pip install 'gvtools[web]', or "
            "use --open3d"
        ) from None

    class Server(viser.ViserServer):
        """Does not offer itself to the world, whatever a page asks for."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    # The server itself would look for a free port for ever.
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.create_server((host, 0), family=family):
            pass
    except OSError as error:
        raise OptionError(
            f"--host {host}: cannot listen there ({error.strerror or error}); expected an address "
            "of this machine"
        ) from None
    # It announces itself; the command that starts it says more.
    with redirect_stdout(io.StringIO()):
        server = Server(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server
