from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_line import refused

from gvtools.system_libraries import LIBRARIES, advice, missing_libraries
from pipelines import cli
from pipelines.options import Arguments

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def bare(monkeypatch):
    load = ctypes.CDLL

    def lacking(name: str, *words: Any, **options: Any) -> object:
        if name in ("libGL.so.1", "libusb-1.0.so.0"):
            raise OSError(f"{name}: cannot open shared object file: No such file or directory")
        return load(name, *words, **options)

    monkeypatch.setattr(ctypes, "CDLL", lacking)


def test_missing_libraries_are_found_by_loading_them(bare):
    missing = missing_libraries()
    assert {"libGL.so.1", "libusb-1.0.so.0"} <= set(missing)
    assert "libGL.so.1 libusb-1.0.so.0" in advice(("libGL.so.1", "libusb-1.0.so.0"))
    assert advice(("libGL.so.1", "libusb-1.0.so.0")).endswith("install -y libgl1 libusb-1.0-0")


@pytest.mark.parametrize(
    ("error", "told"),
    [(OSError("libGL.so.1: cannot open shared object file: No such file or directory"), True),
     (ImportError("libGL.so.1: cannot open shared object file"), True),
     (OSError("no space left on device"), False), (ValueError("libGL.so.1"), False)],
)  # fmt: skip
def test_a_command_names_the_libraries_that_it_lacks(bare, monkeypatch, capsys, error, told):
    class Lacking(Arguments):
        def run(self, console: object) -> None:
            raise error

    module = SimpleNamespace(LackingCommand=Lacking)
    monkeypatch.setitem(sys.modules, "lacking", module)
    status = cli.main(["lacking"], modules={"lacking": "lacking"})
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert status == (2 if told else 1)
    assert ("libGL.so.1 libusb" in said and "apt-get install -y" in said) == told


def test_make_and_the_program_know_the_same_list():
    done = subprocess.run(
        [sys.executable, "-S", "-E", ROOT / "gvtools/system_libraries.py"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    expected = [f"{name} {LIBRARIES[name]}" for name in missing_libraries()]
    assert done.stdout.split("\n")[:-1] == (expected or [""])


def test_version_needs_none_of_them(bare, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--version"])
    assert stop.value.code == 0


def test_refused_commands_stay_as_they_were(bare, capsys, tmp_path):
    assert "no such file" in refused(capsys, "view", tmp_path / "absent")
