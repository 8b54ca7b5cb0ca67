"""``gvtools completers``: what fills holes, its needs and cost, what it was measured to give."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.files import write_json
from pipelines.options import Arguments

if TYPE_CHECKING:
    from pipelines.console import Console


class CompletersCommand(Arguments):
    """List the completers: what each needs, its cost a view, what it was measured to give."""

    examples = ("gvtools completers", "gvtools completers --json completers.json")

    json_: Path | None = None
    """Write the list there. [FILE]"""

    def run(self, console: Console) -> None:
        from gvtools.completers.base import available, completer_type

        listed = [(name, variant) for name in available() for variant in completer_type(name).facts]
        unsaid = [name for name in available() if not completer_type(name).facts]
        if self.json_ is not None:
            found = [{"name": name, **variant._asdict()} for name, variant in listed]
            write_json(self.json_, {"completers": found, "without_figures": unsaid})
        for name, variant in listed:
            console.line(f"{name}{variant.of and f', {variant.of}'}: {variant.what}")
            for field in ("needs", "cost", "gives"):
                console.line(f"  {field.ljust(5)}  {getattr(variant, field)}")
            if variant.source:
                console.line(f"  from   {variant.source}")
        for name in unsaid:
            console.line(f"{name}: of your own; it says nothing of itself (Completer.facts)")
        console.line("gvtools reconstruct PROJECT --completer NAME takes one")
