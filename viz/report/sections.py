"""The sections of a run's report: each takes what the report tells and gives HTML, perhaps none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from viz.plots.canvas import png
from viz.plots.growth import draw_growth
from viz.plots.quality import draw_quality, is_measured
from viz.plots.timing import draw_timing
from viz.plots.trajectories import draw_trajectories
from viz.report.contact_sheet import SUPPORT, WORST, color_scale, data_uri
from viz.report.content import RunReport
from viz.report.html_parts import NONE, bulleted, figure, folded, paragraph, table, text, tile

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 130
REGIONS = {"": "whole", "_valid": "observed", "_generated": "generated"}
# Of each measure its name, and what its values are multiplied by to be of the name's unit.
MEASURES = {
    "psnr": ("PSNR, dB", 1.0),
    "ssim": ("SSIM", 1.0),
    "lpips": ("LPIPS", 1.0),
    "depth_rel": ("depth error, %", 100.0),
}


def growth(report: RunReport) -> str:
    """What is stored, what became of the points, coverage and quality by round."""
    rounds = report.rounds
    plots = [
        (("stored",), "observations and voxels after each round, observed and generated apart"),
        (("fates",), "points added, merged and rejected in each round"),
        (("coverage",), "share of the target pixels that the memory supports, by round"),
    ]
    drawn = [_drawn(draw_growth(rounds, panels=panels), alt) for panels, alt in plots]
    if is_measured(report.measures.views):
        alt = "PSNR of observed and generated pixels, by round"
        drawn.append(_drawn(draw_quality(report.measures.views), alt))
    return _plots(drawn) + _round_table(report)


def _round_table(report: RunReport) -> str:
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
            *(_fixed(_mean(mine, f"psnr{region}"), 2) for region in regions),
            _fixed(entry["seconds"].get("total"), 2), f"{entry['bytes'] / 2**20:.1f}",
        ])  # fmt: skip
    content = (
        "Per round: what is stored after it, what became of its points, and means over its targets."
    )
    return table(columns, rows, caption=content)


def figures(report: RunReport) -> str:
    """Figures of observed and of generated pixels, over the targets and of each."""
    notes = bulleted(report.measures.notes) if report.measures.notes else ""
    rows = [
        [name, *(_cell(report, f"{measure}{region}", scale) for region in REGIONS)]
        for measure, (name, scale) in MEASURES.items()
    ]
    rows = [row for row in rows if any(cell != NONE for cell in row[1:])]
    means = ""
    if rows:
        content = f"Means over the targets, from {report.measures.source}"
        content += ", below each the 95 % interval of the mean" if report.measures.intervals else ""
        content += ". Depth errors are medians of a target's, relative to the true depth."
        means = table(["", *REGIONS.values()], rows, caption=content)
    return means + notes + _figures_of_each(report)


def _cell(report: RunReport, key: str, scale: float) -> str:
    value, interval = report.measures.figures.get(key), report.measures.intervals.get(key)
    if value is None:
        return NONE
    content = f"{value * scale:.4g}"
    if interval is not None:
        content += f"\n{interval[0] * scale:.3g}–{interval[1] * scale:.3g}"
    return content


def _figures_of_each(report: RunReport) -> str:
    if not report.measures.views:
        return ""
    known = [
        (f"{measure}{region}", f"{name}, {where}", scale)
        for measure, (name, scale) in MEASURES.items()
        for region, where in REGIONS.items()
        if any(view.get(f"{measure}{region}") is not None for view in report.measures.views)
    ]
    heads = ["target", "round", "coverage before", "after", *(head for _, head, _ in known)]
    rows = []
    for view in report.measures.views:
        values = [(view.get(key), scale) for key, _, scale in known]
        rows.append([
            view["name"], view["round"], _share(view["coverage"]), _share(view["coverage_after"]),
            *(None if value is None else value * scale for value, scale in values),
        ])  # fmt: skip
    return folded(f"each of {len(rows)} targets", table(heads, rows))


def pictures(report: RunReport) -> str:
    """The contact sheets, with their legend."""
    if not report.sheets.rows:
        return paragraph(report.sheets.note) if report.sheets.note else ""
    swatches = "".join(
        f'<span><span class="swatch" style="background:{color}"></span>{name}</span>'
        for name, color in SUPPORT.items()
    )
    scale = ""
    if any(shown.label == "error" for row in report.sheets.rows for shown in row.tiles):
        scale = (
            '<span>error, mean over the channels: 0<span class="scale" '
            f'style="background:{color_scale()}"></span>{WORST:.0%} of the range or more</span>'
        )
    legend = f'<div class="legend"><span>validity:</span>{swatches}{scale}</div>'
    rows = "".join(
        f'<div class="target"><h3>{text(row.heading)}</h3>'
        f'<div class="tiles">{"".join(map(tile, row.tiles))}</div></div>'
        for row in report.sheets.rows
    )
    return f"{paragraph(report.sheets.note)}{legend}{rows}"


def trajectories(report: RunReport) -> str:
    """Cameras from above and from the side, and the errors of estimated poses."""
    content = paragraph(report.poses.note) if report.poses.note else ""
    if report.poses.drawn is None:
        return content
    drawn = [
        _drawn(
            draw_trajectories(report.poses.drawn, panels=[name]),
            f"cameras {where}: context, requested and estimated",
        )
        for name, where in (("top", "from above"), ("side", "from the side"))
    ]
    errors = ""
    if report.poses.errors:
        errors = table(["estimated poses", "completed pictures", "true pictures"],
                       report.poses.errors)  # fmt: skip
    return content + _plots(drawn) + errors


def time(report: RunReport) -> str:
    """A bar for each stage, and each round's stages."""
    drawn = [
        _drawn(draw_timing(report.rounds, panels=[name]), f"seconds by stage, {over}")
        for name, over in (("stages", "whole run"), ("rounds", "each round"))
    ]
    return _plots(drawn)


def settings(report: RunReport) -> str:
    """Those that differ from the defaults, and all of them folded."""
    if report.changed:
        shown = table(["setting", "value", "default"], report.changed)
    else:
        shown = paragraph("All as by default.")
    every = folded(
        f"all {len(report.settings)} settings",
        table(["setting", "value"], list(report.settings.items())),
    )
    return f'<div class="settings">{shown}{every}</div>'


def _drawn(plot: Figure, alt: str) -> str:
    return figure(data_uri(png(plot, dpi=DPI), "image/png"), alt)


def _plots(drawn: Sequence[str]) -> str:
    return f'<div class="plots">{"".join(drawn)}</div>'


def _mean(views: Sequence[Mapping[str, Any]], key: str) -> float | None:
    values = [view[key] for view in views if view.get(key) is not None]
    return sum(values) / len(values) if values else None


def _share(value: float | None) -> str:
    return NONE if value is None else f"{value:.1%}"


def _fixed(value: float | None, digits: int) -> str:
    return NONE if value is None else f"{value:.{digits}f}"
