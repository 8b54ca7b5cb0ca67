"""The web viewer's server: viser's own, for this machine alone unless it is told otherwise."""

from __future__ import annotations

import io
import ipaddress
import re
import socket
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any
from unittest.mock import patch
from urllib.parse import urlsplit

from gvtools.errors import OptionError
from gvtools.optional import require

if TYPE_CHECKING:
    import viser

LOCAL = "127.0.0.1"
# Pages that this machine serves itself may read a run, also through a tunnel's port.
LOCAL_PAGE = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")


def make_server(host: str, port: int, title: str) -> viser.ViserServer:
    """A server that refuses WebSockets of pages from elsewhere.

    Args:
        host: address to listen at.
        port: the first one tried; where it is taken, the next free one is used.
        title: of the page.
    """
    require("viser", extra="web", purpose="the web viewer", instead="or use --open3d")
    import viser
    import websockets.asyncio.server as websockets

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
            if may_read(origin, asked, host):
                return process_request(connection, request)
            return connection.respond(403, "a page from elsewhere may not read this run\n")

        return plain(*places, process_request=answer, **options)

    # viser prints where it listens; the command that starts it says more.
    with redirect_stdout(io.StringIO()), patch.object(websockets, "serve", serve):
        server = Server(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def may_read(origin: str | None, asked: str | None, host: str) -> bool:
    """Whether the page that sends a request may read a run.

    Browsers let any page open a WebSocket to any machine, and name the page in the Origin.

    Args:
        origin: of the page; None where no page asks.
        asked: the address that was asked, as the request has it.
        host: where the server listens.
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


def address_of(host: str, port: int) -> str:
    """The address of a page, to type into a browser."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
