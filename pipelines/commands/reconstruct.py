"""``gvtools reconstruct``, ``demo``, ``refine``; ``split`` and ``merge`` a project in blocks."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from importlib import import_module
from itertools import chain, count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from gvtools.errors import OptionError
from gvtools.files import write_text
from gvtools.settings import Settings, with_file, with_texts, with_values
from pipelines.commands.arguments import SceneArguments
from pipelines.console import Console
from pipelines.options import Arguments, HelpSettings, JsonArguments, add_settings, given_settings

if TYPE_CHECKING:
    from pipelines.reconstruction.settings import RunSettings


# Options and the settings that they give; their help is the settings'.
OPTIONS = {
    name: name
    for name in (
        "context", "targets", "views_per_round", "rounds", "depth", "max_side", "completer",
        "profile", "protocol", "voxel", "device", "seed", "allow_overlap",
    )
} | {
    "refine": "refine.seconds", "tune": "tune.minutes", "cloud": "scan.file",
    "cloud_placement": "scan.placement", "init": "refine.init", "lens": "lens.kind",
}  # fmt: skip
METAVARS = {
    "context": "SPEC", "targets": "SPEC|FILE", "depth": "SOURCE", "max_side": "PIXELS",
    "completer": "NAME", "profile": "NAME", "protocol": "NAME", "voxel": "EDGE",
    "refine": "SECONDS", "tune": "MINUTES", "cloud": "FILE", "cloud_placement": "MATRIX",
    "init": "FILE", "lens": "NAME",
}  # fmt: skip


class RunArguments(SceneArguments, JsonArguments):
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

    @classmethod
    def add(cls, parser: argparse.ArgumentParser) -> None:
        """Add the arguments, and the run's settings."""
        from pipelines.reconstruction.settings import RunSettings

        super().add(parser)
        add_settings(parser, RunSettings(), OPTIONS, metavars=METAVARS)
        parser.add_argument("--help-settings", action=HelpSettings, settings=_settings)


class ReconstructCommand(RunArguments):
    """Grow a memory from a posed project, round by round."""

    examples = (
        "gvtools reconstruct scan/ --context every:2 --targets every:2+1 --out runs/scan",
        "gvtools reconstruct colmap/ --targets orbit:24 --completer inpaint --out runs/orbit",
        "gvtools reconstruct hall/ --targets interpolate:4 --lens equirectangular --out runs/hall",
        "gvtools reconstruct walk.mp4 --capture --out runs/walk",
        "gvtools reconstruct photographs/ --cloud survey.laz --out runs/survey",
    )
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

    def run(self, console: Console) -> None:
        from pipelines.commands.capture import open_or_capture
        from pipelines.reconstruction.run import reconstruct
        from pipelines.report import draw_run
        from pipelines.viewing.serve import live_viewer

        config = run_settings(self.settings, texts=self.set, file=self.config)
        scene, reading = open_or_capture(self, console)
        watched = self.live and not self.dry_run
        with live_viewer(self.out, console) if watched else nullcontext():
            reconstruct(
                scene,
                config,
                self.out,
                console=console,
                resume=self.resume,
                dry_run=self.dry_run,
                reading=reading,
                draw=draw_run,
            )
            copy_figures(self, self.out)


def _settings(args: argparse.Namespace) -> list[Settings]:
    from gvtools.completers.base import options_of_all

    given = given_settings(args, OPTIONS)
    return [run_settings(given, texts=args.set or (), file=args.config), *options_of_all()]


def copy_figures(args: RunArguments, out: Path) -> None:
    """Write a run's metrics.json where ``--json`` wants it."""
    if args.json_ is not None and not args.dry_run:
        write_text(args.json_, (out / "metrics.json").read_text(encoding="utf-8"))


def run_settings(
    given: Mapping[str, Any], *, texts: Sequence[str], file: Path | None
) -> RunSettings:
    """Defaults, then profile and protocol, then --config, then the options, then --set.

    ``--set profile=NAME`` stands for ``--profile NAME``.
    """
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
    for key in ("scan.file", "scan.placement", "refine.init"):
        if key in own and (key != "scan.placement" or Path(own[key]).is_file()):
            own[key] = str(Path(own[key]).resolve())
    return with_texts(with_values(config, own), others)


# Steps of the fit unless told otherwise: a first look takes seconds and is the same every time.
FIT_STEPS = 300
# Writers of the samples, in ``gvtools.procedural``; the last is of nature and takes no seed.
SAMPLES = {
    "room": "room_sample.write_room", "noisy-room": "noisy_room.write_noisy_room",
    "motorcycle": "stereo_sample.write_motorcycle",
}  # fmt: skip


class DemoCommand(RunArguments):
    """Run the main job on a sample that needs no download."""

    examples = (
        "gvtools demo",
        "gvtools demo --sample motorcycle --out runs/motorcycle",
        "gvtools demo --sample noisy-room",
    )
    sample: Literal["room", "noisy-room", "motorcycle"] = "room"
    """noisy-room is the room as a cheap RGB-D camera records it."""
    out: Path | None = None
    """The run's folder. [PATH]"""

    def run(self, console: Console) -> None:
        config = run_settings(self.settings, texts=self.set, file=self.config)
        default = Path("runs") / f"demo-{self.sample}"
        # Absolute, since the sample's folder is named after it, and "." has no name.
        out = self.out.absolute() if self.out else free_folder(default, resume=self.resume)
        from gvtools.runs.folder import RunDirectory

        RunDirectory(out).refuse_foreign()
        sample = out.with_name(f"{out.name}-sample")
        from gvtools.procedural.room_sample import KERNELS
        from gvtools.scenes.project import open_project
        from pipelines.reconstruction.run import compile_kernels, reconstruct
        from pipelines.report import draw_run

        compile_kernels(config, console, more=(KERNELS,) if self.sample != "motorcycle" else ())
        console.line(f"sample {self.sample}, seed {config.seed}: writing {sample}")
        module, _, writer = SAMPLES[self.sample].partition(".")
        seed = {"seed": config.seed} if self.sample != "motorcycle" else {}
        written = getattr(import_module(f"gvtools.procedural.{module}"), writer)(sample, **seed)
        for name in ("context", "targets"):
            if name not in self.settings:
                config = config.replaced(**{name: ",".join(getattr(written, name))})
        if config.refine.seconds is None and config.refine.steps is None:
            config = config.replaced(refine=config.refine.replaced(steps=FIT_STEPS))
        if not {"views_per_round", "rounds"} & self.settings.keys():
            config = config.replaced(views_per_round=4)
        reconstruct(
            open_project(sample),
            config,
            out,
            console=console,
            resume=self.resume,
            dry_run=self.dry_run,
            draw=draw_run,
        )
        copy_figures(self, out)
        if not self.dry_run and (out / "round_001").is_dir():
            console.line(
                f"look at {out / 'growth.png'} and at the pictures in {out}/round_001: guidance_* "
                "is what the completer was given, generated_* what it made of it, after_* what the "
                "memory knows now"
            )


def free_folder(path: Path, *, resume: bool) -> Path:
    """``path``, or the first of path-2, path-3, ... that is not there yet (the last when resuming).

    A demo is run again and again; its default folder must not refuse.
    """
    others = (path.with_name(f"{path.name}-{number}") for number in count(2))
    places = pairwise(chain((path, path), others))
    last, free = next(pair for pair in places if not pair[1].exists())
    return last if resume and last.exists() else free


class RefineCommand(Arguments):
    """Fit a run's Gaussians further, and make the run again with them."""

    examples = (
        "gvtools refine runs/kitchen --seconds 600",
        "gvtools refine runs/kitchen --steps 2000",
    )
    positional = ("folder",)
    exclusive = (("seconds", "steps"),)

    folder: Path
    """A run's folder, finished or not. [RUN]"""
    seconds: float = Field(120.0, gt=0)
    """Fit so long. [S]"""
    steps: int | None = Field(None, ge=1)
    """So many steps, with the same result every time. [N]"""
    project: Path | None = None
    """Where the run's project lies, if it was moved. [DIR]"""

    def run(self, console: Console) -> None:
        from pipelines.reconstruction.run import refine
        from pipelines.report import draw_run

        refine(
            self.folder,
            seconds=self.seconds if self.steps is None else None,
            steps=self.steps,
            project=self.project,
            console=console,
            draw=draw_run,
        )


class SplitCommand(SceneArguments):
    """Cut a project into overlapping blocks, each a project of its own."""

    examples = (
        "gvtools split city/ --blocks 16 --out blocks",
        "gvtools split scan/ --blocks 4 --context not:every:10 --layout chunks --out blocks",
    )
    positional = ("project",)

    project: Path
    """COLMAP, posed RGB-D, transforms.json or spec:NAME:SCENE. [PROJECT]"""
    out: Path
    """For the blocks. [FOLDER]"""
    blocks: str = "auto"
    """How many (auto: 150 views a block). [N|auto]"""
    overlap: float = Field(0.8, ge=0, le=1)
    """0 to 1: a view joins every block whose part of space holds at least 1 - X of what it sees.
    [X]"""
    context: str = "all"
    """Views that are given; the others are listed as targets.txt. [SPEC]"""
    layout: Literal["projects", "chunks"] = "projects"
    """Projects: a COLMAP workspace a block; chunks: as Hierarchical-3DGS's."""
    keep_poses: bool = False
    """Do not refine the poses of RGB-D views, as --set refine.poses=false of a run."""
    max_side: int = 1600
    """At which they are refined: that of the runs (--profile fast has 480). [pixels]"""

    def run(self, console: Console) -> None:
        from pipelines.blocks.split import block_folder, split

        if self.blocks != "auto" and not (self.blocks.isdecimal() and int(self.blocks)):
            raise OptionError(f"--blocks {self.blocks}; expected auto or a number from 1")
        blocks = split(
            self.open_scene(self.project),
            self.out,
            blocks=None if self.blocks == "auto" else int(self.blocks),
            overlap=self.overlap,
            context=self.context,
            layout=self.layout,
            refine_poses=not self.keep_poses,
            max_side=self.max_side,
            reading=self.reading(),
            say=console.line,
        )
        folder = block_folder(self.out, blocks[0].name, self.layout)
        targets = f" --targets @{folder}/targets.txt" if blocks[0].targets else ""
        console.line(
            f"{len(blocks)} blocks in {self.out}; reconstruct each, then merge the runs:\n"
            f"gvtools reconstruct {folder} --context @{folder}/context.txt{targets} --out RUN"
        )


class MergeCommand(Arguments):
    """Join the runs of a project's blocks into one run."""

    examples = (
        "gvtools merge runs/block-* --out runs/city",
        "gvtools merge runs/block-* --out runs/city --blocks blocks --project city/",
    )
    positional = ("runs",)

    runs: tuple[Path, ...]
    """A block's finished run. [RUN]"""
    out: Path
    """The merged run. [RUN]"""
    blocks: Path | None = None
    """Where the split lies now, if it was moved. [FOLDER]"""
    project: Path | None = None
    """Where the whole project lies now, if moved. [DIR]"""
    resume: bool = False
    """Continue after the last whole round."""

    def run(self, console: Console) -> None:
        from pipelines.blocks.merge import merge
        from pipelines.report import draw_run

        merge(
            self.runs,
            self.out,
            blocks=self.blocks,
            project=self.project,
            resume=self.resume,
            console=console,
            draw=draw_run,
        )
