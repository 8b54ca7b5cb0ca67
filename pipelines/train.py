"""``gvtools train``: the generative core's stages, each resumable to the step after a kill."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "train the generative core: encoder, denoisers, distillation"
EXAMPLES = (
    "gvtools train tiny --stage all --out training/tiny",
    "gvtools train my_training.json --stage denoiser --out training/mine --resume",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    from gvtools.training.names import STAGES

    parser.add_argument(
        "config", metavar="CONFIG", help="a training that ships (tiny, micro), or a JSON file"
    )
    parser.add_argument(
        "--stage",
        choices=(*STAGES, "all"),
        default="all",
        help="encoder: pretraining of a small encoder with its heads; denoiser: both denoisers; "
        "reflow: distillation to few steps; all: one after the other (%(default)s)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="of the training")
    parser.add_argument(
        "--init",
        type=Path,
        metavar="DIR",
        help="start from these weights: a GeoVerse folder, or GLD's published files; by default "
        "from the stage before",
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
        help="a setting, such as denoiser.optimizer.steps=500 (JSON values)",
    )
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument(
        "--sheets", type=int, default=250, metavar="N", help="sample sheets every N steps; 0: none"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the last figures there")


def run(args: argparse.Namespace, console: Console) -> None:
    """Train the stages that were asked for.

    Raises:
        GvError: a wrong setting, a state of another training, or weights that do not fit.
    """
    from gvtools.training.names import STAGES
    from gvtools.training.options import shipped_or_read, with_settings
    from gvtools.training.processes import started
    from gvtools.training.run import StageRun

    config, folder = shipped_or_read(args.config)
    config = with_settings(config, args.set)
    if args.until is not None and args.until < 1:
        raise OptionError(f"--until {args.until}; expected at least step 1")
    stages = STAGES if args.stage == "all" else (args.stage,)
    figures: dict[str, dict[str, float]] = {}
    with started(args.device) as processes:
        for stage in stages:
            stage_run = StageRun(
                config, stage, args.out, processes=processes, model_folder=folder, init=args.init
            )
            figures[stage] = stage_run.train(
                resume=args.resume,
                until=args.until,
                sheet_every=args.sheets,
                say=console.line if processes.first else lambda text: None,
            )
        if args.json is not None and processes.first:
            args.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
