from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from gvtools.evaluation.statistics import mean_interval
from gvtools.evaluation.tables import (
    Column,
    Ranked,
    Table,
    csv_text,
    latex,
    markdown,
)

FIGURES = Table(
    (
        Column("System"),
        Column("PSNR", unit="dB", better="higher", digits=2),
        Column("ATE", better="lower", digits=3),
        Column("n"),
    ),
    (
        ("ours", Ranked(19.605, 1), Ranked(0.0281234567, 1), 3),
        ("theirs", Ranked(17.0, 2), Ranked(None), 12),
        ("none", None, float("nan"), None),
    ),
    caption="A comparison",
    notes=("One note.",),
)


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
    lines = latex(FIGURES).splitlines()
    assert lines[:3] == [r"\begin{table}", r"  \centering", r"  \caption{A comparison}"]
    assert [line.strip() for line in lines[3:-1]] == [
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
        (-1.25, 1, "-1.2", "$-1.2$"),
        (float("inf"), 2, "∞", r"$\infty$"),
        (1234.5678, None, "1235", "1235"),
        (1.2e9, None, "1.2e+09", r"$1.2\cdot10^{9}$"),
        (-7, 2, "-7", "$-7$"),
    ],
)
def test_numbers_as_readers_see_them(value, digits, shown, in_latex):
    table = Table((Column("x", digits=digits),), ((Ranked(value),),))
    assert markdown(table).splitlines()[-1] == f"| {shown} |"
    assert latex(table).splitlines()[6].strip() == f"{in_latex} \\\\"
    assert float(next(csv.reader([csv_text(table).splitlines()[1]]))[0]) == value


@pytest.mark.parametrize("note", ["# no heading", "- no list", "12. no list", "===", "+ no", "*"])
def test_captions_and_notes_are_paragraphs(note):
    reader = pytest.importorskip("markdown_it").MarkdownIt("commonmark").enable("table")
    table = Table((Column("x"),), ((1,),), caption=note, notes=(note, "a & b"))
    kinds = [token.type for token in reader.parse(markdown(table)) if token.level == 0]
    around = ["paragraph_open", "inline", "paragraph_close"]
    kinds = [kind for kind in kinds if kind not in around[1:]]
    assert kinds == ["paragraph_open", "table_open", "table_close", *["paragraph_open"] * 2]
    assert r"a \& b" in latex(table)


@pytest.mark.parametrize(
    ("text", "in_markdown", "in_latex"),
    [
        (r"a & b % c_d | e", r"a \& b % c\_d \| e", r"a \& b \% c\_d \textbar{} e"),
        ("two\nlines\r\nand\ttab", "two lines and tab", "two lines and tab"),
        (r"back\slash {y} ~^#", r"back\\slash {y} \~^\#",
         r"back\textbackslash{}slash \{y\} \textasciitilde{}\textasciicircum{}\#"),
        ("$x$ <b> **bold** [link]", r"\$x\$ \<b\> \*\*bold\*\* \[link\]",
         r"\$x\$ \textless{}b\textgreater{} {*}{*}bold{*}{*} {[}link]"),
        ('"said" `code`', r'"said" \`code\`', "''said'' `code`"),
    ],
)  # fmt: skip
def test_any_text_survives_every_form(text, in_markdown, in_latex):
    table = Table((Column(text), Column("x", unit="%", better="lower")), ((text, 1.0),))
    heads, row = csv.reader(io.StringIO(csv_text(table), newline=""))
    assert (heads[0], row[0]) == (text, text)
    lines = markdown(table).splitlines()
    assert lines[0] == f"| {in_markdown} | x (%) ↓ |" and lines[2] == f"| {in_markdown} | 1 |"
    lines = latex(table).splitlines()
    assert lines[4].strip() == rf"{in_latex} & x (\%)~$\downarrow$ \\"
    assert lines[6].strip() == rf"{in_latex} & 1 \\"


def test_the_interval_holds_the_mean_of_the_population_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    held = 0
    for trial in range(200):
        found = mean_interval(rng.normal(3, 1, 30), seed=trial)
        held += found.low <= 3 <= found.high
    assert 175 <= held <= 200


def test_more_values_narrow_it_and_the_seed_decides_it():
    values = np.random.default_rng(1).normal(size=400)
    few, many = mean_interval(values[:10]), mean_interval(values)
    assert few.high and few.low and many.high and many.low
    assert few.high - few.low > many.high - many.low
    assert mean_interval(values, seed=3) == mean_interval(values, seed=3)
    assert mean_interval(values, seed=3) != mean_interval(values, seed=4)


def test_what_is_not_there_is_left_out_and_counted():
    found = mean_interval([1.0, None, 3.0, float("nan")])
    assert (found.mean, found.n) == (2.0, 2)
    assert mean_interval([]) == mean_interval([None])
    assert mean_interval([]).mean is None
    one = mean_interval([5.0])
    assert (one.mean, one.low, one.n) == (5.0, None, 1)
    same = mean_interval([2.0, 2.0])
    assert same.low == same.high == pytest.approx(2)
