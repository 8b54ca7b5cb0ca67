from __future__ import annotations

import csv
import io
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gvtools.errors import OptionError, ShapeError
from gvtools.evaluation.tables import (
    FORMS,
    Cell,
    Column,
    Table,
    csv_text,
    latex,
    markdown,
    render,
)

FIGURES = Table(
    (
        Column("System"),
        Column("PSNR", unit="dB", better="higher", digits=2),
        Column("ATE", better="lower", digits=3),
        Column("n"),
    ),
    (
        ("ours", Cell(19.605, 1), Cell(0.0281234567, 1), 3),
        ("theirs", Cell(17.0, 2), Cell(None), 12),
        ("none", None, float("nan"), None),
    ),
    caption="A comparison",
    notes=("One note.",),
)

texts = st.text(
    # Python 3.10 reads no CSV with a zero in it.
    st.characters(
        codec="utf-8", categories=("L", "N", "P", "S", "Z", "Cc"), exclude_characters="\0"
    ),
    max_size=30,
)


def _table(*names: str) -> Table:
    rows = tuple((name, Cell(float(i), None)) for i, name in enumerate(names))
    return Table((Column("Name"), Column("Value", digits=1)), rows)


def _plain(text: str) -> str:
    """As the tables have it: blanks for all white space, no control characters."""
    return " ".join("".join(s for s in text if s.isprintable() or s.isspace()).split())


def _read_markdown(text: str) -> list[list[str]]:
    """Cells of the tables in a Markdown text, by an independent reader, without mark-up."""
    reader = pytest.importorskip("markdown_it").MarkdownIt("commonmark").enable("table")
    tokens = reader.parse(text)
    rows: list[list[str]] = []
    for before, token in pairwise(tokens):
        if token.type == "tr_open":
            rows.append([])
        if before.type in ("th_open", "td_open"):
            kinds = {"text", "text_special", "strong_open", "strong_close", "em_open", "em_close"}
            assert {child.type for child in token.children} <= kinds, token.content
            rows[-1].append("".join(child.content for child in token.children))
    return rows


def _read_latex(text: str) -> list[list[str]]:
    """Cells of a tabular with the escapes undone; fails on a sign that is not escaped."""
    body = text[text.index(r"\toprule") : text.index("\n    \\bottomrule")]
    rows = []
    for line in body.splitlines():
        if not line.endswith(r" \\"):
            assert line.strip() in (r"\toprule", r"\midrule")
            continue
        cells = re.split(r"(?<!\\)&", line[: -len(r" \\")])
        rows.append([_unescaped(cell.strip()) for cell in cells])
    return rows


def _unescaped(cell: str) -> str:
    words = {
        r"\textbackslash{}": "\\",
        r"\textasciitilde{}": "~",
        r"\textasciicircum{}": "^",
        r"\textbar{}": "|",
        r"\textless{}": "<",
        r"\textgreater{}": ">",
        "{[}": "[",
        "{*}": "*",
        **{f"\\{sign}": sign for sign in "{}&%$#_"},
    }
    token = re.compile("|".join(re.escape(word) for word in words))
    assert not re.search(r"[\\{}&%$#_~^|<>\[*]", token.sub("", cell)), cell
    return token.sub(lambda match: words[match[0]], cell)


def test_csv_has_all_digits_and_ranks_of_their_own():
    rows = list(csv.reader(io.StringIO(csv_text(FIGURES))))
    assert rows == [
        ["System", "PSNR (dB)", "PSNR rank", "ATE", "ATE rank", "n"],
        ["ours", "19.605", "1", "0.0281234567", "1", "3"],
        ["theirs", "17.0", "2", "", "", "12"],
        ["none", "", "", "", "", ""],
    ]


def test_markdown():
    assert markdown(FIGURES) == (
        "A comparison\n"
        "\n"
        "| System | PSNR (dB) ↑ | ATE ↓ | n |\n"
        "| :--- | ---: | ---: | ---: |\n"
        "| ours | **19.61** | **0.028** | 3 |\n"
        "| theirs | *17.00* | – | 12 |\n"
        "| none | – | – | – |\n"
        "\n"
        "One note.\n"
    )


def test_latex():
    lines = latex(FIGURES, label="tab:x").splitlines()
    assert lines[:4] == [
        r"\begin{table}",
        r"  \centering",
        r"  \caption{A comparison}",
        r"  \label{tab:x}",
    ]
    assert [line.strip() for line in lines[4:-1]] == [
        r"\begin{tabular}{lrrr}",
        r"\toprule",
        r"System & PSNR (dB)~$\uparrow$ & ATE~$\downarrow$ & n \\",
        r"\midrule",
        r"ours & \textbf{19.61} & \textbf{0.028} & 3 \\",
        r"theirs & \underline{17.00} & -- & 12 \\",
        r"none & -- & -- & -- \\",
        r"\bottomrule",
        r"\end{tabular}",
        "",
        r"{\footnotesize One note.\par}",
    ]
    assert lines[-1] == r"\end{table}"


@pytest.mark.parametrize(
    ("value", "digits", "shown", "in_latex"),
    [
        (0.0004, 3, "0.0004", "0.0004"),
        (-0.00004, 3, "-4e-05", r"$-4\cdot10^{-5}$"),
        (0.0, 3, "0.000", "0.000"),
        (-0.0, 3, "0.000", "0.000"),
        (-1.25, 1, "-1.2", "$-1.2$"),
        (float("inf"), 2, "∞", r"$\infty$"),
        (float("-inf"), 2, "-∞", r"$-\infty$"),
        (1234.5678, None, "1235", "1235"),
        (1.2e9, None, "1.2e+09", r"$1.2\cdot10^{9}$"),
        (-7, 2, "-7", "$-7$"),
        (515.81, 2, "515.81", "515.81"),
    ],
)
def test_numbers_as_readers_see_them(value, digits, shown, in_latex):
    table = Table((Column("x", digits=digits),), ((Cell(value),),))
    assert markdown(table).splitlines()[-1] == f"| {shown} |"
    assert latex(table).splitlines()[6].strip() == f"{in_latex} \\\\"
    assert float(next(csv.reader([csv_text(table).splitlines()[1]]))[0]) == value


def test_numpys_numbers_are_numbers():
    row: Any = (np.float32(0.284), np.float32("nan"), np.int64(3))
    table = Table((Column("a", digits=3), Column("b"), Column("c", digits=2)), (row,))
    assert markdown(table).splitlines()[-1] == "| 0.284 | – | 3 |"
    assert csv_text(table).splitlines()[1].split(",")[1:] == ["", "3"]


@example([r"a & b % c _ d | e", "two\nlines\r\nand\ttab", r"back\slash \textbf{bold} \|", "*"])
@example(["$x^2$ {y} ~ # <b>&amp;</b>", '"quoted", comma; **bold** `code`', "  - 1. item"])
@example(["[link](http://x.y) ![image](z)", "ends in a backslash \\", "[begins with a bracket]"])
@given(st.lists(texts, min_size=1, max_size=4))
def test_any_text_survives_every_form(names):
    table = _table(*names)
    (_, *rows) = csv.reader(io.StringIO(csv_text(table), newline=""))
    assert [row[0] for row in rows] == names
    assert [row[0] for row in _read_markdown(markdown(table))[1:]] == [*map(_plain, names)]
    quotes = [_plain(name).replace('"', "''") for name in names]
    assert [row[0] for row in _read_latex(latex(table))[1:]] == quotes


@pytest.mark.parametrize("note", ["# no heading", "- no list", "12. no list", "===", "+ no", "*"])
def test_captions_and_notes_are_paragraphs(note):
    reader = pytest.importorskip("markdown_it").MarkdownIt("commonmark").enable("table")
    table = Table((Column("x"),), ((1,),), caption=note, notes=(note, "a & b"))
    kinds = [token.type for token in reader.parse(markdown(table)) if token.level == 0]
    around = ["paragraph_open", "inline", "paragraph_close"]
    kinds = [kind for kind in kinds if kind not in around[1:]]
    assert kinds == ["paragraph_open", "table_open", "table_close", *["paragraph_open"] * 2]
    assert r"a \& b" in latex(table)


def test_headings_are_escaped_too():
    table = Table((Column("RPE_r", unit="% of A|B", better="lower"),), ((1.0,),))
    assert _read_markdown(markdown(table))[0] == ["RPE_r (% of A|B) ↓"]
    assert r"RPE\_r (\% of A\textbar{}B)~$\downarrow$ \\" in latex(table)
    assert csv_text(table).startswith("RPE_r (% of A|B)\r\n")


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ShapeError, match="row 2 has 1 values; expected 2"):
        Table((Column("a"), Column("b")), ((1, 2), (1,)))


def test_forms():
    assert set(FORMS) == {"csv", "markdown", "latex"}
    for form, function in FORMS.items():
        assert render(FIGURES, form) == function(FIGURES)
    with pytest.raises(OptionError, match="'html'; expected one of csv, markdown, latex"):
        render(FIGURES, "html")
