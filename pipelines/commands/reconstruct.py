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

# Options and the settings that they give; their help is the settings'.
OPTIONS = {
    name: name
    for name in (
        "context", "targets", "views_per_round", "rounds", "depth", "max_side", "completer",
        "profile", "protocol", "voxel", "device", "seed", "allow_overlap",
    )
} | {
    "refine": "refine.seconds", "tune": "tune.minutes", "cloud": "scan.file",
    "cloud_placement": "scan.placement",
}  # fmt: skip
METAVARS = {
    "context": "SPEC", "targets": "SPEC|FILE", "depth": "SOURCE", "max_side": "PIXELS",
    "completer": "NAME", "profile": "NAME", "protocol": "NAME", "voxel": "EDGE",
    "refine": "SECONDS", "tune": "MINUTES", "cloud": "FILE", "cloud_placement": "MATRIX",
}  # fmt: skip


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
    from pipelines.commands.options import add_settings
    from pipelines.reconstruction.settings import RunSettings

    parser.add_argument("--out", type=Path, required=out_required, help="the run's folder")
    add_settings(parser, RunSettings(), OPTIONS, metavars=METAVARS)
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings as JSON")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="one setting; repeatable"
    )
    parser.add_argument(
        "--help-settings", action=HelpSettings, settings=_settings, help="list all settings"
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
    from pipelines.report import draw_run
    from pipelines.viewing.serve import live_viewer

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
    from pipelines.commands.options import given_settings
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
    given = {
        key: value for key, value in given_settings(args, OPTIONS).items() if key not in presets
    }
    # A run's record names files wherever it is resumed from.
    for key in ("scan.file", "scan.placement"):
        if key in given and (key == "scan.file" or Path(given[key]).is_file()):
            given[key] = str(Path(given[key]).resolve())
    return with_texts(with_values(config, given), texts)
