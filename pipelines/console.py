"""Talking to the user: lines, tables, progress; silence with --quiet."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any


class Console:
    """Progress bars on a terminal, plain lines otherwise, nothing with ``quiet``."""

    def __init__(self, *, quiet: bool = False) -> None:
        self.quiet = quiet
        self.interactive = sys.stdout.isatty() and not quiet

    def line(self, text: str) -> None:
        """One line on standard output."""
        if not self.quiet:
            print(text, flush=True)

    def warn(self, text: str) -> None:
        """One line on standard error, also with ``quiet``."""
        print(f"warning: {text}", file=sys.stderr, flush=True)

    def ask(self, question: str) -> bool:
        """Whether the user says yes; no without a terminal to ask on, and with ``quiet``."""
        if not (self.interactive and sys.stdin.isatty()):
            return False
        try:
            return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")
        except EOFError:
            return False

    def table(self, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Aligned columns; None prints as a dash, floats with four significant digits."""
        if self.quiet:
            return
        cells = [list(columns)] + [[_cell(value) for value in row] for row in rows]
        widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
        for row in cells:
            print("  ".join(text.rjust(w) for text, w in zip(row, widths, strict=True)).rstrip())
        sys.stdout.flush()

    def track(self, items: Sequence[Any], label: str) -> Iterator[Any]:
        """The items, with a bar on a terminal and one line elsewhere."""
        if not self.interactive:
            self.line(f"{label}: {len(items)}")
            yield from items
            return
        from rich.progress import track

        yield from track(items, description=label, transient=True)


class Silent(Console):
    """Prints nothing, warnings included."""

    def __init__(self) -> None:
        super().__init__(quiet=True)

    def warn(self, text: str) -> None:
        """Nothing."""


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)
