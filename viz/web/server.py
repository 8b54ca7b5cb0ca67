"""The web viewer's server: viser's own, for this machine alone unless it is told otherwise."""

from __future__ import annotations

import io
import ipaddress
import re
import socket
from contextlib import redirect_stdout
from functools import partial
from typing import TYPE_CHECKING
from unittest.mock import patch

from gvtools.errors import OptionError

if TYPE_CHECKING:
    import viser

LOCAL = "127.0.0.1"
# Browsers let any page open a WebSocket to this machine and name that page in the Origin. Pages
# that this machine serves itself may read a run, also through a tunnel's port; others may not.
LOCAL_PAGE = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")


def make_server(host: str, port: int, title: str) -> viser.ViserServer:
    """A server; on a loopback address it refuses WebSockets of pages from elsewhere.

    Args:
        host: address to listen at.
        port: the first one tried; where it is taken, the next free one is used.
        title: of the page.

    Raises:
        OptionError: viser is not installed, or the address is not one of this machine.
    """
    try:
        import viser
        import websockets.asyncio.server as websockets
    except ImportError:
        raise OptionError(
            "the web viewer needs viser, which is not installed; pip install 'gvtools[web]', or "
            "use --open3d"
        ) from None

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
    origins = [None, LOCAL_PAGE] if is_loopback(host) else None
    serve = partial(websockets.serve, origins=origins)
    # viser prints where it listens; the command that starts it says more.
    with redirect_stdout(io.StringIO()), patch.object(websockets, "serve", serve):
        server = Server(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def is_loopback(host: str) -> bool:
    """Whether an address to listen at is reached from this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def address_of(host: str, port: int) -> str:
    """The address of a page, to type into a browser."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
