"""Viewers at work: a run on a web page, also while it grows; a page beside a run; rerun's own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

from gvtools.errors import GvError, OptionError, ProjectError
from pipelines.console import Console
from pipelines.viewing.source import ViewSource
from viz.viewer.run_view import RunView

if TYPE_CHECKING:
    from pipelines.commands.view import ViewCommand

POLL_SECONDS = 1.0
RECORDING = ".rrd"
# The run that a viewer belongs to ends it; a terminal's Ctrl-C is not for it.
CHILD = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); import sys; "
    "from pipelines.cli import main; sys.exit(main())"
)


def serve(source: ViewSource, args: ViewCommand, console: Console) -> None:
    """Serve a run's web page until an interrupt.

    ``--live``: wait for the first round, and show new ones as they come.
    """
    from viz.viewer.web import WebViewer, is_loopback

    if args.live and not source.rounds():
        console.line(f"{source.path}: waiting for its first round")
        while not source.rounds():
            time.sleep(POLL_SECONDS)
    shown, number = read_round(source, args.round)
    viewer = WebViewer(
        shown, host=args.host, port=args.port, budget=args.max_points, round=number, mode=args.color
    )
    try:
        console.line(f"{source.path}: look at {viewer.url} (Ctrl-C ends)")
        if not is_loopback(args.host):
            console.warn(f"--host {args.host}: whoever reaches this machine can see the run")
        if lacking := source.lacking():
            console.line(lacking)
            viewer.set_note(lacking)
        following = Following(source, shown, viewer.update, console=console)
        while True:
            time.sleep(POLL_SECONDS)
            if args.live:
                following.look()
    finally:
        viewer.stop()


def read_round(source: ViewSource, round: int | None) -> tuple[RunView, int]:
    """A run, and the number of the round to begin with; None takes the last."""
    shown = source.read()
    if not len(shown.memory):
        raise OptionError(f"{source.path}: an empty memory; expected one that views were fused in")
    number = shown.last_round if round is None else round
    if not 0 <= number <= shown.last_round:
        raise OptionError(f"--round {number}: the run has rounds 0 to {shown.last_round}")
    return shown, number


class Following:
    """A viewer that goes along with a run that grows.

    The console is told of new rounds, and once of each problem.
    """

    def __init__(
        self,
        source: ViewSource,
        shown: RunView,
        update: Callable[[RunView], None],
        *,
        console: Console,
    ) -> None:
        self._source, self._update, self._console = source, update, console
        self._rounds = len(shown.reports)
        self._problem = ""

    def look(self) -> None:
        """Show the rounds that have come since; what cannot be read yet is tried again."""
        try:
            if self._source.rounds() == self._rounds:
                return
            shown = self._source.read()
        except GvError as error:
            if str(error) != self._problem:
                self._console.warn(str(error))
            self._problem = str(error)
            return
        self._problem = ""
        self._rounds = len(shown.reports)
        self._update(shown)
        self._console.line(f"round {shown.last_round} is there")


@contextmanager
def live_viewer(out: Path, console: Console, *options: str) -> Iterator[None]:
    """A web viewer of the run in ``out``, in a process of its own, as long as the block lasts.

    It only reads the folder. On a terminal it stays when the block has ended well, until Ctrl-C.
    ``options`` are more words of ``gvtools view``.
    """
    command = [sys.executable, "-c", CHILD, "view", str(out), "--live", *options]
    command += ["--quiet"] if console.quiet else []
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    # What it says has to go around a progress bar of this process.
    teller = threading.Thread(target=_relay, args=(process.stdout, console), daemon=True)
    teller.start()
    try:
        yield
        if console.interactive and process.poll() is None:
            console.line("the run is done; Ctrl-C ends the viewer")
            with suppress(KeyboardInterrupt):
                process.wait()
    finally:
        # It only reads, and libraries that it has loaded would report a milder signal at length.
        process.kill()
        process.wait()
        teller.join()


def _relay(lines: IO[str] | None, console: Console) -> None:
    for line in lines or ():
        console.line(line.rstrip("\n"))


def has_display() -> bool:
    """Whether a window can be opened here."""
    named = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return os.name != "posix" or bool(named)


def open_recording(path: Path, *, host: str, port: int) -> None:
    """Show a recording in rerun's window, or without a display on its web page, until it ends."""
    if not path.is_file():
        raise ProjectError(f"{path}: no such file; expected a recording for rerun")
    # That of this Python before any other, which may be of another version.
    places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    program = shutil.which("rerun", path=places)
    if program is None:
        raise OptionError(
            f"{path}: a recording for rerun, which is not installed here; run 'pip install "
            '"gvtools[export]"\', or open the file at https://rerun.io/viewer'
        )
    command = [program, str(path.resolve()), "--bind", host]
    if not has_display():
        command += ["--web-viewer", "--web-viewer-port", str(port)]
    status = subprocess.run(command, check=False).returncode
    if status:
        raise OptionError(f"{path}: rerun ended with status {status}; it says more above")
