"""The web viewer's server: to whom it answers, and what its page is called.

A browser lets any page open a WebSocket to any address, this machine's own included, so whoever
looks at the run could be read out by another page open beside it. A browser says of which page a
connection is (its Origin); that has to be the viewer's own.
"""

from __future__ import annotations

import gzip
import io
import ipaddress
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from html import escape
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from gvtools.errors import OptionError

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

LOCAL = "127.0.0.1"
PAGE = ("/", "/index.html")
TITLE = b"<title>Viser</title>"
# Servers are made one after the other, as each is given its answers while it is made.
_making = threading.Lock()


def make_server(host: str, port: int, title: str) -> viser.ViserServer:
    """A server that answers its own page alone.

    Args:
        host: address to listen at.
        port: the first one tried; where it is taken, the next free one is used.
        title: of the page.

    Raises:
        OptionError: the web viewer's package is not installed or another one than expected, or
            the address is none of ours.
    """
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
    with redirect_stdout(io.StringIO()), _guarding(host, title) as guarded:
        server = Server(host=host, port=port, label=title, verbose=False)
    if not guarded:
        server.stop()
        raise OptionError(
            f"viser {viser.__version__} does not let foreign pages be refused; expected the "
            "version that 'gvtools[web]' asks for; pip install 'gvtools[web]'"
        )
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def is_loopback(host: str) -> bool:
    """Whether an address to listen at is reached from this machine alone."""
    address = _address(host)
    return host == "localhost" if address is None else address.is_loopback


def address_of(host: str, port: int) -> str:
    """The address of a page, to type into a browser."""
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def is_own_page(origin: str | None, asked: str | None, host: str) -> bool:
    """Whether a request comes from the server's own page, or from no page at all.

    A foreign page can give this machine's address a name of its own and so look like the server's
    own page; names that are not the server's are therefore refused.

    Args:
        origin: what the request says of its page; None where no page made it.
        asked: the host and port that it asked for.
        host: the address that the server listens at.
    """
    if origin is None:
        return True
    try:
        parts = urlsplit(origin)
        name = parts.hostname
    except ValueError:
        return False
    if parts.scheme not in ("http", "https") or name is None or parts.netloc != asked:
        return False
    known = {"localhost", host.lower(), socket.gethostname().lower()}
    return _address(name) is not None or name in known


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


@contextmanager
def _guarding(host: str, title: str) -> Iterator[list[bool]]:
    """Gives a list that is filled when a server that is made within the block is guarded.

    viser opens its port without a place to say whom to answer; it is put in where it opens it.
    """
    import websockets.asyncio.server as websockets

    serve = websockets.serve
    guarded: list[bool] = []

    def guarded_serve(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        guarded.append(True)
        answer = _answering(process_request, host, title)
        return serve(*args, process_request=answer, **options)

    with _making:
        setattr(websockets, "serve", guarded_serve)  # noqa: B010 (a type is not assigned to)
        try:
            yield guarded
        finally:
            setattr(websockets, "serve", serve)  # noqa: B010


def _answering(
    usual: Callable[..., Any], host: str, title: str
) -> Callable[[ServerConnection, Request], Response | None]:
    named: dict[bytes, bytes] = {}

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        headers = request.headers
        if not is_own_page(headers.get("Origin"), headers.get("Host"), host):
            return connection.respond(HTTPStatus.FORBIDDEN, "another page's request\n")
        response: Response | None = usual(connection, request)
        if response is not None and request.path.partition("?")[0] in PAGE and response.body:
            body = bytes(response.body)
            if body not in named:
                named[body] = _titled(body, title)
            response.body = named[body]
            # Setting a header adds it.
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        return response

    return answer


def _titled(body: bytes, title: str) -> bytes:
    """A page, compressed or not, under another title."""
    wanted = f"<title>{escape(title)} - gvtools</title>".encode()
    if body.startswith(b"\x1f\x8b"):
        return gzip.compress(gzip.decompress(body).replace(TITLE, wanted, 1), 1)
    return body.replace(TITLE, wanted, 1)
