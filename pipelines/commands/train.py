"""``gvtools train``: the generative core's stages, each resumable to the step after a kill.

Several processes train together: ``torchrun --nproc-per-node N --no-python gvtools train ...``;
the setting ``parallel`` says what each of them holds.
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError
from pipelines.commands.arguments import HelpSettings
from pipelines.commands.tune import NAME, add_tune_arguments, refuse_tune_arguments, run_tune

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    from gvtools.training.records import STAGES

    parser.add_argument(
        "config",
        metavar="CONFIG",
        help="a training that ships (tiny, base, micro), a JSON file, or tune: see below",
    )
    parser.add_argument(
        "--stage",
        choices=(*STAGES, "all"),
        default="all",
        help="encoder: pretraining of a small encoder with its heads; denoiser: both denoisers; "
        "reflow: distillation to few steps; heads: a small model's heads on what it completes; "
        "refiner: what tells how far its completions are to be trusted; "
        "all: those that the training has, one after the other (%(default)s)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="of the training")
    parser.add_argument(
        "--init",
        type=Path,
        metavar="DIR",
        help="start from these weights: a GeoVerse folder, or one with GLD's published files. By "
        "default from the stage before. With published files, --stage all leaves the encoder's "
        "stage out",
    )
    parser.add_argument(
        "--resume", action="store_true", help="continue the stage where its last state was saved"
    )
    parser.add_argument("--until", type=int, metavar="STEP", help="stop after this step")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a setting, such as denoiser.optimizer.steps=500",
    )
    parser.add_argument(
        "--help-settings", action=HelpSettings, settings=_settings, help="list all settings"
    )
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument(
        "--sheets", type=int, default=250, metavar="N", help="sample sheets every N steps; 0: none"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the last figures there")
    add_tune_arguments(parser)


def _settings(args: argparse.Namespace) -> list[Settings]:
    from gvtools.settings import with_texts
    from gvtools.training.options import TrainingSettings, shipped_or_read

    known = TrainingSettings() if args.config is None else shipped_or_read(args.config)[0]
    return [with_texts(known, args.set)]


def run(args: argparse.Namespace, console: Console) -> None:
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
    refuse_tune_arguments(args)
    config, folder = shipped_or_read(args.config)
    config = with_texts(config, args.set)
    if args.until is not None and args.until < 1:
        raise OptionError(f"--until {args.until}; expected at least step 1")
    stages: tuple[str, ...] = (args.stage,)
    if args.stage == "all":
        stages = tuple(stage for stage in STAGES if getattr(config, stage) is not None)
        if args.init is not None and not (args.init / WHOLE_FILE).is_file():
            # A published encoder has its training behind it.
            stages = tuple(stage for stage in stages if stage != "encoder")
    if args.json is not None:
        check_parent(args.json)
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
        if args.json is not None and processes.first:
            write_text(args.json, json.dumps(figures, indent=2) + "\n")
