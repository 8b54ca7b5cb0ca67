"""``gvtools view``: a run or an exported file in the browser, in a window, or as one picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from gvtools.errors import OptionError
from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "look at a run or an exported file: web page, Open3D window or picture"
EXAMPLES = (
    "gvtools view runs/kitchen",
    "gvtools view runs/kitchen --screenshot kitchen.png --color source",
    "gvtools view kitchen.spz",
)


class ViewArguments(Arguments):
    """The command's arguments."""

    positional = ("run",)
    exclusive = (("web", "open3d", "screenshot"),)

    run: Path
    """A run, memory.npz, or a file of gvtools export: splats and points (.ply, .spz, .las, .laz,
    .usdc, .usda, .glb), meshes (.ply, .glb, .obj), recordings (.rrd, by rerun). [RUN_OR_FILE]"""
    web: bool = False
    """Serve a web page (default)."""
    open3d: bool = False
    """Open Open3D's window instead."""
    screenshot: Path | None = None
    """Write a PNG and end; needs no display. [FILE]"""
    live: bool = False
    """Follow a run that is at work, from before its start."""
    host: str = "127.0.0.1"
    """Address to serve at; the default is this machine alone."""
    port: int = Field(8080, ge=1, le=65535)
    """The first one tried."""
    max_points: int = Field(1_000_000, ge=1)
    """Draw at most so many points on the page, spread evenly. [N]"""
    color: Literal["color", "round", "source", "confidence", "views", "depth-error"] = "color"
    """What colours show."""
    round: int | None = None
    """Begin with it (default the last). [R]"""
    camera: str | None = None
    """The view that a picture is taken from. [NAME]"""
    project: Path | None = None
    """Where the run's project lies now, if moved. [PATH]"""


def run(args: ViewArguments, console: Console) -> None:
    """Show the run."""
    from pipelines.viewing.serve import RECORDING, open_recording, read_round, serve
    from pipelines.viewing.source import ViewSource

    if args.live and (args.open3d or args.screenshot):
        raise OptionError("--live: the web page alone follows a run; leave the other option out")
    if args.screenshot is not None and args.screenshot.suffix.lower() != ".png":
        raise OptionError(f"--screenshot {args.screenshot}: expected a name that ends with .png")
    if args.run.suffix.lower() == RECORDING:
        if args.screenshot is not None or args.open3d:
            raise OptionError(
                f"{args.run}: recordings open in rerun's own viewer; leave --screenshot and "
                "--open3d out"
            )
        open_recording(args.run, host=args.host, port=args.port)
        return
    source, mode = ViewSource(args.run, project=args.project), args.color
    if args.live or not (args.open3d or args.screenshot):
        try:
            serve(
                source, host=args.host, port=args.port, max_points=args.max_points,
                round=args.round, mode=mode, live=args.live, console=console,
            )  # fmt: skip
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
