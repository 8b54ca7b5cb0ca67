"""Pages of a run and of a benchmark: one HTML file that asks the network for nothing.

What a page tells is data alone, read by whoever has the run's folder. Its text may come from a
user's files: the templates escape all of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.evaluation.tables import Ranked, Table, shown
from viz.plots.canvas import Rounds, png
from viz.plots.curves import Point, draw_by_views
from viz.plots.rounds import draw_growth, draw_quality, draw_timing, is_measured
from viz.plots.trajectories import Trajectories, draw_trajectories
from viz.report.pictures import SUPPORT, WORST, Thumbnail, data_uri, error_colors

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure

DPI = 130
# What a figure that could not be had is shown as.
NONE = "–"
REGIONS = {"": "whole", "_valid": "observed", "_generated": "generated"}
# Of each measure its name, and what its values are multiplied by to be of the name's unit.
MEASURES = {
    "psnr": ("PSNR, dB", 1.0),
    "ssim": ("SSIM", 1.0),
    "lpips": ("LPIPS", 1.0),
    "depth_rel": ("depth error, %", 100.0),
}

# Columns, rows with a name first, and a caption above, as the template's table takes them.
Grid = tuple[Sequence[str], Sequence[Sequence[object]], str]
# A picture as a data URI, and what it shows.
Plot = tuple[str, str]


@dataclass(frozen=True)
class SheetRow:
    """Pictures of one target under a heading."""

    heading: str
    tiles: Sequence[Thumbnail]


@dataclass(frozen=True)
class Sheets:
    """Targets whose pictures are shown."""

    rows: Sequence[SheetRow] = ()
    note: str = ""  # which targets they are, and where the others lie
    warnings: Sequence[str] = ()  # pictures that could not be read


@dataclass(frozen=True)
class Measures:
    """Figures measured on a run's targets."""

    source: str | None = None  # the file; None where nothing was measured
    figures: Mapping[str, float | None] = field(default_factory=dict)  # means over the targets
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # 95 %, of the means
    views: Sequence[Mapping[str, Any]] = ()  # figures of each target
    notes: Sequence[str] = ()  # why figures are absent
    poses: Mapping[str, Any] | None = None  # of the pose probe; None where it was not asked
    # Files that belong to another state of the run, or cannot be read.
    warnings: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class ReportedPoses:
    """Cameras of a run, and errors of estimated ones."""

    cameras: Trajectories | None = None
    note: str = ""  # what is shown, or why nothing is
    # Rows of (error, of the completed pictures, of the true ones).
    errors: Sequence[tuple[str, float | None, float | None]] = ()


@dataclass(frozen=True, eq=False)
class RunReport:
    """All that a run's report tells."""

    title: str
    facts: Sequence[tuple[str, str]]  # what was run, by name, in order
    rounds: Rounds  # whole rounds, the context's (round 0) first; at least that one
    changed: Sequence[tuple[str, str, str]]  # (setting, value, default) where they differ
    settings: Mapping[str, str]  # all of them, by dotted name
    warnings: Sequence[str]
    measures: Measures
    sheets: Sheets
    poses: ReportedPoses


@dataclass(frozen=True, kw_only=True)
class BenchmarkPage:
    """All that a benchmark's page tells."""

    title: str
    facts: Sequence[tuple[str, str]]  # what was measured, by name, in order
    tables: Mapping[str, Table]  # those named ``N_views`` come first, the others folded
    lines: Mapping[str, Sequence[Point]]  # PSNR over the number of context views, by method
    pictures: Sequence[SheetRow]  # one row a scene and number of views


def report_html(report: RunReport) -> str:
    """The page of a run."""
    rounds, views = report.rounds, report.measures.views
    growth = [
        _plot(draw_growth(rounds, panels=[panel]), alt)
        for panel, alt in (
            ("stored", "observations and voxels after each round, observed and generated apart"),
            ("fates", "points added, merged and rejected in each round"),
            ("coverage", "share of the target pixels that the memory supports, by round"),
        )
    ]
    if is_measured(views):
        alt = "PSNR of observed and generated pixels, by round"
        growth.append(_plot(draw_quality(views), alt))
    cameras = report.poses.cameras
    return _templates().get_template("run.html").render(
        report=report,
        key_figures=_key_figures(report),
        growth=growth,
        rounds=_round_table(report),
        means=_means(report.measures),
        each=_figures_of_each(views),
        support=SUPPORT,
        errors=any(one.label == "error" for row in report.sheets.rows for one in row.tiles),
        cameras=[
            _plot(
                draw_trajectories(cameras, panels=[panel]),
                f"cameras {where}: context, requested and estimated",
            )
            for panel, where in (("top", "from above"), ("side", "from the side"))
            if cameras is not None
        ],
        time=[
            _plot(draw_timing(rounds, panels=[panel]), f"seconds by stage, {over}")
            for panel, over in (("stages", "whole run"), ("rounds", "each round"))
        ],
    )  # fmt: skip


def benchmark_html(page: BenchmarkPage) -> str:
    """The page of a benchmark."""
    lines = None
    if any(len(points) > 1 for points in page.lines.values()):
        alt = "PSNR over the number of context views, by method, with intervals"
        lines = _plot(draw_by_views(page.lines), alt)
    tables = {
        name: {"grid": _ranked(content), "caption": content.caption, "notes": content.notes}
        for name, content in page.tables.items()
    }
    return _templates().get_template("benchmark.html").render(page=page, lines=lines, tables=tables)


@cache
def _templates() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        finalize=_as_text,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"error_colors": error_colors, "worst_error": f"{WORST:.0%}"}
    return environment


def _as_text(value: Any) -> Any:
    """Anything as text: None as a dash, floats with four significant digits, lines kept."""
    from markupsafe import Markup, escape

    if isinstance(value, Markup):
        return value
    if value is None or value != value:
        return NONE
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, int) and not isinstance(value, bool):
        # Narrow spaces between thousands.
        return f"{value:,}".replace(",", "\u202f")
    return Markup(str(escape(str(value))).replace("\n", "<br>"))


def _plot(figure: Figure, alt: str) -> Plot:
    return data_uri(png(figure, dpi=DPI), "image/png"), alt


def _key_figures(report: RunReport) -> list[tuple[str, object]]:
    last, measured = report.rounds[-1], report.measures.figures
    seconds = sum(entry["seconds"].get("total") or 0 for entry in report.rounds)
    covered = [view["coverage"] for entry in report.rounds for view in entry["views"]]
    sources = [name for name in ("scanned", "generated") if name == "generated" or last.get(name)]
    return [
        ("observations", last["points"]),
        *((f"of them {name}", f"{last[name] / max(1, last['points']):.1%}") for name in sources),
        ("coverage before a round", _share(sum(covered) / len(covered) if covered else None)),
        *(
            (f"PSNR, {where}", f"{measured[f'psnr{region}']:.2f} dB")
            for region, where in REGIONS.items()
            if measured.get(f"psnr{region}") is not None
        ),
        ("seconds of all rounds", f"{seconds:.1f}"),
    ]


def _round_table(report: RunReport) -> Grid:
    regions = REGIONS if is_measured(report.measures.views) else {}
    scanned = any(entry.get("scanned") for entry in report.rounds)
    sources = ("observed", "scanned", "generated") if scanned else ("observed", "generated")
    columns = [
        "round", "targets", "voxels", *sources, "added", "merged", "rejected",
        "coverage before", "coverage after", *(f"PSNR {where}, dB" for where in regions.values()),
        "seconds", "memory, MiB",
    ]  # fmt: skip
    rows = []
    for entry in report.rounds:
        mine = [view for view in report.measures.views if view["round"] == entry["round"]]
        rows.append([
            entry["round"], len(entry["views"]), entry["voxels"],
            *(entry[name] for name in (*sources, "added", "merged", "rejected")),
            _share(entry["coverage_before"]), _share(entry["coverage_after"]),
            *(_fixed(_mean(mine, f"psnr{region}")) for region in regions),
            _fixed(entry["seconds"].get("total")), f"{entry['bytes'] / 2**20:.1f}",
        ])  # fmt: skip
    caption = (
        "Per round: what is stored after it, what became of its points, and means over its targets."
    )
    return columns, rows, caption


def _means(measures: Measures) -> Grid | None:
    """Means over the targets, of observed and of generated pixels."""
    rows = [
        [name, *(_mean_cell(measures, f"{measure}{region}", scale) for region in REGIONS)]
        for measure, (name, scale) in MEASURES.items()
    ]
    rows = [row for row in rows if any(cell != NONE for cell in row[1:])]
    caption = f"Means over the targets, from {measures.source}"
    caption += ", below each the 95 % interval of the mean" if measures.intervals else ""
    caption += ". Depth errors are medians of a target's, relative to the true depth."
    return (["", *REGIONS.values()], rows, caption) if rows else None


def _mean_cell(measures: Measures, key: str, scale: float) -> str:
    value, interval = measures.figures.get(key), measures.intervals.get(key)
    if value is None:
        return NONE
    content = f"{value * scale:.4g}"
    if interval is not None:
        content += f"\n{interval[0] * scale:.3g}–{interval[1] * scale:.3g}"
    return content


def _figures_of_each(views: Sequence[Mapping[str, Any]]) -> Grid | None:
    known = [
        (f"{measure}{region}", f"{name}, {where}", scale)
        for measure, (name, scale) in MEASURES.items()
        for region, where in REGIONS.items()
        if any(view.get(f"{measure}{region}") is not None for view in views)
    ]
    heads = ["target", "round", "coverage before", "after", *(head for _, head, _ in known)]
    rows = []
    for view in views:
        values = [(view.get(key), scale) for key, _, scale in known]
        rows.append([
            view["name"], view["round"], _share(view["coverage"]), _share(view["coverage_after"]),
            *(None if value is None else value * scale for value, scale in values),
        ])  # fmt: skip
    return (heads, rows, "") if rows else None


def _ranked(content: Table) -> Grid:
    """A table whose values are followed by their ranks, #1 the best."""
    arrows = {"higher": " ↑", "lower": " ↓", None: ""}
    heads = [column.heading + arrows[column.better] for column in content.columns]
    rows = [
        [
            shown(column, value)
            + (f" #{value.rank}" if isinstance(value, Ranked) and value.rank is not None else "")
            for column, value in zip(content.columns, row, strict=True)
        ]
        for row in content.rows
    ]
    return heads, rows, content.caption


def _mean(views: Sequence[Mapping[str, Any]], key: str) -> float | None:
    values = [view[key] for view in views if view.get(key) is not None]
    return sum(values) / len(values) if values else None


def _share(value: float | None) -> str:
    return NONE if value is None else f"{value:.1%}"


def _fixed(value: float | None) -> str:
    return NONE if value is None else f"{value:.2f}"
