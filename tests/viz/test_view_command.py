from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from browser import free_port
from command_line import arguments, refused
from PIL import Image

from gvtools.errors import OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.cli import main
from pipelines.commands import view
from pipelines.console import Console
from pipelines.viewing import serve
from pipelines.viewing.source import ViewSource
from viz.viewer.colors import MODES
from viz.viewer.render import picture_of
from viz.viewer.web import BUDGET, LOCAL, PORT

CAMERA = "frame-000004.color.png"


@contextmanager
def display(tmp_path):
    """An X server without a screen; skipped, with the reason, where there is none."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb (Debian: xvfb)")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1280x800x24", "-nolisten", "tcp"]
    with (tmp_path / "xvfb.log").open("wb") as log:
        server = subprocess.Popen(command, pass_fds=[write], stderr=log)
    os.close(write)
    try:
        with os.fdopen(read) as told:
            yield f":{told.readline().strip()}"
    finally:
        server.terminate()
        server.wait()


def test_the_parser_knows_what_the_viewers_know():
    args = arguments("view", "run")
    assert (args.host, args.port, args.max_points) == (LOCAL, PORT, BUDGET)
    assert LOCAL == "127.0.0.1"
    assert tuple(MODES) == get_args(view.ViewCommand.model_fields["color"].annotation)


def test_a_picture_needs_no_display(small_run, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    out = tmp_path / "shot.png"
    options = ("--screenshot", str(out), "--camera", CAMERA, "--round", "1")
    assert main(["view", str(small_run), *options]) == 0
    assert f"round 1 from {CAMERA}" in capsys.readouterr().out
    memory = SpatialMemory.load(small_run / "memory.npz")
    memory.forget(round=2)
    row = next(i for i in range(len(memory.views)) if memory.views[i].camera.names[0] == CAMERA)
    expected = picture_of(memory.project(memory.views[row].camera))
    np.testing.assert_array_equal(np.array(Image.open(out)), expected)


def test_bad_options_are_refused_in_one_line(small_run, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    words = ("view", small_run)
    shot = ("--screenshot", tmp_path / "x.png")
    assert "no such file or folder" in refused(capsys, "view", tmp_path / "absent", *shot)
    assert "such as 'frame-000000" in refused(capsys, *words, *shot, "--camera", "nobody")
    assert "rounds 0 to 2" in refused(capsys, *words, "--round", "3")
    assert "ends with .png" in refused(capsys, *words, "--screenshot", tmp_path / "x.jpg")
    assert "no display" in refused(capsys, *words, "--open3d")
    assert "--live" in refused(capsys, *words, "--live", *shot)
    assert "at most 65535" in refused(capsys, *words, "--port", "99999")
    # 192.0.2.1 is nobody's, by RFC 5737.
    assert "cannot listen" in refused(capsys, *words, "--host", "192.0.2.1")
    assert not (tmp_path / "x.png").exists()


@pytest.mark.slow
def test_the_open3d_window_shows_the_run_and_steps_through_it(small_run, tmp_path):
    code = f"""
from pathlib import Path
import numpy as np
from pipelines.viewing.source import ViewSource
from viz.viewer.window import Open3dViewer

said = []
viewer = Open3dViewer(ViewSource(Path({str(small_run)!r})).read(), say=said.append)
viewer.look_from(0)
def look():
    for _ in range(3):
        viewer.window.poll_events()
        viewer.window.update_renderer()
    return np.rint(255 * np.asarray(viewer.window.capture_screen_float_buffer(True))).astype("u1")
pictures = [look()]
viewer.step_round(-2)
pictures.append(look())
viewer.step_round(2)
viewer.next_mode()
pictures.append(look())
viewer.toggle_cameras()
pictures.append(look())
viewer.look_from(4)
viewer.window.destroy_window()
np.save({str(tmp_path / "pictures.npy")!r}, pictures)
print("\\n".join(said))
"""
    with display(tmp_path) as name:
        environment = {**os.environ, "DISPLAY": name, "LIBGL_ALWAYS_SOFTWARE": "1"}
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True,
            timeout=120, check=False,
        )  # fmt: skip
    if "GLFW" in done.stderr and done.returncode:
        pytest.skip("the X server has no OpenGL (Debian: libgl1-mesa-dri)")
    assert done.returncode == 0, done.stderr
    last, first, colored, bare = np.load(tmp_path / "pictures.npy").astype(int)
    covered = [(picture < 250).any(axis=2).mean() for picture in (first, last)]
    assert covered[1] > covered[0] > 0.05
    assert np.abs(colored - last).mean() > 3 and (bare != colored).any()
    lines = done.stdout.splitlines()
    assert lines[0].startswith("round 0 of 2") and "0 generated" in lines[0]
    assert lines[2].startswith("round 2 of 2") and "round: round that" in lines[2]


def test_the_live_viewer_is_there_as_long_as_the_run_is_at_work(
    small_run, tmp_path, capsys, monkeypatch
):
    pytest.importorskip("viser", reason="viser is not installed")
    begun: list[subprocess.Popen] = []

    class Noted(subprocess.Popen):
        def __init__(self, *words: Any, **options: Any) -> None:
            super().__init__(*words, **options)
            begun.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)
    port = free_port()
    later = tmp_path / "run"
    threading.Timer(0.3, shutil.copytree, (small_run, later)).start()

    def reached() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    with serve.live_viewer(later, Console(), "--port", str(port)):
        end = time.monotonic() + 60
        while not reached():
            assert time.monotonic() < end
            time.sleep(0.02)
        # Told by this process, whose progress bar it has to go around.
        said = ""
        while f"{later}: look at http://127.0.0.1:{port} (Ctrl-C ends)\n" not in said:
            assert time.monotonic() < end
            time.sleep(0.02)
            said += capsys.readouterr().out
        # It starts without what takes seconds to import.
        maps = Path(f"/proc/{begun[0].pid}/maps")
        loaded = maps.read_text() if maps.exists() else ""
        assert "numba" in loaded or not loaded
        assert not re.search(r"/(torch|matplotlib)/", loaded)
    assert not reached()


def test_a_run_that_fails_at_once_says_no_more_than_why(tmp_path, capfd):
    with pytest.raises(OptionError), serve.live_viewer(tmp_path / "run", Console()):
        # While the viewer is still starting.
        time.sleep(0.3)
        raise OptionError("no such project")
    said = capfd.readouterr()
    assert "Traceback" not in said.err and "KeyboardInterrupt" not in said.err


def test_a_round_that_came_while_the_viewer_started_is_shown(small_run, tmp_path, capsys):
    growing, later = tmp_path / "growing", tmp_path / "later"
    shutil.copytree(small_run, growing)
    (growing / "round_002").rename(later)
    source = ViewSource(growing)
    shown = source.read()
    later.rename(growing / "round_002")
    rounds: list[int] = []
    following = serve.Following(
        source, shown, lambda r: rounds.append(r.last_round), console=Console()
    )
    following.look()
    following.look()
    assert rounds == [2]
    assert capsys.readouterr().out == "round 2 is there\n"


@pytest.mark.parametrize("report", ['{"round": 2,', "[]", '{"round": 2, "views": []}'])
def test_a_report_that_cannot_be_read_does_not_end_the_viewer(small_run, tmp_path, capsys, report):
    growing, kept = tmp_path / "growing", tmp_path / "kept"
    shutil.copytree(small_run, growing)
    (growing / "round_002").rename(kept)
    source, rounds = ViewSource(growing), list[int]()
    following = serve.Following(
        source, source.read(), lambda run: rounds.append(run.last_round), console=Console()
    )
    (growing / "round_002").mkdir()
    (growing / "round_002" / "report.json").write_text(report)
    for _ in range(3):
        following.look()
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "round_002" in said
    shutil.rmtree(growing / "round_002")
    kept.rename(growing / "round_002")
    following.look()
    assert rounds == [2]
