"""The web viewer: a run in a browser, served to this machine alone unless it is told otherwise."""

from __future__ import annotations

import io
import ipaddress
import re
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from functools import partial
from typing import TYPE_CHECKING, Any
from unittest.mock import patch
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError, OptionError
from gvtools.optional import require
from viz.viewer.camera_path import CameraPath
from viz.viewer.colors import MODES, Legend
from viz.viewer.nodes import Backdrop, CameraNodes, PointNodes, add_surface, fly_to
from viz.viewer.panel import Panel, shown_pictures
from viz.viewer.run_view import MESH, POINTS, SPLATS, RunView, ShownCamera, detail
from viz.viewer.standpoint import FIELD_OF_VIEW, PageFrame, home

if TYPE_CHECKING:
    import viser

LOCAL, PORT = "127.0.0.1", 8080
# How long a page of splats may take on its way, seconds; websockets itself would cut it off at 10.
PATIENCE = 600
# Points of the whole run, 15 bytes each; with all colour modes looked at once, 30 MB.
BUDGET = 1_000_000
# Pages that this machine serves itself may read a run, also through a tunnel's port.
LOCAL_PAGE = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")


class WebViewer:
    """Serves one run.

    Positions are sent in the page's own frame, so that float32 keeps its digits and scenes of any
    scale fit its units.

    Args:
        port: the first one tried; where it is taken, the next free one is used.
        budget: points drawn at most; a larger run is thinned evenly in space.
        round: to begin with; None for the last.
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
        pages: dict[str, bytes] = {}
        self.server = make_server(host, port, run.title, pages=pages)
        self._points = PointNodes(self.server, self.frame)
        self.cameras = CameraNodes(self.server, self.frame, partial(self.select, clicked=True))
        self._mesh = (
            None if run.surface is None else add_surface(self.server, self.frame, run.surface)
        )
        self._backdrop = Backdrop(self.server, self.frame, pages)
        self._look = run.looks[0]
        self._panel = Panel(self, mode=mode)
        self.path = CameraPath(self.server, self.frame, run, saves=is_loopback(host))
        self.server.scene.set_up_direction(tuple(run.up()))
        self.server.scene.world_axes.visible = False
        # Where a page starts, and returns to.
        start = self.server.initial_camera
        start.position, start.look_at = home(run, self.frame)
        start.up, start.fov = run.up(), FIELD_OF_VIEW
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
            chosen = detail(run.memory, self.budget)
            self._backdrop.set_run(run)
            self._panel.set_run(run, chosen, go_to=go_to)
            self._points.set_points(run, chosen, self._colors(chosen.rows))
            self._panel.set_size(self._points.size)
            self.show_look(self._look)
            self.cameras.set_cameras(run)

    def set_note(self, text: str) -> None:
        """Something that the user should know of the run."""
        self._panel.set_note(text)

    def stop(self) -> None:
        """End the server."""
        self._backdrop.stop()
        self.cameras.stop()
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def _colors(self, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        colors = self.run.colors(self._panel.mode, rows)
        self._panel.set_legend(colors.legend)
        return colors.rgb

    def show_round(self, number: int) -> None:
        """Show the run as it was after a round."""
        with self._lock:
            with self.server.atomic():
                self._points.show(number)
                self.cameras.show(number)
            self._panel.set_counts(self.run, number, self._points.count(number))
            self._backdrop.set_state(self._look, number, self._panel.mode)

    def show_mode(self, mode: str) -> None:
        """Show the colours of a mode."""
        with self._lock:
            if mode in MODES:
                self._panel.set_legend(Legend("..."))
                self._points.recolor(self._colors(self._points.rows))
                self._backdrop.set_state(self._look, self._panel.round, mode)

    def show_look(self, look: str) -> None:
        """Show points, splats, the splatter's picture or a mesh."""
        with self._lock:
            self._look = look
            if look == SPLATS:
                try:
                    self._backdrop.prepare_page(self.run, self.budget)
                except GvError as error:
                    self._panel.set_note(f"no splats: {error}")
            self._points.set_visible(look == POINTS)
            if self._mesh is not None:
                self._mesh.visible = look == MESH
            self.show_round(self._panel.round)

    def set_size(self, scale: float) -> None:
        """Draw points so many spacings wide."""
        with self._lock:
            self._points.set_size(scale)

    def _follow(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda seen: self.cameras.moved(np.array(seen.position)))

    def select(
        self, shown: ShownCamera, client: viser.ClientHandle | None, *, clicked: bool = False
    ) -> None:
        """Show a camera and fly there, unless another one has been selected meanwhile."""
        with self._selecting:
            self._selected += 1
            number = self._selected
            if clicked:
                self._panel.select(shown)
            self.cameras.mark(shown)
            if client is not None:
                self._flights[client.client_id] = number
        # Photographs may take their time.
        pictures = shown_pictures(self.run, shown)
        with self._selecting:
            if number != self._selected:
                return
            self._panel.set_pictures(pictures)
            if client is not None:
                self.cameras.enter(self.frame.placement(shown.camera)[1])
        if client is not None:
            flight = client.client_id
            fly_to(
                client, shown.camera, self.frame, goes_on=lambda: self._flights[flight] == number
            )


def make_server(
    host: str, port: int, title: str, *, pages: Mapping[str, bytes]
) -> viser.ViserServer:
    """A server that refuses WebSockets of pages from elsewhere, with more pages by address."""
    require("viser", extra="web", purpose="the web viewer", instead="or use --open3d")
    import viser
    import websockets.asyncio.server as websockets
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    class Server(viser.ViserServer):
        """Never publishes itself, whatever a page asks for."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    # viser itself would look for a free port for ever.
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.create_server((host, 0), family=family):
            pass
    except OSError as error:
        raise OptionError(
            f"--host {host}: cannot listen there ({error.strerror or error}); expected an address "
            "of this machine"
        ) from None
    # viser has no option for the origins that it answers.
    plain = websockets.serve

    def serve(*places: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            origin, asked = (request.headers.get(key) for key in ("Origin", "Host"))
            page = pages.get(request.path)
            # For a page of its own a browser sends no Origin, but the name that was asked.
            itself = f"http://{asked}" if page is not None else None
            if not (may_read(origin, asked, host) and may_read(itself, asked, host)):
                return connection.respond(403, "a page from elsewhere may not read this run\n")
            if page is None:
                return process_request(connection, request)
            connection.close_timeout = PATIENCE
            kind = {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(page))}
            return Response(200, "OK", Headers({**kind, "Connection": "close"}), page)

        return plain(*places, process_request=answer, open_timeout=PATIENCE, **options)

    # viser prints where it listens; the command that starts it says more.
    with redirect_stdout(io.StringIO()), patch.object(websockets, "serve", serve):
        server = Server(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def may_read(origin: str | None, asked: str | None, host: str) -> bool:
    """Whether the page that sends a request may read a run.

    Browsers let any page open a WebSocket to any machine, and name the page in the Origin, None
    where no page asks. ``asked`` is the address as the request has it, ``host`` where the server
    listens.
    """
    if origin is None:
        return True
    # On loopback the name that was asked may be another's, who lets it lead to this machine.
    if is_loopback(host):
        return LOCAL_PAGE.fullmatch(origin) is not None
    return urlsplit(origin).netloc == asked


def is_loopback(host: str) -> bool:
    """Whether an address to listen at is reached from this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _own_address() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        try:
            sender.connect(("192.0.2.1", 9))  # of documentation; nothing is sent
        except OSError:
            return "localhost"
        return str(sender.getsockname()[0])


def address_of(host: str, port: int) -> str:
    """The address of a page, to type into a browser."""
    if host in ("0.0.0.0", "::"):  # every address of this machine: the one it reaches others by
        host = _own_address()
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
