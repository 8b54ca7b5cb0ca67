"""gvtools reconstruct: fuse, project, complete, fuse back, round by round."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.commands.arguments import HelpSettings

if TYPE_CHECKING:
    from gvtools.settings import Settings
    from pipelines.console import Console
    from pipelines.reconstruction.settings import RunSettings

SUMMARY = "grow a memory from a posed project, round by round"
EXAMPLES = (
    "gvtools reconstruct scan/ --context every:2 --targets every:2+1 --out runs/scan",
    "gvtools reconstruct colmap/ --targets orbit:24 --completer inpaint --out runs/orbit",
    "gvtools reconstruct walk.mp4 --capture --out runs/walk",
    "gvtools reconstruct photographs/ --cloud survey.laz --out runs/survey",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``reconstruct``."""
    parser.add_argument(
        "project",
        type=Path,
        help="COLMAP, posed RGB-D, transforms.json or spec:NAME:SCENE; pictures, a video or a "
        "recording without cameras, with --capture",
    )
    add_run_arguments(parser, out_required=True)
    parser.add_argument(
        "--live", action="store_true", help="open the web viewer and follow the run"
    )
    parser.add_argument(
        "--capture",
        action="store_true",
        help="where the input has no cameras, find them first, without asking: see gvtools capture",
    )


def add_run_arguments(parser: argparse.ArgumentParser, *, out_required: bool) -> None:
    """What ``reconstruct`` and ``demo`` share."""
    from pipelines.commands.arguments import add_scene_arguments

    parser.add_argument("--out", type=Path, required=out_required, help="the run's folder")
    parser.add_argument("--context", metavar="SPEC", help="views that are given (default all)")
    parser.add_argument(
        "--targets",
        metavar="SPEC|FILE",
        help="cameras to complete: a selection, interpolate:N, orbit:N, spiral:N, a trajectory "
        "file or another project (default interpolate:12)",
    )
    parser.add_argument("--views-per-round", type=int, metavar="N", help="at most (default 6)")
    parser.add_argument("--rounds", type=int, metavar="N", help="default: as the targets need")
    parser.add_argument("--depth", metavar="SOURCE", help="auto, sensor, colmap, plane-sweep, da3")
    parser.add_argument(
        "--max-side", metavar="PIXELS", help="reduce larger pictures to it, or none (default 1600)"
    )
    parser.add_argument("--completer", metavar="NAME", help="default inpaint")
    parser.add_argument("--profile", metavar="NAME", help="fast, balanced, accurate or finest")
    parser.add_argument(
        "--protocol", metavar="NAME", help="gvtools, or paper: GeoVerse as it was published"
    )
    parser.add_argument(
        "--refine",
        type=float,
        metavar="SECONDS",
        help="fit Gaussians to the photographs at most so long; 0: not at all (default: as long as "
        "photographs that are left out gain by it, at most 120)",
    )
    parser.add_argument(
        "--tune",
        type=float,
        metavar="MINUTES",
        help="train the generative core (--completer geoverse) so long to predict the context from "
        "itself, before the first targets (default 0: not at all)",
    )
    parser.add_argument(
        "--cloud", metavar="FILE", help="start memory from a scan: PLY, LAS, LAZ, E57 or PCD"
    )
    parser.add_argument(
        "--cloud-placement",
        metavar="MATRIX",
        help="similarity from the scan's frame to the photographs': estimate (default), identity, "
        "a text file with a 4x4 matrix, or its numbers row by row with commas between",
    )
    parser.add_argument("--voxel", metavar="EDGE", help="auto, or scene units")
    parser.add_argument(
        "--device", metavar="NAME", help="cpu, cuda (the torch back end), or auto: cpu"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="of everything random (default 0)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings as JSON")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="one setting; repeatable"
    )
    parser.add_argument(
        "--help-settings", action=HelpSettings, settings=_settings, help="list all settings"
    )
    parser.add_argument(
        "--allow-overlap", action="store_true", help="let views be context and target"
    )
    parser.add_argument("--resume", action="store_true", help="continue after the last whole round")
    parser.add_argument("--dry-run", action="store_true", help="say what would be done, and stop")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    add_scene_arguments(parser)


def _settings(args: argparse.Namespace) -> list[Settings]:
    from gvtools.completers.base import options_of_all

    return [config_from(args), *options_of_all()]


def run(args: argparse.Namespace, console: Console) -> None:
    """Run ``gvtools reconstruct``."""
    from pipelines.commands.capture import open_or_capture
    from pipelines.reconstruction.run import reconstruct
    from pipelines.report.write import draw_run
    from pipelines.viewing.live import live_viewer

    config = config_from(args)
    scene, reading = open_or_capture(args, console)
    watched = args.live and not args.dry_run
    with live_viewer(args.out, console) if watched else nullcontext():
        reconstruct(
            scene,
            config,
            args.out,
            console=console,
            resume=args.resume,
            dry_run=args.dry_run,
            reading=reading,
            draw=draw_run,
        )
        copy_figures(args, args.out)


def copy_figures(args: argparse.Namespace, out: Path) -> None:
    """Write a run's metrics.json where ``--json`` wants it."""
    if args.json is not None and not args.dry_run:
        from gvtools.files import write_text

        write_text(args.json, (out / "metrics.json").read_text(encoding="utf-8"))


def config_from(args: argparse.Namespace) -> RunSettings:
    """Defaults, then profile and protocol, then --config, then the options, then --set.

    ``--set profile=NAME`` stands for ``--profile NAME``.
    """
    from gvtools.settings import with_file, with_texts, with_values
    from pipelines.reconstruction.settings import RunSettings

    config, texts = RunSettings(), []
    presets = {name: getattr(args, name) for name in config.presets if getattr(args, name)}
    for text in args.set:
        key, equals, value = text.partition("=")
        if key.strip() in config.presets and equals:
            presets[key.strip()] = value.strip()
        else:
            texts.append(text)
    if args.config:
        config = with_file(config, args.config, presets=presets)
    else:
        config = with_values(config, presets)
    names = ("context", "targets", "views_per_round", "rounds", "max_side", "depth", "completer",
             "voxel", "device", "seed")  # fmt: skip
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.refine is not None:
        given["refine.seconds"] = args.refine
    if args.tune is not None:
        given["tune.minutes"] = args.tune
    if args.cloud is not None:
        given["scan.file"] = str(Path(args.cloud).resolve())
    if args.cloud_placement is not None:
        text = args.cloud_placement
        given["scan.placement"] = str(Path(text).resolve()) if Path(text).is_file() else text
    if args.allow_overlap:
        given["allow_overlap"] = True
    return with_texts(with_values(config, given), texts)
