"""``gvtools view``: a run or an exported file in the browser, in a window, or as one picture."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "look at a run or an exported file: web page, Open3D window or picture"
EXAMPLES = (
    "gvtools view runs/kitchen",
    "gvtools view runs/kitchen --screenshot kitchen.png --color source",
    "gvtools view kitchen.spz",
)
# As viz.viewer.web and viz.viewer.colors have them, which are not loaded for the parser.
LOCAL, PORT, MAX_POINTS = "127.0.0.1", 8080, 1_000_000
COLORS = ("color", "round", "source", "confidence", "views", "depth-error")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN_OR_FILE",
        help="a run, memory.npz, or a file of gvtools export: splats and points (.ply, .spz, .las, "
        ".laz, .usdc, .usda, .glb), meshes (.ply, .glb, .obj), recordings (.rrd, by rerun)",
    )
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--web", action="store_true", help="serve a web page (default)")
    how.add_argument("--open3d", action="store_true", help="open Open3D's window instead")
    how.add_argument(
        "--screenshot", type=Path, metavar="FILE", help="write a PNG and end; needs no display"
    )
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
    parser.add_argument("--color", choices=COLORS, help="what colours show (default color)")
    parser.add_argument("--round", type=int, metavar="R", help="begin with it (default the last)")
    parser.add_argument("--camera", metavar="NAME", help="the view that a picture is taken from")
    parser.add_argument(
        "--project", type=Path, metavar="PATH", help="where the run's project lies now, if moved"
    )


def run(args: argparse.Namespace, console: Console) -> None:
    """Show the run."""
    from pipelines.viewing.serve import RECORDING, open_recording, read_round, serve
    from pipelines.viewing.source import ViewSource

    _check(args)
    if args.run.suffix.lower() == RECORDING:
        if args.screenshot is not None or args.open3d:
            raise OptionError(
                f"{args.run}: recordings open in rerun's own viewer; leave --screenshot and "
                "--open3d out"
            )
        open_recording(args.run, host=args.host, port=args.port)
        return
    source, mode = ViewSource(args.run, project=args.project), args.color or "color"
    if args.live or not (args.open3d or args.screenshot):
        try:
            serve(
                source,
                host=args.host,
                port=args.port,
                max_points=args.max_points,
                round=args.round,
                mode=mode,
                live=args.live,
                console=console,
            )
        except KeyboardInterrupt:
            console.line("viewer ended")
        return
    shown, number = read_round(source, args.round)
    if args.screenshot is not None:
        from viz.viewer.render import chosen_camera, write_screenshot

        camera = chosen_camera(shown, args.camera)
        write_screenshot(args.screenshot, shown, camera, round=number, mode=mode)
        console.line(f"{args.screenshot}: round {number} from {camera.name}")
    else:
        from viz.viewer.window import Open3dViewer

        Open3dViewer(shown, round=number, mode=mode, say=console.line).run_until_closed()


def _check(args: argparse.Namespace) -> None:
    if args.live and (args.open3d or args.screenshot):
        raise OptionError("--live: the web page alone follows a run; leave the other option out")
    if args.port is not None and not 1 <= args.port <= 65535:
        raise OptionError(f"--port {args.port}; expected at least 1 and at most 65535")
    if args.max_points is not None and args.max_points < 1:
        raise OptionError(f"--max-points {args.max_points}; expected at least 1")
    if args.screenshot is not None and args.screenshot.suffix.lower() != ".png":
        raise OptionError(f"--screenshot {args.screenshot}: expected a name that ends with .png")
