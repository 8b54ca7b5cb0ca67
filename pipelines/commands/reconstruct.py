"""gvtools reconstruct: fuse, project, complete, fuse back, round by round."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from pipelines.commands.arguments import SceneArguments
from pipelines.options import HelpSettings, add_settings, given_settings

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


class RunArguments(SceneArguments):
    """What ``reconstruct`` and ``demo`` share."""

    settings_of = OPTIONS

    settings: dict[str, Any] = Field(default_factory=dict)
    config: Path | None = None
    """Settings as JSON. [FILE]"""
    set: tuple[str, ...] = ()
    """One setting; repeatable. [KEY=VALUE]"""
    resume: bool = False
    """Continue after the last whole round."""
    dry_run: bool = False
    """Say what would be done, and stop."""
    json_: Path | None = None
    """Write the figures there too. [FILE]"""

    @classmethod
    def add(cls, parser: argparse.ArgumentParser) -> None:
        """Add the arguments, and the run's settings."""
        from pipelines.reconstruction.settings import RunSettings

        super().add(parser)
        add_settings(parser, RunSettings(), OPTIONS, metavars=METAVARS)
        parser.add_argument("--help-settings", action=HelpSettings, settings=_settings)


class ReconstructArguments(RunArguments):
    """The command's arguments."""

    positional = ("project",)

    project: Path
    """COLMAP, posed RGB-D, transforms.json or spec:NAME:SCENE; pictures, a video or a recording
    without cameras, with --capture. [PROJECT]"""
    out: Path
    """The run's folder. [PATH]"""
    live: bool = False
    """Open the web viewer and follow the run."""
    capture: bool = False
    """Where the input has no cameras, find them first, without asking: see gvtools capture."""


def _settings(args: argparse.Namespace) -> list[Settings]:
    from gvtools.completers.base import options_of_all

    given = given_settings(args, OPTIONS)
    return [run_settings(given, texts=args.set or (), file=args.config), *options_of_all()]


def run(args: ReconstructArguments, console: Console) -> None:
    """Run ``gvtools reconstruct``."""
    from pipelines.commands.capture import open_or_capture
    from pipelines.reconstruction.run import reconstruct
    from pipelines.report import draw_run
    from pipelines.viewing.serve import live_viewer

    config = run_settings(args.settings, texts=args.set, file=args.config)
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


def copy_figures(args: RunArguments, out: Path) -> None:
    """Write a run's metrics.json where ``--json`` wants it."""
    if args.json_ is not None and not args.dry_run:
        from gvtools.files import write_text

        write_text(args.json_, (out / "metrics.json").read_text(encoding="utf-8"))


def run_settings(
    given: Mapping[str, Any], *, texts: Sequence[str], file: Path | None
) -> RunSettings:
    """Defaults, then profile and protocol, then --config, then the options, then --set.

    ``--set profile=NAME`` stands for ``--profile NAME``.
    """
    from gvtools.settings import with_file, with_texts, with_values
    from pipelines.reconstruction.settings import RunSettings

    config, others = RunSettings(), []
    presets = {name: given[name] for name in config.presets if given.get(name)}
    for text in texts:
        key, equals, value = text.partition("=")
        if key.strip() in config.presets and equals:
            presets[key.strip()] = value.strip()
        else:
            others.append(text)
    config = with_file(config, file, presets=presets) if file else with_values(config, presets)
    own = {key: value for key, value in given.items() if key not in presets}
    # A run's record names files wherever it is resumed from.
    for key in ("scan.file", "scan.placement"):
        if key in own and (key == "scan.file" or Path(own[key]).is_file()):
            own[key] = str(Path(own[key]).resolve())
    return with_texts(with_values(config, own), others)
