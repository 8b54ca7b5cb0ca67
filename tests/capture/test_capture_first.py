"""``gvtools reconstruct`` of an input without cameras offers to find them."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from command_line import arguments, refused
from PIL import Image

from gvtools.errors import OptionError, UnposedError
from pipelines.cli import main
from pipelines.commands import capture
from pipelines.commands.capture import open_or_capture
from pipelines.console import Console

# Source, project and masks of a capture.
Asked = tuple[Path, Path, Path | None]
pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.fixture
def captures(room: Path, monkeypatch: pytest.MonkeyPatch) -> list[Asked]:
    """What ``gvtools capture`` was asked for; it gives the room's own cameras here."""
    asked: list[Asked] = []

    def stand_in(source: Path, out: Path, **options: Any) -> None:
        asked.append((source, out, options.get("masks")))
        shutil.copytree(room, out)
        (out / "capture.json").write_text(json.dumps({"source": str(source.resolve())}))

    monkeypatch.setattr(capture, "capture", stand_in)
    return asked


def on_terminal(monkeypatch: pytest.MonkeyPatch, answer: str) -> list[str]:
    """A terminal with a user who gives one answer; returns what they are asked."""
    questions = []

    def read(question: str) -> str:
        questions.append(question)
        return answer

    for stream in (sys.stdin, sys.stdout):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setattr("builtins.input", read)
    return questions


def test_without_a_terminal_one_line_gives_the_command(room, tmp_path, capsys):
    photos = tmp_path / "my photos"
    shutil.copytree(room / "images", photos)
    out = tmp_path / "runs" / "x"
    line = refused(capsys, "reconstruct", photos, "--out", out)
    assert "10 pictures without cameras" in line
    assert f"gvtools capture '{photos}' --out {out}-project; or add --capture" in line
    assert "a run would find them first" in refused(
        capsys, "reconstruct", photos, "--out", out, "--dry-run", "--capture"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my photos"]
    nested = tmp_path / "nested"
    for part in ("a", "b"):
        (nested / part).mkdir(parents=True)
        Image.new("RGB", (8, 8)).save(nested / part / "1.png")
    assert "2 pictures without cameras" in refused(capsys, "reconstruct", nested, "--out", out)
    (tmp_path / "camera.bag").touch()
    assert "a recording without cameras" in refused(
        capsys, "reconstruct", tmp_path / "camera.bag", "--out", out
    )


def test_capture_comes_unasked_and_once(room: Path, captures: list[Asked], tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    args = arguments(
        "reconstruct", room / "images", "--out", tmp_path / "run", "--capture", "--masks", masks
    )
    for _ in range(2):
        scene, reading = open_or_capture(args, Console(quiet=True))
        assert len(scene) == 10
        assert reading == {"masks": str(masks)}
        assert scene.root == tmp_path / "run-project"
    assert captures == [(room / "images", tmp_path / "run-project", masks)]
    with pytest.raises(OptionError, match="--images: of a COLMAP project"):
        words = ("--out", tmp_path / "b", "--capture", "--images", masks)
        open_or_capture(arguments("reconstruct", room / "images", *words), Console(quiet=True))


@pytest.mark.parametrize(("answer", "calls"), [("y", 1), ("Yes ", 1), ("", 0), ("n", 0)])
def test_a_user_at_a_terminal_is_asked(answer, calls, room, captures, tmp_path, monkeypatch):
    questions = on_terminal(monkeypatch, answer)
    args = arguments("reconstruct", room / "images", "--out", tmp_path / "run")
    if calls:
        assert len(open_or_capture(args, Console())[0]) == 10
    else:
        with pytest.raises(UnposedError, match="10 pictures without cameras"):
            open_or_capture(args, Console())
    assert len(captures) == calls
    (question,) = questions
    assert "10 pictures without cameras. Capture now to" in question
    assert question.endswith("? [y/N] ")


@pytest.mark.slow
def test_photographs_alone_become_a_run(room, tmp_path):
    out = tmp_path / "run"
    options = ("--capture", "--refine", "0", "--rounds", "1", "--quiet")
    assert main(["reconstruct", str(room / "images"), "--out", str(out), *options]) == 0
    assert (out / "metrics.json").is_file()
    assert (tmp_path / "run-project/capture.json").is_file()
