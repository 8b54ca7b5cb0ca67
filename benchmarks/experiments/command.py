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


class ExperimentCommand(Arguments, ExperimentOptions):
    """Measure the generative core on scenes that no training saw, against classical fillers."""

    examples = (
        "python -m benchmarks.experiments completion --scenes 64 --markdown completion.md",
        "python -m benchmarks.experiments few-steps --teacher DIR --json steps.json",
    )
    positional = ("what",)

    what: str = Field(
        description="; ".join(f"{name}: {text}" for name, text in EXPERIMENTS.items())
    )
    json_: Path | None = None
    """Write the figures there. [FILE]"""
    markdown: Path | None = None
    """Write the tables there. [FILE]"""

    def run(self, console: Console) -> None:
        from gvtools.evaluation.tables import markdown
        from gvtools.files import check_parent, write_json, write_text

        if self.what not in EXPERIMENTS:
            raise OptionError(f"no experiment {self.what!r}; expected {', '.join(EXPERIMENTS)}")
        module = import_module(f"benchmarks.experiments.{self.what.replace('-', '_')}")
        given = self.model_fields_set & ExperimentOptions.model_fields.keys()
        unread = sorted(given - set(module.READS))
        if unread:
            raise OptionError(
                f"experiment {self.what} does not look at --{', --'.join(unread)}; leave "
                f"{'it' if len(unread) == 1 else 'them'} out"
            )
        for path in (self.json_, self.markdown):
            if path is not None:
                check_parent(path)
        figures, tables = module.run(self)
        text = "\n\n".join(markdown(table).strip() for table in tables) + "\n"
        console.line(text)
        if self.markdown is not None:
            write_text(self.markdown, text)
        if self.json_ is not None:
            write_json(self.json_, {"experiment": self.what, **figures})
