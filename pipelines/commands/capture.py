"""``gvtools capture``: photographs, a video or an RGB-D recording without poses to a project."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError, ProjectError

if TYPE_CHECKING:
    from gvtools.capture.project import CaptureReport
    from pipelines.console import Console

SUMMARY = "find the cameras of photographs or of a video, and write a project"
EXAMPLES = (
    "gvtools capture photos/garden --out garden",
    "gvtools capture walk.mp4 --frames 80 --out walk",
    "gvtools capture photos/room --distance IMG_01.jpg,IMG_09.jpg,2.4 --out room",
)
# The picture of the cameras, in the project.
PICTURE = "capture.png"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "input", type=Path, metavar="INPUT", help="a folder of photographs, or a video"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="PROJECT", help="a new folder")
    parser.add_argument(
        "--frames", type=int, metavar="N", help="of a video (as many as its motion asks for)"
    )
    parser.add_argument(
        "--masks", type=Path, metavar="DIR", help="masks NAME.png: nothing is matched where black"
    )
    parser.add_argument(
        "--distance",
        type=_distance,
        metavar="A,B,METRES",
        help="between the places of two pictures, for a project in metres",
    )


def run(args: argparse.Namespace, console: Console) -> None:
    """Find the cameras and write the project.

    Raises:
        GvError: nothing that can be used, or no place to write to.
    """
    from gvtools.capture.project import capture_photographs
    from gvtools.scenes.project import VIDEOS

    if not args.input.exists():
        raise ProjectError(f"{args.input}: no such file or folder; expected photographs or a video")
    if args.input.is_file() and args.input.suffix.lower() not in VIDEOS:
        raise OptionError(
            f"{args.input}: expected a folder of photographs, or a video ({', '.join(VIDEOS)})"
        )
    if args.masks is not None and not args.masks.is_dir():
        raise ProjectError(f"--masks {args.masks}: no such folder")
    report = capture_photographs(
        args.input, args.out, frames=args.frames, masks=args.masks, distance=args.distance,
        say=console.line,
    )  # fmt: skip
    _print(report, console)
    _draw(args.out, report)
    console.line(f"{args.out}: gvtools check {args.out}; gvtools reconstruct {args.out} --out RUN")


def _distance(text: str) -> tuple[str, str, float]:
    parts = text.rsplit(",", 2)
    try:
        first, second, metres = parts[0], parts[1], float(parts[2])
    except (IndexError, ValueError):
        metres = 0.0
    if not 0 < metres < 1e6:
        raise argparse.ArgumentTypeError(
            f"{text!r}; expected two pictures' names and metres, A,B,METRES"
        )
    return first, second, metres


def _print(report: CaptureReport, console: Console) -> None:
    for finding in report.findings:
        (console.warn if finding.level == "warning" else console.line)(finding.message)
    for name, reason in list(report.left_out.items())[:10]:
        console.line(f"  {name}: {reason}")
    unit = "metres" if report.metric else "no known unit"
    rows = [
        ("registered pictures", f"{len(report.registered)} of {report.pictures}"),
        ("reprojection error, pixels", f"{report.reprojection_px:.3f}"),
        ("points", report.points),
        ("pictures that see a point, mean", f"{report.track_length:.1f}"),
        ("pairs that overlap", len(report.overlap)),
        ("matches that became points", f"{report.explained:.0%}"),
        ("matched", report.matching),
        ("mapping", report.mapping),
        ("cameras", ", ".join(str(camera["model"]) for camera in report.cameras)),
        ("unit", f"{unit}; placed by {report.placed_by}, z is up"),
    ]
    console.table(("what", "found"), rows)


def _draw(out: Path, report: CaptureReport) -> None:
    """``capture.png``: the cameras from above, and which of them overlap."""
    from gvtools.files import replaced_when_written
    from gvtools.scenes.project import open_project
    from viz.plots.capture import draw_capture

    scene = open_project(out)
    assert scene.points is not None
    figure = draw_capture(
        scene.cameras, scene.points.positions, report.overlap,
        title=f"{out.name}: {len(report.registered)} of {report.pictures} pictures",
    )  # fmt: skip
    with replaced_when_written(out / PICTURE) as temporary:
        figure.savefig(temporary, format="png")
