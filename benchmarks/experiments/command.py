"""Experiments on held-out procedural scenes, chosen by name."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from benchmarks.experiments.options import ExperimentOptions
from gvtools.errors import OptionError
from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console

SUMMARY = "measure the generative core on scenes that no training saw, against classical fillers"
EXAMPLES = (
    "python -m benchmarks.experiments completion --scenes 64 --markdown completion.md",
    "python -m benchmarks.experiments few-steps --teacher DIR --json steps.json",
)
# Each module has run(options) -> (figures, tables), and in READS the options that it reads.
EXPERIMENTS = {
    "completion": "fillers, hint features, student and teacher, on generated pixels",
    "few-steps": "quality against level-1 and cascade steps",
    "poses": "cameras from the ray head",
    "ablations": "short trainings, alike in all but one part",
    "long-sequences": "three rounds with the memory and without",
    "domains": "rooms, hand-made levels and recorded scenes: where is the core better",
    "real-frames": "a recorded scan, by the model as it is and tuned to its context",
}


class ExperimentArguments(Arguments, ExperimentOptions):
    """The command's arguments."""

    positional = ("what",)

    what: str = Field(
        description="; ".join(f"{name}: {text}" for name, text in EXPERIMENTS.items())
    )
    json_: Path | None = None
    """Write the figures there. [FILE]"""
    markdown: Path | None = None
    """Write the tables there. [FILE]"""


def run(args: ExperimentArguments, console: Console) -> None:
    """Run an experiment."""
    from gvtools.evaluation.tables import markdown
    from gvtools.files import check_parent, write_json, write_text

    if args.what not in EXPERIMENTS:
        raise OptionError(f"no experiment {args.what!r}; expected {', '.join(EXPERIMENTS)}")
    module = import_module(f"benchmarks.experiments.{args.what.replace('-', '_')}")
    given = args.model_fields_set & ExperimentOptions.model_fields.keys()
    unread = sorted(given - set(module.READS))
    if unread:
        raise OptionError(
            f"experiment {args.what} does not look at --{', --'.join(unread)}; leave "
            f"{'it' if len(unread) == 1 else 'them'} out"
        )
    for path in (args.json_, args.markdown):
        if path is not None:
            check_parent(path)
    figures, tables = module.run(args)
    text = "\n\n".join(markdown(table).strip() for table in tables) + "\n"
    console.line(text)
    if args.markdown is not None:
        write_text(args.markdown, text)
    if args.json_ is not None:
        write_json(args.json_, {"experiment": args.what, **figures})
