"""``gvtools data shards`` and ``verify`` as a user meets them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_scan import write_scan

from gvtools.scenes.shards import open_shards
from pipelines.cli import main


def data(*arguments: object) -> int:
    return main(["data", *map(str, arguments)])


@pytest.fixture(scope="module")
def download(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("download")
    for name in ("chess/seq-01", "chess/seq-02", "fire/seq-01"):
        write_scan(root / name, views=4)
    return root


def test_a_data_set_is_converted_kept_and_verified(download, tmp_path, capsys):
    out = tmp_path / "shards"
    start = ("shards", "7-Scenes", "--root", download, "--out", out, "--size", 0.05)
    assert data(*start) == 0
    said = capsys.readouterr().out.splitlines()
    count = len(said) - 1
    assert said[-1].startswith(f"{out}: {count} shards of 3 scenes, 12 views, 12 with depth")
    assert data(*start) == 0
    again = capsys.readouterr().out.splitlines()
    assert [line.endswith("(complete before)") for line in again] == [True] * count + [False]
    assert data("verify", out) == 0
    assert "all as their checksums say" in capsys.readouterr().out
    assert open_shards(out).data_set == "7scenes"


def test_some_scenes_reduced(download, tmp_path):
    wanted = ("--scenes", "fire/seq-01", "chess/seq-02", "--max-side", 64, "--quiet")
    assert data("shards", "7-Scenes", "--root", download, "--out", tmp_path, *wanted) == 0
    opened = open_shards(tmp_path)
    assert opened.names == ("chess/seq-02", "fire/seq-01")
    assert opened.read("fire/seq-01").views[0].load().rgb.shape == (48, 64, 3)


def test_a_project_is_converted_and_what_is_damaged_warned_of(tmp_path, capsys):
    folder = write_scan(tmp_path / "kitchen", views=3)
    (folder / "frame-000001.color.png").write_bytes(b"\x89PNG")
    assert data("shards", folder, "--out", tmp_path / "shards") == 0
    found = capsys.readouterr()
    assert "1 scenes, 2 views" in found.out
    (line,) = found.err.splitlines()
    assert line.startswith("warning: left out: ") and "frame-000001.color.png" in line


def test_damaged_shards_are_lines_with_status_2(download, tmp_path, capsys):
    start = ("shards", "7-Scenes", "--root", download, "--out", tmp_path, "--size", 0.05, "--quiet")
    assert data(*start) == 0
    for name in ("shard-000000.tar", "shard-000001.tar"):
        content = np.fromfile(tmp_path / name, np.uint8)
        content[700] ^= 255
        content.tofile(tmp_path / name)
    assert data("verify", tmp_path) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and all("damaged" in line for line in lines)
    assert lines[-1].startswith("gvtools: 2 of ")
    assert data(*start) == 0 and data("verify", tmp_path) == 0


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("shards", "7-Scense", "--root", "ROOT", "--out", "OUT"), "did you mean '7scenes'?"),
        (("shards", "spec:7-Scenes", "--out", "OUT"), "spec:7-Scenes: no root; give the folder"),
        (
            ("shards", "7-Scenes", "--root", "ROOT", "--out", "OUT", "--scenes", "chess/seq-03"),
            "did you mean 'chess/seq-02'?",
        ),
        (("shards", "ROOT/none", "--out", "OUT"), "no such folder"),
        (("shards", "ROOT/fire/seq-01", "--out", "OUT", "--max-side", "20"), "at least 64"),
        (("shards", "ROOT/fire/seq-01", "--out", "OUT", "--size", "0"), "more than 0"),
        (("verify", "ROOT"), "no index.json; expected complete shards"),
    ],
)
def test_wrong_input_is_one_line(arguments, complaint, download, tmp_path, capsys):
    places = {"ROOT": str(download), "OUT": str(tmp_path / "out")}
    words = [
        next((word.replace(k, v) for k, v in places.items() if k in word), word)
        for word in arguments
    ]
    assert data(*words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("gvtools: ") and complaint in line
