"""Experiments on held-out procedural scenes, chosen by name."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "measure the generative core on scenes that no training saw, against classical fillers"
EXAMPLES = (
    "python -m benchmarks.experiments completion --scenes 64 --markdown completion.md",
    "python -m benchmarks.experiments few-steps --teacher DIR --json steps.json",
)
# Each module has run(options) -> (figures, tables), and in READS the options that it looks at.
EXPERIMENTS = {
    "completion": "fillers, hint features, student and teacher, on generated pixels",
    "few-steps": "quality against level-1 and cascade steps",
    "poses": "cameras from the ray head",
    "ablations": "short trainings, alike in all but one part",
    "long-sequences": "three rounds with the memory and without",
    "domains": "rooms, hand-made levels and recorded scenes: where is the core better",
    "real-frames": "a recorded scan, by the model as it is and tuned to its context",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument(
        "what",
        choices=tuple(EXPERIMENTS),
        help="; ".join(f"{name}: {said}" for name, said in EXPERIMENTS.items()),
    )
    parser.add_argument("--weights", type=Path, metavar="DIR", help="default: those that ship")
    parser.add_argument(
        "--teacher", type=Path, metavar="DIR", help="the undistilled model, for its rows"
    )
    parser.add_argument(
        "--tuned", type=Path, metavar="DIR", help="of real-frames: weights of gvtools train tune"
    )
    parser.add_argument(
        "--context", metavar="SPEC", help="of real-frames: the given views (every:20)"
    )
    parser.add_argument(
        "--targets", metavar="SPEC", help="of real-frames: the judged views (every:20+10)"
    )
    parser.add_argument("--scenes", type=int, metavar="N", help="(64)")
    parser.add_argument(
        "--size", type=int, metavar="PIXELS", help="of the pictures (96; long-sequences: 256)"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="of scenes and completers (0)")
    parser.add_argument("--steps", type=int, metavar="N", help="of its trainings (600)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where its trainings go")
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="write context, hint, completion, truth there"
    )
    parser.add_argument(
        "--training", metavar="CONFIG", help="settings of its trainings, by name or file (tiny)"
    )
    parser.add_argument("--project", type=Path, metavar="DIR", help="of real-frames: a scan")
    parser.add_argument(
        "--projects", type=Path, nargs="+", metavar="DIR", help="of domains: recorded scenes"
    )
    parser.add_argument(
        "--levels", type=Path, metavar="DIR", help="of domains: unpacked packages of OpenArena"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there")


def run(args: argparse.Namespace, console: Console) -> None:
    """Run an experiment.

    Raises:
        GvError: weights that are absent or do not fit, or a wrong number.
    """
    from benchmarks.experiments.options import ExperimentOptions
    from gvtools.evaluation.tables import markdown
    from gvtools.files import check_parent, write_json, write_text

    names = (
        "weights",
        "tuned",
        "context",
        "targets",
        "teacher",
        "scenes",
        "size",
        "seed",
        "steps",
        "out",
        "project",
        "projects",
        "levels",
        "pictures",
        "training",
    )
    module = import_module(f"benchmarks.experiments.{args.what.replace('-', '_')}")
    named = {name: getattr(args, name) for name in names}
    given = {name: value for name, value in named.items() if value is not None}
    unread = [name for name in given if name not in module.READS]
    if unread:
        raise OptionError(
            f"experiment {args.what} does not look at --{', --'.join(unread)}; leave "
            f"{'it' if len(unread) == 1 else 'them'} out"
        )
    options = ExperimentOptions(**given)
    for path in (args.json, args.markdown):
        if path is not None:
            check_parent(path)
    figures, tables = module.run(options)
    text = "\n\n".join(markdown(table).strip() for table in tables) + "\n"
    console.line(text)
    if args.markdown is not None:
        write_text(args.markdown, text)
    if args.json is not None:
        write_json(args.json, {"experiment": args.what, **figures})
