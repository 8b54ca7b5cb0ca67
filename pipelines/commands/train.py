"""``gvtools train``: the generative core's stages, each resumable to the step after a kill.

Several processes train together: ``torchrun --nproc-per-node N --no-python gvtools train ...``;
the setting ``parallel`` says what each of them holds.
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from gvtools.errors import OptionError
from pipelines.commands.tune import NAME, TuneArguments, run_tune
from pipelines.options import HelpSettings

if TYPE_CHECKING:
    from gvtools.settings import Settings
    from pipelines.console import Console

SUMMARY = "train the generative core: encoder, denoisers, distillation; or tune it to a scene"
EXAMPLES = (
    "gvtools train tiny --stage all --out training/tiny",
    "gvtools train my_training.json --stage denoiser --out training/mine --resume",
    "gvtools train base --init weights/base --out training/base",
    "gvtools train tune --scene scan/ --context every:2 --minutes 10 --out tuned/scan",
)


class TrainArguments(TuneArguments):
    """The command's arguments."""

    positional = ("config",)

    config: str
    """A training that ships (tiny, base, micro), a JSON file, or tune: see below. [CONFIG]"""
    stage: Literal["encoder", "denoiser", "reflow", "heads", "refiner", "all"] = "all"
    """encoder: pretraining of a small encoder with its heads; denoiser: both denoisers; reflow:
    distillation to few steps; heads: a small model's heads on what it completes; refiner: what
    tells how far its completions are to be trusted; all: those that the training has, one after the
    other."""
    out: Path
    """Of the training. [DIR]"""
    init: Path | None = None
    """Start from these weights: a GeoVerse folder, or one with GLD's published files. By default
    from the stage before. With published files, --stage all leaves the encoder's stage out.
    [DIR]"""
    resume: bool = False
    """Continue the stage where its last state was saved."""
    until: int | None = Field(None, ge=1)
    """Stop after this step. [STEP]"""
    set: tuple[str, ...] = ()
    """A setting, such as denoiser.optimizer.steps=500. [KEY=VALUE]"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """That computes."""
    sheets: int = 250
    """Sample sheets every N steps; 0: none. [N]"""
    json_: Path | None = None
    """Write the last figures there. [FILE]"""

    @classmethod
    def add(cls, parser: argparse.ArgumentParser) -> None:
        """Add the arguments, and the list of settings."""
        super().add(parser)
        parser.add_argument("--help-settings", action=HelpSettings, settings=_settings)


def _settings(args: argparse.Namespace) -> list[Settings]:
    from gvtools.settings import with_texts
    from gvtools.training.options import TrainingSettings, shipped_or_read

    known = TrainingSettings() if args.config is None else shipped_or_read(args.config)[0]
    return [with_texts(known, args.set or ())]


def run(args: TrainArguments, console: Console) -> None:
    """Train the stages that were asked for."""
    from gvtools.completers.geoverse.weights import WHOLE_FILE
    from gvtools.files import check_parent, make_folder, write_text
    from gvtools.runs.folder import folder_lock
    from gvtools.settings import with_texts
    from gvtools.training.distributed import join_processes
    from gvtools.training.options import shipped_or_read
    from gvtools.training.records import STAGES
    from gvtools.training.run import StageRun

    if args.config == NAME:
        run_tune(args, console)
        return
    for name in TuneArguments.model_fields:
        if name in args.model_fields_set:
            raise OptionError(f"{args.key(name)} belongs to 'gvtools train tune'; leave it out")
    config, folder = shipped_or_read(args.config)
    config = with_texts(config, args.set)
    stages: tuple[str, ...] = (args.stage,)
    if args.stage == "all":
        stages = tuple(stage for stage in STAGES if getattr(config, stage) is not None)
        if args.init is not None and not (args.init / WHOLE_FILE).is_file():
            # A published encoder has its training behind it.
            stages = tuple(stage for stage in stages if stage != "encoder")
    if args.json_ is not None:
        check_parent(args.json_)
    make_folder(args.out)
    figures: dict[str, dict[str, float]] = {}
    with ExitStack() as held:
        processes = held.enter_context(join_processes(args.device))
        if processes.first:
            held.enter_context(folder_lock(args.out))
        for stage in stages:
            stage_run = StageRun(
                config,
                stage,
                args.out,
                processes=processes,
                model_folder=folder,
                init=args.init if stage == stages[0] else None,
            )
            figures[stage] = stage_run.train(
                resume=args.resume,
                until=args.until,
                sheet_every=args.sheets,
                say=console.line if processes.first else lambda text: None,
            )
            if figures[stage].get("step", 0) < stage_run.options.optimizer.steps:
                # --until: the next stage has nothing to start from yet.
                break
        if args.json_ is not None and processes.first:
            write_text(args.json_, json.dumps(figures, indent=2) + "\n")
