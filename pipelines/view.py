"""``gvtools view``: a run in the browser, in Open3D's window, or as one picture."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import GvError, OptionError

if TYPE_CHECKING:
    from pipelines.console import Console
    from pipelines.view_source import ViewSource
    from viz.run_view import RunView
    from viz.web_viewer import WebViewer

SUMMARY = "look at a run: web page, Open3D window or picture; colours by what is known of a point"
EXAMPLES = (
    "gvtools view runs/kitchen",
    "gvtools view runs/kitchen --screenshot kitchen.png --color source",
)
# As viz.web_viewer and viz.point_colors have them, which are not loaded for the parser.
LOCAL, PORT, MAX_POINTS = "127.0.0.1", 8080, 1_000_000
COLORS = ("color", "round", "source", "confidence", "views", "depth-error")
POLL_SECONDS = 1.0
ENDING_SECONDS = 10.0


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
        help="draw at most so many points on the page, one a cell (%(default)s)",
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
    from pipelines.view_source import ViewSource

    if args.live and (args.open3d or args.screenshot):
        raise OptionError("--live: the web page alone follows a run; leave the other option out")
    if not 0 < args.port < 65536:
        raise OptionError(f"--port {args.port}; expected 1 to 65535")
    if args.max_points < 1:
        raise OptionError(f"--max-points {args.max_points}; expected 1 or more")
    if args.screenshot is not None and args.screenshot.suffix.lower() != ".png":
        raise OptionError(f"--screenshot {args.screenshot}: expected a name that ends with .png")
    source = ViewSource(args.run, project=args.project)
    if args.live and not _wait_for_round(source, console):
        return
    shown = source.read()
    if not len(shown.memory):
        raise OptionError(f"{args.run}: an empty memory; expected one that views were fused in")
    number = shown.last_round if args.round is None else args.round
    if not 0 <= number <= shown.last_round:
        raise OptionError(f"--round {number}: the run has rounds 0 to {shown.last_round}")
    mode = args.color or "color"
    if args.screenshot is not None:
        _screenshot(shown, args, number, mode, console)
    elif args.open3d:
        from viz.open3d_viewer import Open3dViewer

        Open3dViewer(shown, round=number, mode=mode, say=console.line).run_until_closed()
    else:
        _serve(source, shown, args, number, mode, console)


def _screenshot(
    shown: RunView, args: argparse.Namespace, number: int, mode: str, console: Console
) -> None:
    from viz.screenshot import chosen_camera, take_screenshot, write_screenshot

    camera = chosen_camera(shown, args.camera)
    taken = take_screenshot(shown, camera.camera, round=number, mode=mode, open3d=args.open3d)
    write_screenshot(args.screenshot, taken.rgb)
    by = "Open3D" if taken.by == "open3d" else "the project's own splatter"
    reason = f" ({taken.why})" if taken.why else ""
    console.line(f"{args.screenshot}: round {number} from {camera.name}, rendered by {by}{reason}")


def _serve(
    source: ViewSource, shown: RunView, args: argparse.Namespace, number: int, mode: str,
    console: Console,
) -> None:  # fmt: skip
    from viz.web_viewer import WebViewer

    viewer = WebViewer(
        shown, host=args.host, port=args.port, budget=args.max_points, round=number, mode=mode
    )
    try:
        console.line(f"{args.run}: look at {viewer.url} (Ctrl-C ends)")
        if args.host != LOCAL:
            console.warn(f"--host {args.host}: whoever reaches this machine can see the run")
        lacking = source.lacking()
        if lacking:
            console.line(lacking)
            viewer.set_note(lacking)
        rounds = source.rounds()
        while True:
            time.sleep(POLL_SECONDS)
            if args.live and source.rounds() != rounds:
                rounds = _follow(source, viewer, rounds, console)
    except KeyboardInterrupt:
        console.line("viewer ended")
    finally:
        viewer.stop()


def _follow(source: ViewSource, viewer: WebViewer, rounds: int, console: Console) -> int:
    """Show what the run has by now; returns its rounds, the old number to try again."""
    try:
        shown = source.read()
    except GvError as error:
        console.warn(str(error))
        return rounds
    viewer.update(shown)
    console.line(f"round {shown.last_round} is there")
    return len(shown.reports)


def _wait_for_round(source: ViewSource, console: Console) -> bool:
    """Whether there is a round to show; False after Ctrl-C."""
    if not source.rounds():
        console.line(f"{source.path}: waiting for its first round")
    try:
        while not source.rounds():
            time.sleep(POLL_SECONDS)
    except KeyboardInterrupt:
        return False
    return True


@contextmanager
def live_viewer(out: Path, console: Console, *options: str) -> Iterator[None]:
    """A web viewer of the run in ``out``, in a process of its own, as long as the block lasts.

    It only reads the folder. On a terminal it stays when the block has ended well, until Ctrl-C.
    ``options`` are more words of ``gvtools view``.
    """
    command = [sys.executable, "-m", "pipelines.cli", "view", str(out), "--live", *options]
    process = subprocess.Popen([*command, *(["--quiet"] if console.quiet else [])])
    try:
        yield
        if console.interactive and process.poll() is None:
            console.line("the run is done; Ctrl-C ends the viewer")
            process.wait()
    finally:
        # As Ctrl-C does, which ends it without a word on what it was doing.
        process.send_signal(signal.SIGINT)
        try:
            process.wait(ENDING_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
