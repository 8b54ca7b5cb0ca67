"""Bad input from the command line: one clear line, status 2, nothing lost."""

from __future__ import annotations

import io
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import refused
from tiny_scan import write_scan

import gvtools
from gvtools.errors import GvError
from pipelines import cli
from pipelines.cli import COMMANDS, build_parser, main
from pipelines.commands.weights import WeightsCommand

pytestmark = pytest.mark.usefixtures("unpainted")

RUN = ("--context", "first:2", "--targets", "range:2-5", "--views-per-round", "2", "--quiet")


@pytest.fixture
def scan(tmp_path):
    return write_scan(tmp_path / "scan")


def reconstruct(*arguments: object) -> tuple[object, ...]:
    return ("reconstruct", *arguments, "--refine", "0", "--set", "refine.poses=false", *RUN)


@pytest.mark.parametrize(
    "command", [*COMMANDS, *(f"weights {action}" for action in WeightsCommand.actions)]
)
def test_every_help_starts_with_two_examples(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert text.count(f"  gvtools {command}") >= 2
    # The examples are accepted by the parser itself.
    for line in text.splitlines():
        if line.startswith(f"  gvtools {command}"):
            build_parser().parse_args(line.split()[1:])


@pytest.mark.parametrize(("only", "more"), [("None", ""), ("''", "'numba', 'cv2', 'numpy',")])
def test_the_commands_start_without_heavy_imports(only, more):
    heavy = f"({more}'torch', 'open3d', 'pycolmap', 'matplotlib')"
    code = (
        f"import sys, pipelines.cli as c; c.build_parser(only={only});"
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def _empty(scan: Path) -> None:
    shutil.rmtree(scan)
    scan.mkdir()


def _torn_picture(scan: Path) -> None:
    path = scan / "frame-000003.color.png"
    path.write_bytes(path.read_bytes()[:200])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_empty, ("COLMAP", "transforms.json")),
        (_torn_picture, ("frame-000003.color.png",)),
    ],
)
def test_a_project_that_cannot_be_read(capsys, scan, tmp_path, spoil, words):
    spoil(scan)
    line = refused(capsys, *reconstruct(scan, "--out", tmp_path / "run"))
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--context", "all", "--targets", "first:2"), "--allow-overlap"),
        (("--voxle", "1"), "--voxle"),
        (("--set", "splat.depth_bnad=1"), "splat.depth_band"),
    ],
)
def test_options_that_cannot_be(capsys, scan, tmp_path, options, word):
    out = tmp_path / "run"
    assert word in refused(capsys, *reconstruct(scan, "--out", out), *options)
    assert not out.exists()


def test_a_rotation_orthonormal_to_4e_4_is_accepted(scan, tmp_path):
    path = scan / "frame-000001.pose.txt"
    pose = np.loadtxt(path)
    pose[:3, :3] *= 1 + 2e-4
    np.savetxt(path, pose)
    assert main([str(a) for a in reconstruct(scan, "--out", tmp_path / "run", "--dry-run")]) == 0


def test_a_debug_run_shows_where(scan, tmp_path):
    shutil.rmtree(scan)
    with pytest.raises(GvError):
        main([str(a) for a in reconstruct(scan, "--out", tmp_path / "run", "--debug")])


@pytest.mark.parametrize("option", ["--voxel=auto", "--voxel=none", "--max-side=none"])
def test_an_option_takes_the_word_for_no_value_of_its_setting(scan, tmp_path, option):
    out = tmp_path / "run"
    assert main([str(a) for a in reconstruct(scan, "--out", out, "--dry-run", option)]) == 0


def test_names_that_a_console_cannot_show_are_escaped(scan, tmp_path, monkeypatch):
    place = shutil.copytree(scan, tmp_path / "Küche")
    console = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", console)
    assert main(["check", str(place)]) == 0
    console.flush()
    assert b"K\\xfcche" in console.buffer.getvalue()


@pytest.mark.parametrize("before", ["", "from gvtools.colmap import pycolmap;"])
def test_a_termination_is_one_line_and_143(before):
    code = (
        "import os, signal, sys;"
        "from pipelines import cli;"
        "from pipelines.commands import data;"
        f"data.ListData.run = data.CheckCommand.run = lambda *_: exec("
        f"'{before}os.kill(os.getpid(), signal.SIGTERM)');"
        "sys.exit(cli.main(['check', '.']))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 143
    assert run.stderr.startswith("gvtools: terminated; ") and run.stderr.count("\n") == 1


@pytest.mark.parametrize(("name", "place"), [("pycolmap", "colmap"), ("open3d as o3d", "o3d")])
def test_what_is_set_up_at_its_import_is_imported_in_one_place(name, place):
    """pycolmap's handlers of signals; Open3D's threads."""
    root = Path(gvtools.__file__).parents[1]
    inside = re.compile(rf"^(    )*import {name}$", re.M)
    for package in ("gvtools", "pipelines", "viz"):
        for file in (root / package).rglob("*.py"):
            text = re.sub(
                r"^if TYPE_CHECKING:\n(    .*\n|\n)*", "", file.read_text("utf-8"), flags=re.M
            )
            assert file == root / "gvtools" / f"{place}.py" or not inside.search(text), file


def test_closed_streams_are_no_reason_to_fail(monkeypatch):
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    assert main(["completers"]) == 0
    assert main(["completers", "--json", "/"]) == 2


def test_a_termination_while_a_command_loads_is_told_too(monkeypatch, capsys):
    def terminated(name: str) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(cli, "import_module", terminated)
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        assert main(["check", "."]) == 143
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err.startswith("gvtools: terminated; ")
