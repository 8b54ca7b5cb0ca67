from __future__ import annotations

import base64
import http.client
import sys
from pathlib import Path

import pytest
from web_page import served

from pipelines.viewing.source import ViewSource
from viz.viewer.web import address_of, is_loopback, may_read


@pytest.fixture(scope="module")
def viewer(small_run):
    with served(ViewSource(small_run).read()) as found:
        yield found


@pytest.mark.parametrize(
    "path",
    ["/run.json", "/../../../../../../../etc/hostname", "/%2e%2e/%2e%2e/%2e%2e/etc/hostname",
     "/..%2f..%2f..%2f..%2fetc%2fhostname", "//etc/hostname", "/etc/hostname",
     "/..\\..\\..\\etc\\hostname"],
)  # fmt: skip
def test_no_file_is_served_but_the_page(viewer, path):
    def get(address):
        connection = http.client.HTTPConnection("127.0.0.1", viewer.server.get_port(), timeout=20)
        connection.request("GET", address)
        return connection.getresponse()

    assert get("/").status == 200
    assert get(path).status == 404


def test_nobody_else_is_served_and_nothing_is_shared(viewer):
    assert viewer.url.startswith("http://127.0.0.1:")
    # A page may ask for an address in the open; it gets none.
    assert viewer.server.request_share_url() is None
    if sys.platform != "linux":
        pytest.skip("listening addresses are read from /proc")
    listening = {
        line.split()[1]
        for table in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
        if line.split()[1].endswith(f":{viewer.server.get_port():04X}") and line.split()[3] == "0A"
    }
    assert {address.split(":")[0] for address in listening} == {"0100007F"}


@pytest.mark.parametrize(
    ("origin", "status"),
    [("http://127.0.0.1:{port}", 101), (None, 101), ("http://evil.example", 403), ("null", 403),
     ("http://localhost:9", 101), ("http://evil.example:{port}", 403),
     ("http://localhost.evil.example", 403)],
)  # fmt: skip
def test_no_page_from_elsewhere_can_read_the_run(viewer, origin, status):
    assert handshake(viewer, origin) == status


def handshake(viewer, origin) -> int:
    """The status with which a request for a WebSocket is answered."""
    connection = http.client.HTTPConnection("127.0.0.1", viewer.server.get_port(), timeout=20)
    headers = {
        "Upgrade": "websocket", "Connection": "Upgrade",
        "Sec-WebSocket-Key": base64.b64encode(bytes(16)).decode(), "Sec-WebSocket-Version": "13",
    }  # fmt: skip
    if origin is not None:
        headers["Origin"] = origin.format(port=viewer.server.get_port())
    connection.request("GET", "/", headers=headers)
    status = connection.getresponse().status
    connection.close()
    return status


def test_on_other_addresses_the_page_itself_alone_may_read():
    for host in ("0.0.0.0", "box"):
        assert may_read("http://box:8080", "box:8080", host) and may_read(None, "box:8080", host)
        for origin in ("http://evil.example", "http://box:9090", "null", "http://localhost:8080"):
            assert not may_read(origin, "box:8080", host)


def test_addresses_are_written_and_judged_as_they_are():
    assert address_of("127.0.0.1", 8080) == "http://127.0.0.1:8080"
    assert address_of("::1", 9401) == "http://[::1]:9401"
    assert all(map(is_loopback, ("127.0.0.1", "127.0.0.2", "::1", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.168.1.5", "box")))
