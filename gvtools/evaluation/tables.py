"""Tables of figures as CSV, Markdown and LaTeX.

CSV is for programs: full precision, an empty field where there is no value, ranks in columns of
their own. Markdown and LaTeX (with the package booktabs) are for readers: so many decimals a
column, a dash where there is no value, an arrow towards the better values, the best of a column
bold, the second italic in Markdown and underlined in LaTeX.
"""

from __future__ import annotations

import csv
import io
import math
import re
from dataclasses import dataclass
from numbers import Integral

# Significant digits of a column without decimals of its own.
SIGNIFICANT = 4


@dataclass(frozen=True)
class Column:
    """A column's heading, and how its numbers are printed."""

    title: str  # the heading
    unit: str = ""  # in brackets behind it; empty for none
    better: str | None = None  # "higher" or "lower"; None for neither, and for texts
    digits: int | None = None  # decimals; None prints four significant digits

    @property
    def heading(self) -> str:
        """Title and unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title


@dataclass(frozen=True)
class Ranked:
    """A value with its rank in the column, 1 the best; None for no rank."""

    value: float | None
    rank: int | None = None


Value = str | int | float | Ranked | None


@dataclass(frozen=True)
class Table:
    """Columns, rows of as many values, a caption, and notes below."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[Value, ...], ...]
    caption: str = ""
    notes: tuple[str, ...] = ()


def csv_text(table: Table) -> str:
    """The table as CSV (RFC 4180), without caption and notes.

    A column with ranks is followed by one named "TITLE rank".
    """
    ranked = [any(_rank(row[i]) for row in table.rows) for i in range(len(table.columns))]
    out = io.StringIO()
    writer = csv.writer(out)
    heads: list[str] = []
    for column, with_ranks in zip(table.columns, ranked, strict=True):
        heads += [column.heading, f"{column.title} rank"] if with_ranks else [column.heading]
    writer.writerow(heads)
    for row in table.rows:
        fields: list[str | int | float | None] = []
        for value, with_ranks in zip(row, ranked, strict=True):
            fields += [_plain(value), _rank(value)] if with_ranks else [_plain(value)]
        writer.writerow(fields)
    return out.getvalue()


def markdown(table: Table) -> str:
    """The table in the Markdown of GitHub; caption above, notes below."""
    arrow = {"higher": " ↑", "lower": " ↓", None: ""}
    heads = [_markdown_text(column.heading) + arrow[column.better] for column in table.columns]
    sides = ["---:" if _numeric(table, i) else ":---" for i in range(len(heads))]
    lines = [f"| {' | '.join(heads)} |", f"| {' | '.join(sides)} |"]
    for row in table.rows:
        cells = []
        for column, value in zip(table.columns, row, strict=True):
            mark = {1: "**", 2: "*"}.get(_rank(value) or 0, "")
            cells.append(mark + _markdown_text(shown(column, value)) + mark)
        lines.append(f"| {' | '.join(cells)} |")
    above = [f"{_markdown_paragraph(table.caption)}\n"] if table.caption else []
    below = [f"\n{_markdown_paragraph(note)}" for note in table.notes]
    return "\n".join([*above, *lines, *below]) + "\n"


def latex(table: Table) -> str:
    """A table environment for booktabs; caption above, notes below in small print."""
    arrow = {"higher": r"~$\uparrow$", "lower": r"~$\downarrow$", None: ""}
    heads = [_latex_text(column.heading) + arrow[column.better] for column in table.columns]
    sides = "".join("r" if _numeric(table, i) else "l" for i in range(len(heads)))
    lines = [r"\begin{table}", r"  \centering"]
    if table.caption:
        lines.append(rf"  \caption{{{_latex_text(table.caption)}}}")
    lines += [rf"  \begin{{tabular}}{{{sides}}}", r"    \toprule"]
    lines += [f"    {' & '.join(heads)} \\\\", r"    \midrule"]
    for row in table.rows:
        cells = []
        for column, value in zip(table.columns, row, strict=True):
            mark = {1: r"\textbf{%s}", 2: r"\underline{%s}"}.get(_rank(value) or 0, "%s")
            cells.append(mark % _latex_value(column, value))
        lines.append(f"    {' & '.join(cells)} \\\\")
    lines += [r"    \bottomrule", r"  \end{tabular}"]
    # A blank line begins the paragraph of each note.
    lines += [f"\n  {{\\footnotesize {_latex_text(note)}\\par}}" for note in table.notes]
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def _plain(value: Value) -> str | int | float | None:
    """Without rank; NaN is no value."""
    plain = value.value if isinstance(value, Ranked) else value
    return None if not isinstance(plain, str | Integral | None) and math.isnan(plain) else plain


def _rank(value: Value) -> int | None:
    return value.rank if isinstance(value, Ranked) and _plain(value) is not None else None


def _numeric(table: Table, index: int) -> bool:
    """Whether a column holds numbers alone."""
    return not any(isinstance(row[index], str) for row in table.rows)


def shown(column: Column, value: Value) -> str:
    """A value for readers, with its column's decimals; a number other than 0 never reads as 0."""
    plain = _plain(value)
    if plain is None:
        return "–"
    if isinstance(plain, str | Integral):
        return str(plain)
    if math.isinf(plain):
        return "∞" if plain > 0 else "-∞"
    if column.digits is None:
        return f"{plain:.{SIGNIFICANT}g}"
    text = f"{plain:.{column.digits}f}"
    if float(text) == 0:
        return f"{plain:.1g}" if plain else f"{0:.{column.digits}f}"
    return text


def _latex_value(column: Column, value: Value) -> str:
    text = shown(column, value)
    if isinstance(_plain(value), str):
        return _latex_text(text)
    if text == "–":
        return "--"
    # Only mathematics has a minus sign, infinity and powers.
    number = re.sub(r"e\+?(-?)0*(\d+)", r"\\cdot10^{\1\2}", text.replace("∞", r"\infty"))
    return text if number == text and text[0] != "-" else f"${number}$"


_MARKDOWN = re.compile(r"([\\`*_\[\]<>|~&#$])")
# Brackets and stars would be read as arguments behind the end of a line.
_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "|": r"\textbar{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    '"': "''",
    "[": "{[}",
    "*": "{*}",
}


def _markdown_text(text: str) -> str:
    return _MARKDOWN.sub(r"\\\1", _one_line(text))


def _markdown_paragraph(text: str) -> str:
    """Text that does not begin a list, a rule or a heading."""
    return re.sub(r"^(\d*)([-+=.)])", r"\1\\\2", _markdown_text(text))


def _latex_text(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in _one_line(text))


def _one_line(text: str) -> str:
    """White space of every kind as single blanks; other control characters left out."""
    return " ".join("".join(s for s in text if s.isprintable() or s.isspace()).split())
