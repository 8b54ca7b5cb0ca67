"""Weights from a server on loopback that cuts connections and lies, and from a folder."""

from __future__ import annotations

import hashlib
import threading
from collections import Counter
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import refused

from gvtools.errors import CheckpointError, OptionError, ProjectError
from pipelines import published
from pipelines.cli import main
from pipelines.published import MODELS, Published, fetch


def content(seed: int, size: int = 300_000) -> bytes:
    return np.random.default_rng(seed).bytes(size)


FILES = {"checkpoints/da3_level1.pt": content(0), "a/model.safetensors": content(1)}
OLD = content(2)


def known(place: str, **more: Any) -> Published:
    sha256 = hashlib.sha256(FILES[place]).hexdigest()
    values = {"sha256": sha256, "size": len(FILES[place]), "revision": "f00d", **more}
    return Published(place, "owner/name", place.split("/")[-1], **values)


class Server(ThreadingHTTPServer):
    """Serves ``FILES`` by their places, and as the hub does; ``lie`` changes an answer."""

    lie = ""
    cut = 0  # bytes that a connection brings at most; 0: all
    ranges: list[str]
    requests: Counter[str]


class Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        server, path = self.server, self.path.removeprefix("/mirror/")
        server.requests[path] += 1
        if path.startswith("hub/"):
            assert path.startswith("hub/owner/name/resolve/f00d/"), path
            path = next(place for place in FILES if place.endswith(path.split("/")[-1]))
        if path not in FILES or server.lie == "absent":
            return self.answer(404, b"")
        if server.lie == "busy" and server.requests[path] < 3:
            return self.answer(503, b"")
        data, start = FILES[path], 0
        data = OLD if server.lie == "older" else data
        data = data[::-1] if server.lie == "hash" else data
        data = data[:-7] if server.lie == "short" else data
        asked, tag = self.headers.get("Range", ""), hashlib.sha256(data).hexdigest()[:8]
        fresh = self.headers.get("If-Range", tag) == tag
        if asked and fresh and server.lie != "no ranges":
            server.ranges.append(asked)
            start = int(asked.removeprefix("bytes=").rstrip("-"))
        span = f"bytes {start + (server.lie == 'range')}-{len(data) - 1}/{len(data)}"
        headers = {"ETag": tag} | ({"Content-Range": span} if start else {})
        return self.answer(206 if start else 200, data[start:], headers)

    def answer(self, status: int, body: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        if self.server.lie != "no length":
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: self.server.cut or None])
        self.close_connection = True

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setattr(published, "WAIT", 0.0)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with Server(("127.0.0.1", 0), Handler) as server:
        server.ranges, server.requests = [], Counter()
        threading.Thread(target=server.serve_forever, args=[0.01], daemon=True).start()
        yield server
        server.shutdown()


def address(server: Server) -> str:
    return f"http://127.0.0.1:{server.server_port}/mirror"


def held(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*") if path.is_file()
    }  # fmt: skip


ALL = [known(place) for place in FILES]


@pytest.mark.parametrize("kind", ["mirror", "hub", "folder"])
def test_all_files_arrive_under_their_names(server, tmp_path, kind):
    source = address(server)
    if kind == "hub":
        source += "/hub/{repo}/resolve/{revision}/{path}"
    if kind == "folder":
        fetch(ALL, tmp_path / "first", source=source)
        source = str(tmp_path / "first")
    steps: list[tuple[int, int]] = []
    said: list[str] = []
    fetch(ALL, tmp_path / "to", source=source, say=said.append, progress=lambda *s: steps.append(s))
    assert held(tmp_path / "to") == FILES
    assert steps[-1] == (600_000, 600_000) and steps == sorted(steps)
    assert said == [f"{place}: fetched" for place in FILES]
    fetch(ALL, tmp_path / "to", source="http://127.0.0.1:9/nothing", say=said.append)
    assert said[2:] == [f"{place}: is there already" for place in FILES]


@pytest.mark.parametrize(("lie", "ranges"), [("", 10), ("busy", 10), ("no ranges", 0)])
def test_a_connection_that_is_cut_is_continued(server, tmp_path, lie, ranges):
    server.lie, server.cut = lie, 60_000
    if lie == "no ranges":
        with pytest.raises(CheckpointError, match=r"60,000 of 300,000 bytes are kept"):
            fetch(ALL, tmp_path, source=address(server))
        assert not (tmp_path / ALL[0].place).exists()
        server.lie = ""
        fetch(ALL, tmp_path, source=address(server))
        assert server.ranges[0] == "bytes=60000-"
    else:
        fetch(ALL, tmp_path, source=address(server))
        assert server.ranges[:2] == ["bytes=60000-", "bytes=120000-"]
    assert held(tmp_path) == FILES


def test_a_file_that_changed_meanwhile_is_not_continued(server, tmp_path, monkeypatch):
    """Nothing is known of its hash, but the server calls it another version."""
    file = known(ALL[0].place, sha256="", revision="main")
    part = tmp_path / "checkpoints" / ".da3_level1.pt.part"
    part.parent.mkdir()
    for version in ("another", None):
        part.write_bytes(OLD[:1000])
        if version:
            part.with_name(part.name + ".etag").write_text(version)
        said: list[str] = []
        fetch([file], tmp_path, source=address(server), say=said.append)
        assert held(tmp_path) == {file.place: FILES[file.place]}
        assert ALL[0].sha256 in said[0] and "not known: its revision, its sha256" in said[0]
        (tmp_path / file.place).unlink()
    assert server.ranges == []


@pytest.mark.parametrize("size", [300_000, 300_001])
def test_a_part_that_is_whole_or_too_long(server, tmp_path, size):
    part = tmp_path / "checkpoints" / ".da3_level1.pt.part"
    part.parent.mkdir()
    part.write_bytes((FILES[ALL[0].place] + b"x")[:size])
    fetch(ALL[:1], tmp_path, source=address(server))
    assert held(tmp_path) == {ALL[0].place: FILES[ALL[0].place]}


OLDER = {hashlib.sha256(OLD).hexdigest()[:8]: "of another camera convention"}
LIES = {
    "short": "has 299,993 bytes; expected 300,000; another revision",
    "hash": r"is of sha256 \w{16}\.\.\.; expected \w{16}\.\.\.; it was not kept",
    "older": r"is an older revision \(of another camera convention\); it was not kept",
    "no length": "status 200 without the bytes",
    "range": "status 206 without the bytes",
    "absent": "HTTP Error 404",
}


@pytest.mark.parametrize("lie", LIES)
def test_what_a_server_lies_about_is_refused_and_not_kept(server, tmp_path, lie):
    file = replace(ALL[0], older=OLDER)
    server.lie = lie
    if lie == "range":
        part = tmp_path / "checkpoints" / ".da3_level1.pt.part"
        part.parent.mkdir()
        part.write_bytes(FILES[file.place][:1000])
    with pytest.raises(CheckpointError, match=LIES[lie]):
        fetch([file], tmp_path, source=address(server))
    assert not (tmp_path / file.place).exists()
    if lie != "range":
        assert held(tmp_path) == {}
    server.lie = ""
    fetch([file], tmp_path, source=address(server))
    assert held(tmp_path) == {file.place: FILES[file.place]}


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        ("file:///etc", OptionError, "expected https://, http:// or a folder"),
        ("https://", OptionError, "--from https://; expected https://, http:// or a folder"),
        ("http://127.0.0.1:9/{nothing}", OptionError, r"\{revision\} and \{path\} may stand"),
        ("/nowhere", CheckpointError, "no /nowhere/checkpoints/da3_level1.pt; expected the folder"),
        ("http://127.0.0.1:9", CheckpointError, "refused.*0 of 300,000 bytes are kept"),
    ],
)
def test_a_source_that_is_none(server, tmp_path, source, error, message):
    with pytest.raises(error, match=message):
        fetch(ALL, tmp_path / "to", source=source)
    assert held(tmp_path) == {} and (error is not OptionError or not (tmp_path / "to").exists())


def test_free_space_is_looked_at_first(server, tmp_path):
    with pytest.raises(ProjectError, match=r"1000000\.0 GB are needed"):
        fetch([replace(ALL[0], size=10**15)], tmp_path, source=address(server))
    assert not server.requests


def test_the_command(server, tmp_path, monkeypatch, capsys):
    files = (*ALL, known("checkpoints/da3_level1.pt", optional=True))
    monkeypatch.setitem(MODELS, "gld", (replace(files[0], revision="main"), files[1]))
    words = ("weights", "fetch", "gld", "--to", str(tmp_path), "--from", address(server))
    assert main(list(words)) == 0
    text = capsys.readouterr().out
    assert "gld: 2 files, 600 kB; licence Apache-2.0" in text
    assert "da3_level1.pt: fetched; not known: its revision" in text
    assert f"next: gvtools weights check {tmp_path}" in text
    (tmp_path / ALL[0].place).write_bytes(OLD)
    assert "remove it and fetch again" in refused(capsys, *words)
