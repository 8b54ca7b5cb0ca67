"""The tables of a judgement: methods side by side, differences, means with intervals, views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gvtools.evaluation.tables import Cell, Column, Table, Value, markdown
from pipelines.evaluation.picture_figures import JUDGED
from pipelines.evaluation.tables import BETTER, DIGITS, UNITS, summary_table
from pipelines.report.nested import nested

if TYPE_CHECKING:
    from pipelines.console import Console

Figures = Mapping[str, Any]

# Heading, unit, better, decimals, and where a measured method has the figure.
SIDE_BY_SIDE: tuple[tuple[str, str, str, int, tuple[str, ...]], ...] = (
    ("PSNR", "dB", "higher", 2, ("images", "mean", "psnr", "mean")),
    ("SSIM", "", "higher", 3, ("images", "mean", "ssim", "mean")),
    ("LPIPS", "", "lower", 3, ("images", "mean", "lpips", "mean")),
    ("PSNR, observed", "dB", "higher", 2, ("images", "mean", "psnr_valid", "mean")),
    ("PSNR, never observed", "dB", "higher", 2,
     ("images", "mean", "psnr_never_observed", "mean")),
    ("feature consistency", "", "lower", 3,
     ("consistency", "generated", "feature_consistency", "score", "mean")),
    ("located", "share", "higher", 3, ("poses", "success_share")),
    ("rotation error", "degrees", "lower", 3, ("poses", "rotation_error_deg", "median")),
    ("centre error", "scene units", "lower", 4, ("poses", "center_error", "median")),
)  # fmt: skip


def judge_tables(figures: Figures) -> dict[str, Table]:
    """The tables by name: side_by_side, differences, means, views.

    Args:
        figures: what ``judge.json`` holds.
    """
    methods = figures["methods"]
    tables = {"side_by_side": side_by_side(figures)}
    if figures["differences"]:
        tables["differences"] = _differences(figures["differences"])
    tables["means"] = summary_table(methods, "Means with intervals", {})
    if any("images" in method for method in methods):
        tables["views"] = _views(methods)
    return tables


def side_by_side(figures: Figures) -> Table:
    """One row a method, and one of the true pictures where they were measured."""
    methods, total = figures["methods"], len(figures["targets"])
    shown = [row for row in SIDE_BY_SIDE if any(nested(m, *row[4]) is not None for m in methods)]
    columns = [Column("method"), Column("views"), Column("matched by")]
    columns += [Column(title, unit, better, digits) for title, unit, better, digits, _ in shown]
    ranks = [_ranks(methods, path, better=better, total=total) for _, _, better, _, path in shown]
    rows: list[tuple[Value, ...]] = []
    for number, method in enumerate(methods):
        cells = [
            Cell(nested(method, *path), rank[number])
            for (_, _, _, _, path), rank in zip(shown, ranks, strict=True)
        ]
        views = f"{method['views']} of {total}"
        rows.append((method["name"], views, method["matched_by"], *cells))
    control = [_control(methods[0], path) for _, _, _, _, path in shown]
    if any(value is not None for value in control):
        rows.append(("true pictures", f"{figures['with_truth']} of {total}", "–", *control))
    return Table(tuple(columns), tuple(rows), "Side by side", tuple(_notes(figures)))


def _ranks(
    methods: Sequence[Figures], path: Sequence[str], *, better: str, total: int
) -> list[int | None]:
    """Ranks of the methods that have a picture of every view; of the others None."""
    values = [nested(m, *path) if m["views"] == total else None for m in methods]
    known = sorted((v for v in values if v is not None), reverse=better == "higher")
    if len(known) < 2:
        return [None] * len(values)
    return [None if value is None else known.index(value) + 1 for value in values]


def _control(method: Figures, path: Sequence[str]) -> float | None:
    if path[0] == "consistency":
        path = ("consistency", "true_pictures", *path[2:])
    elif path[0] == "poses":
        path = ("poses", "true_pictures", *path[1:])
    else:
        return None
    value: float | None = nested(method, *path)
    return value


def _notes(figures: Figures) -> list[str]:
    """How each method was read and matched, and what its figures lack."""
    total, notes = len(figures["targets"]), []
    for method in figures["methods"]:
        parts = [f"{method['layout']}, matched by {method['matched_by']}"]
        if method["missing"]:
            parts.append(
                f"no picture of {len(method['missing'])} of {total} views, means are over the "
                "others and have no rank"
            )
        if method["left_over"]:
            parts.append(f"{len(method['left_over'])} pictures of no judged view left out")
        for entry in method["resized"]:
            width, height = entry["from"]
            parts.append(f"{entry['pictures']} pictures of {width}x{height} pixels resized")
        notes.append(f"{method['name']}: {'; '.join([*parts, *method['reading']])}")
        reasons = nested(method, "images", "notes") or {}
        notes += [f"{key}: {why}" for key, why in reasons.items() if key == "lpips"]
    if figures["poses"] != "recorded":
        notes.append(
            f"poses are {figures['poses']}: pictures rendered at recorded ones look from somewhere "
            "else, and their errors of poses and matches tell so"
        )
    return list(dict.fromkeys(notes))


def _differences(entries: Sequence[Figures]) -> Table:
    columns = (
        Column("first"), Column("second"), Column("figure"), Column("first - second", digits=4),
        Column("low", digits=4), Column("high", digits=4), Column("views"),
        Column("first better, share", digits=3),
    )  # fmt: skip
    keys = ("first", "second", "figure", "mean", "low", "high", "n", "first_better")
    rows = tuple(tuple(entry[key] for key in keys) for entry in entries)
    note = (
        "mean of the differences on the views that both have; low and high: its 95 % bootstrap "
        "interval over views, one figure at a time"
    )
    return Table(columns, rows, "Differences", (note,))


def _views(methods: Sequence[Figures]) -> Table:
    plain = ("name", "round", "observed")
    columns = [Column("method"), Column("view"), Column("round"), Column("observed", digits=3)]
    for figure in JUDGED:
        kind = figure.split("_")[0]
        columns.append(Column(figure, UNITS.get(kind, ""), BETTER[kind], DIGITS[kind]))
    rows = [
        (method["name"], *(view[name] for name in (*plain, *JUDGED)))
        for method in methods
        for view in nested(method, "images", "views") or ()
    ]
    return Table(tuple(columns), tuple(rows), "Views")


def judge_markdown(figures: Figures, tables: Mapping[str, Table], sheets: Sequence[str]) -> str:
    """The page ``judge.md``.

    Args:
        figures: what ``judge.json`` holds.
        tables: of these.
        sheets: file names of the contact sheets, beside the page.
    """
    head = (
        f"Judged against `{figures['against']}`: {len(figures['context'])} context views, "
        f"{len(figures['targets'])} targets, {figures['with_truth']} with a true picture."
    )
    parts = ["# Judgement", head]
    shown = [tables[name] for name in ("side_by_side", "differences") if name in tables]
    parts += [markdown(table) for table in (*shown, _for_readers(tables["means"]))]
    parts += [f"![Contact sheet {number}]({name})" for number, name in enumerate(sheets, start=1)]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _for_readers(means: Table) -> Table:
    """The means without the rounds' columns and without figures that no view has."""
    columns = [i for i, c in enumerate(means.columns) if not c.title.startswith("round ")]
    at = [column.title for column in means.columns].index("mean")
    rows = [tuple(row[i] for i in columns) for row in means.rows if row[at] is not None]
    return Table(tuple(means.columns[i] for i in columns), tuple(rows), means.caption)


def printed(tables: Mapping[str, Table], console: Console) -> None:
    """Print the methods side by side, and their differences in PSNR."""
    table = tables["side_by_side"]
    rows = [[v.value if isinstance(v, Cell) else v for v in row] for row in table.rows]
    console.table([column.heading for column in table.columns], rows)
    for note in table.notes:
        console.line(f"  {note}")
    if "differences" in tables:
        apart = tables["differences"]
        shown: list[Sequence[Any]] = [row for row in apart.rows if str(row[2]).startswith("psnr")]
        console.table([column.heading for column in apart.columns], shown)
