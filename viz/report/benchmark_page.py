"""The page of a benchmark: one HTML file with its tables and pictures that asks nobody anything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gvtools.evaluation.tables import Cell, Table, shown
from viz.plots.by_views import Point, draw_by_views
from viz.plots.canvas import png
from viz.report.contact_sheet import WORST, Tile, color_scale, data_uri
from viz.report.html_parts import (
    bulleted,
    document,
    figure,
    folded,
    paragraph,
    section,
    table,
    text,
    tile,
)


@dataclass(frozen=True)
class PictureRow:
    """Pictures of one target under a heading."""

    heading: str
    tiles: Sequence[Tile]


@dataclass(frozen=True, kw_only=True)
class BenchmarkPage:
    """What the page tells.

    Attributes:
        title: above all.
        facts: what was measured, by name, in order.
        tables: by name; those named ``N_views`` come first, the others folded.
        lines: PSNR over the number of context views, by method.
        pictures: one row a scene and number of views.
    """

    title: str
    facts: Sequence[tuple[str, str]]
    tables: Mapping[str, Table]
    lines: Mapping[str, Sequence[Point]]
    pictures: Sequence[PictureRow]


def benchmark_html(page: BenchmarkPage) -> str:
    """The page."""
    parts = [("figures", "Figures", _figures(page))]
    if page.pictures:
        parts.append(("pictures", "Pictures", _pictures(page)))
    links = "".join(f'<a href="#{name}">{text(head)}</a>' for name, head, _ in parts)
    facts = paragraph("; ".join(f"{name} {value}" for name, value in page.facts), "quiet")
    body = "\n".join(section(*part) for part in parts)
    return document(page.title, f"{facts}\n<nav>{links}</nav>\n{body}")


def _figures(page: BenchmarkPage) -> str:
    parts = []
    if any(len(points) > 1 for points in page.lines.values()):
        plot = png(draw_by_views(page.lines), dpi=130)
        alt = "PSNR over the number of context views, by method, with intervals"
        parts.append(f'<div class="plots">{figure(data_uri(plot, "image/png"), alt)}</div>')
    for name, one in page.tables.items():
        content = table_html(one)
        parts.append(content if name.endswith("_views") else folded(one.caption, content))
    return "".join(parts)


def table_html(content: Table) -> str:
    """A table with its caption and notes; the rank stands behind a value, #1 the best."""
    arrows = {"higher": " ↑", "lower": " ↓", None: ""}
    heads = [column.heading + arrows[column.better] for column in content.columns]
    rows = [
        [
            shown(column, value)
            + (f" #{value.rank}" if isinstance(value, Cell) and value.rank is not None else "")
            for column, value in zip(content.columns, row, strict=True)
        ]
        for row in content.rows
    ]
    notes = folded("notes", bulleted(content.notes)) if content.notes else ""
    return table(heads, rows, caption=content.caption) + notes


def _pictures(page: BenchmarkPage) -> str:
    legend = (
        '<div class="legend"><span>error, mean over the channels: 0<span class="scale" '
        f'style="background:{color_scale()}"></span>{WORST:.0%} of the range or more</span></div>'
    )
    note = paragraph("Of each scene the target in the middle, and the given view in the middle.")
    rows = "".join(
        f'<div class="target"><h3>{text(row.heading)}</h3>'
        f'<div class="tiles">{"".join(map(tile, row.tiles))}</div></div>'
        for row in page.pictures
    )
    return note + legend + rows
