"""``gvtools view``: a run in the browser, in Open3D's window, or as one picture."""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

from gvtools.errors import GvError, OptionError

if TYPE_CHECKING:
    from pipelines.console import Console
    from pipelines.inputs.view_source import ViewSource
    from viz.run_view.view import RunView

SUMMARY = "look at a run: web page, Open3D window or picture; colours by what is known of a point"
EXAMPLES = (
    "gvtools view runs/kitchen",
    "gvtools view runs/kitchen --screenshot kitchen.png --color source",
)
# As viz.web.viewer and viz.run_view.point_colors have them, which are not loaded for the parser.
LOCAL, PORT, MAX_POINTS = "127.0.0.1", 8080, 1_000_000
COLORS = ("color", "round", "source", "confidence", "views", "depth-error")
POLL_SECONDS = 1.0
# The run that a viewer belongs to ends it; a terminal's Ctrl-C is not for it.
CHILD = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); import sys; "
    "from pipelines.cli import main; sys.exit(main())"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("run", type=Path, metavar="RUN_OR_MEMORY", help="a run, memory.npz or PLY")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--web", action="store_true", help="serve a web page (default)")
    how.add_argument("--open3d", action="store_true", help="open Open3D's window instead")
    parser.add_argument(
        "--live", action="store_true", help="follow a run that is at work, from before its start"
    )
    parser.add_argument(
        "--host", default=LOCAL, help="address to serve at (%(default)s: this machine alone)"
    )
    parser.add_argument("--port", type=int, default=PORT, help="the first one tried (%(default)s)")
    parser.add_argument(
        "--max-points",
        type=int,
        default=MAX_POINTS,
        metavar="N",
        help="draw at most so many points on the page, spread evenly (%(default)s)",
    )
    parser.add_argument(
        "--screenshot",
        type=Path,
        metavar="FILE",
        help="write a PNG and end; needs no display. With --open3d, Open3D renders it where there "
        "is EGL or X",
    )
    parser.add_argument("--color", choices=COLORS, help="what colours show (default color)")
    parser.add_argument("--round", type=int, metavar="R", help="begin with it (default the last)")
    parser.add_argument("--camera", metavar="NAME", help="the view that a picture is taken from")
    parser.add_argument(
        "--project", type=Path, metavar="PATH", help="where the run's project lies now, if moved"
    )


def run(args: argparse.Namespace, console: Console) -> None:
    """Show the run.

    Raises:
        GvError: no run, an option that does not fit, no display.
    """
    from pipelines.inputs.view_source import ViewSource

    if args.live and (args.open3d or args.screenshot):
        raise OptionError("--live: the web page alone follows a run; leave the other option out")
    if not 0 < args.port < 65536:
        raise OptionError(f"--port {args.port}; expected 1 to 65535")
    if args.max_points < 1:
        raise OptionError(f"--max-points {args.max_points}; expected 1 or more")
    if args.screenshot is not None and args.screenshot.suffix.lower() != ".png":
        raise OptionError(f"--screenshot {args.screenshot}: expected a name that ends with .png")
    source = ViewSource(args.run, project=args.project)
    if args.live or not (args.open3d or args.screenshot):
        try:
            _serve(source, args, console)
        except KeyboardInterrupt:
            console.line("viewer ended")
        return
    shown, number = _read(source, args)
    mode = args.color or "color"
    if args.screenshot is not None:
        _screenshot(shown, args, number, mode, console)
    else:
        from viz.open3d.window import Open3dViewer

        Open3dViewer(shown, round=number, mode=mode, say=console.line).run_until_closed()


def _read(source: ViewSource, args: argparse.Namespace) -> tuple[RunView, int]:
    """The run, and the round to begin with."""
    shown = source.read()
    if not len(shown.memory):
        raise OptionError(f"{args.run}: an empty memory; expected one that views were fused in")
    number = shown.last_round if args.round is None else args.round
    if not 0 <= number <= shown.last_round:
        raise OptionError(f"--round {number}: the run has rounds 0 to {shown.last_round}")
    return shown, number


def _screenshot(
    shown: RunView, args: argparse.Namespace, number: int, mode: str, console: Console
) -> None:
    from viz.open3d.screenshot import chosen_camera, take_screenshot, write_screenshot

    camera = chosen_camera(shown, args.camera)
    taken = take_screenshot(shown, camera.camera, round=number, mode=mode, open3d=args.open3d)
    write_screenshot(args.screenshot, taken.rgb)
    by = "Open3D" if taken.by == "open3d" else "the project's own splatter"
    reason = f" ({taken.why})" if taken.why else ""
    console.line(f"{args.screenshot}: round {number} from {camera.name}, rendered by {by}{reason}")


def _serve(source: ViewSource, args: argparse.Namespace, console: Console) -> None:
    from viz.web.server import is_loopback
    from viz.web.viewer import WebViewer

    if args.live:
        _wait_for_round(source, console)
    shown, number = _read(source, args)
    viewer = WebViewer(
        shown,
        host=args.host,
        port=args.port,
        budget=args.max_points,
        round=number,
        mode=args.color or "color",
    )
    try:
        console.line(f"{args.run}: look at {viewer.url} (Ctrl-C ends)")
        if not is_loopback(args.host):
            console.warn(f"--host {args.host}: whoever reaches this machine can see the run")
        lacking = source.lacking()
        if lacking:
            console.line(lacking)
            viewer.set_note(lacking)
        following = Following(source, shown, viewer.update, console=console)
        while True:
            time.sleep(POLL_SECONDS)
            if args.live:
                following.look()
    finally:
        viewer.stop()


class Following:
    """A viewer that goes along with a run that grows.

    Args:
        source: of the run.
        shown: the run as the viewer shows it by now.
        update: shows it as it has become.
        console: told of new rounds, and once of each problem.
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


def _wait_for_round(source: ViewSource, console: Console) -> None:
    if not source.rounds():
        console.line(f"{source.path}: waiting for its first round")
    while not source.rounds():
        time.sleep(POLL_SECONDS)


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
    teller = threading.Thread(target=_tell, args=(process.stdout, console), daemon=True)
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


def _tell(lines: IO[str] | None, console: Console) -> None:
    for line in lines or ():
        console.line(line.rstrip("\n"))
