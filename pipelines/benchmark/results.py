"""What a benchmark writes: comparison with published rows, intervals, scenes, an HTML page."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gvtools.evaluation.intervals import Interval, mean_interval
from gvtools.evaluation.published import Benchmark
from gvtools.evaluation.ranking import (
    MEASURED,
    MeasuredRow,
    Setting,
    SideBySideRow,
    comparison_notes,
    side_by_side,
)
from gvtools.evaluation.tables import Cell as Ranked
from gvtools.evaluation.tables import Column, Table, Value
from gvtools.files import write_json
from pipelines.benchmark.cells import FAILED, read_cell
from pipelines.benchmark.measure import Cell
from pipelines.console import Console
from pipelines.evaluation.tables import write_tables

RESULTS, PAGE = "results.json", "index.html"
MIB = 2**20


@dataclass(frozen=True, kw_only=True)
class MethodResult:
    """One method with one number of context views, over the scenes.

    Attributes:
        row: means over the scenes, and how they were measured.
        intervals: by figure, the mean over the scenes that have it with its bootstrap interval.
        seconds: mean wall-clock time of a run; None for pictures that were made elsewhere.
        peak_bytes: most main memory of any run; None likewise.
        failures: by scene that failed, why.
        scenes: by scene that was measured, what ``measure_cell`` returned.
    """

    row: MeasuredRow
    intervals: Mapping[str, Interval]
    seconds: float | None
    peak_bytes: int | None
    failures: Mapping[str, str]
    scenes: Mapping[str, Mapping[str, Any]]


def collected(benchmark: Benchmark, cells: Sequence[Cell]) -> list[MethodResult]:
    """The results of the methods, in the cells' order, without methods not yet measured.

    Args:
        benchmark: with one number of context views; cells with another are ignored.
        cells: of all methods and numbers of views.
    """
    own = [cell for cell in cells if cell.views == benchmark.context]
    names = dict.fromkeys(cell.method.name for cell in own)
    results = []
    for name in names:
        mine = [cell for cell in own if cell.method.name == name]
        read = {cell.scene: read_cell(cell) for cell in mine}
        found = {scene: result for scene, result in read.items() if result is not None}
        if found:
            results.append(_result(benchmark, name, found, lpips=mine[0].lpips))
    return results


def _result(
    benchmark: Benchmark, name: str, found: Mapping[str, Mapping[str, Any]], *, lpips: Any
) -> MethodResult:
    failures = {s: str(r["reason"]) for s, r in found.items() if r["status"] == FAILED}
    scenes = {scene: result for scene, result in found.items() if scene not in failures}
    names = dict.fromkeys([*benchmark.figures, "psnr_observed", "coverage"])
    names |= dict.fromkeys(name for result in scenes.values() for name in result["figures"])
    intervals = {
        figure: mean_interval([r["figures"].get(figure) for r in scenes.values()])
        for figure in names
    }
    # A figure that some scenes lack has no mean: it would be over other scenes than other methods'.
    figures = {
        figure: interval.mean if interval.n == len(scenes) else None
        for figure, interval in intervals.items()
    }
    seconds = [r["seconds"] for r in scenes.values() if r.get("seconds") is not None]
    peaks = [r["peak_bytes"] for r in scenes.values() if r.get("peak_bytes") is not None]
    setting = _setting(benchmark, list(scenes.values()), failed=len(failures), lpips=lpips)
    return MethodResult(
        row=MeasuredRow(name, figures, setting),
        intervals=intervals,
        seconds=sum(seconds) / len(seconds) if seconds else None,
        peak_bytes=max(peaks, default=None),
        failures=failures,
        scenes=scenes,
    )


def _setting(
    benchmark: Benchmark, results: Sequence[Mapping[str, Any]], *, failed: int, lpips: Any
) -> Setting:
    sizes = {tuple(result["resolution"] or ()) for result in results}
    size = sizes.pop() if len(sizes) == 1 else ()
    rounds = [names for result in results for names in result["split"]["rounds"]]
    per_round = {len(names) for names in rounds}
    poses = {result["poses_from"] for result in results}
    met3r = {result["met3r"] for result in results}
    masked = any(result.get("masked_share") for result in results)
    return Setting(
        data_set=benchmark.name,
        resolution=(size[0], size[1]) if size else None,
        context=benchmark.context,
        targets=per_round.pop() if len(per_round) == 1 else None,
        rounds=benchmark.rounds,
        scenes=len(results),
        failed=failed,
        split=benchmark.name,
        divided_by=benchmark.split_of(benchmark.context).divided_by,
        pixels="inside masks" if masked else "all",
        mask="object" if results and all(result["masked"] for result in results) else None,
        lpips_net=None if lpips is None else lpips[0],
        poses_from="; ".join(sorted(filter(None, poses))) or None,
        pose_unit="scene units",
        met3r="original" if met3r == {"measured"} else None,
        hardware=f"{os.cpu_count()} CPU cores",
    )


def comparison(benchmark: Benchmark, results: Sequence[MethodResult]) -> Table:
    """A table of published and measured rows, with ranks where they are comparable.

    Args:
        benchmark: with one number of context views.
        results: of the methods.
    """
    rows = side_by_side([result.row for result in results], benchmark)
    by_name = {result.row.system: result for result in results}
    first, *others = benchmark.figures.values()
    columns = [Column("System"), Column("Origin"), _column(first)]
    columns += [Column(f"{first.label} {end}", digits=first.digits) for end in ("low", "high")]
    columns += [_column(figure) for figure in others]
    columns += [Column("Observed", "dB", digits=2), Column("Coverage", digits=3),
                Column("A run", "s", digits=1), Column("Peak", "MiB", digits=0),
                Column("Scenes")]  # fmt: skip
    body = [_cells(row, benchmark, by_name.get(row.system)) for row in rows]
    notes = [
        f"{first.label} low and high: 95 % bootstrap interval of the mean over scenes. Observed: "
        "PSNR of the pixels that stand on observations. A run: mean wall-clock seconds. Peak: the "
        "most main memory of any run.",
        *(f"{result.row.system}, {scene}: failed: {reason}" for result in results
          for scene, reason in result.failures.items()),
        *comparison_notes(rows, benchmark),
    ]  # fmt: skip
    caption = f"{benchmark.name}, {benchmark.context} context views"
    return Table(tuple(columns), tuple(body), caption, tuple(notes))


def _column(figure: Any) -> Column:
    return Column(figure.label, unit=figure.unit, better=figure.better, digits=figure.digits)


def _cells(
    row: SideBySideRow, benchmark: Benchmark, result: MethodResult | None
) -> tuple[Value, ...]:
    ranked = [Ranked(row.figures[name], row.ranks[name]) for name in benchmark.figures]
    if row.origin != MEASURED or result is None:
        return (row.system, row.origin, ranked[0], None, None, *ranked[1:], *[None] * 5)
    interval = result.intervals[next(iter(benchmark.figures))]
    peak = None if result.peak_bytes is None else result.peak_bytes / MIB
    return (
        row.system, row.origin, ranked[0], interval.low, interval.high, *ranked[1:],
        result.row.figures["psnr_observed"], result.row.figures["coverage"], result.seconds, peak,
        len(result.scenes),
    )  # fmt: skip


def interval_table(benchmark: Benchmark, by_views: Mapping[int, Sequence[MethodResult]]) -> Table:
    """For each number of views, method and figure one row: mean over scenes, its interval."""
    columns = (Column("views"), Column("method"), Column("figure"), Column("mean", digits=4),
               Column("low", digits=4), Column("high", digits=4), Column("scenes"))  # fmt: skip
    rows: list[tuple[Value, ...]] = []
    for views, results in by_views.items():
        for result in results:
            for name, interval in result.intervals.items():
                if interval.n:
                    ends = interval.mean, interval.low, interval.high, interval.n
                    rows.append((views, result.row.system, name, *ends))
    return Table(columns, tuple(rows), f"{benchmark.name}: means over scenes")


def scene_table(benchmark: Benchmark, by_views: Mapping[int, Sequence[MethodResult]]) -> Table:
    """One row for each cell that was tried: its figures, or why it failed."""
    figures = list(benchmark.figures.values())
    columns = [Column("scene"), Column("views"), Column("method")]
    columns += [_column(figure) for figure in figures]
    columns += [Column("Observed", "dB", digits=2), Column("Coverage", digits=3),
                Column("A run", "s", digits=1), Column("Peak", "MiB", digits=0),
                Column("targets"), Column("note")]  # fmt: skip
    rows: list[tuple[Value, ...]] = []
    for views, results in by_views.items():
        for result in results:
            for scene, one in result.scenes.items():
                peak = one.get("peak_bytes")
                values = [one["figures"].get(f.name) for f in figures]
                rows.append((
                    scene, views, result.row.system, *values, one["figures"].get("psnr_observed"),
                    one["figures"].get("coverage"), one.get("seconds"),
                    None if peak is None else peak / MIB, len(one["views"]), "",
                ))  # fmt: skip
            for scene, reason in result.failures.items():
                gaps = [None] * (len(figures) + 5)
                rows.append((scene, views, result.row.system, *gaps, f"failed: {reason}"))
    rows.sort(key=lambda row: (str(row[0]), row[1]))
    return Table(tuple(columns), tuple(rows), f"{benchmark.name}: scenes")


def write_results(
    benchmark: Benchmark, cells: Sequence[Cell], out: Path, *, title: str
) -> dict[int, Table]:
    """Write results.json, the tables (CSV, Markdown, LaTeX), and the HTML page.

    Args:
        benchmark: of the cells.
        cells: all, measured or not.
        out: folder of the benchmark's results.
        title: of the page.

    Returns:
        The comparison tables by number of context views.
    """
    from gvtools.files import write_text
    from pipelines.benchmark.page import page_of
    from viz.report.benchmark_page import benchmark_html

    views = dict.fromkeys(cell.views for cell in cells)
    by_views = {number: collected(benchmark.at(number), cells) for number in views}
    by_views = {number: results for number, results in by_views.items() if results}
    compared = {n: comparison(benchmark.at(n), results) for n, results in by_views.items()}
    tables = {f"{number}_views": table for number, table in compared.items()}
    tables["intervals"] = interval_table(benchmark, by_views)
    tables["scenes"] = scene_table(benchmark, by_views)
    write_tables(out, tables)
    write_json(out / RESULTS, {"benchmark": cells[0].benchmark, **_plain(by_views)})
    page = page_of(benchmark, cells, by_views, tables=tables, title=title)
    write_text(out / PAGE, benchmark_html(page))
    return compared


def _plain(by_views: Mapping[int, Sequence[MethodResult]]) -> dict[str, Any]:
    """JSON-ready means with intervals, costs and failures, by number of views and method."""
    return {
        f"{views}_views": {
            result.row.system: {
                "mean": dict(result.row.figures),
                "intervals": {name: asdict(i) for name, i in result.intervals.items()},
                "seconds": result.seconds,
                "peak_bytes": result.peak_bytes,
                "failures": dict(result.failures),
                "scenes": {scene: one["figures"] for scene, one in result.scenes.items()},
                "setting": asdict(result.row.setting),
            }
            for result in results
        }
        for views, results in by_views.items()
    }


def print_tables(tables: Mapping[int, Table], console: Console) -> None:
    """Print the comparison tables in Markdown."""
    from gvtools.evaluation.tables import markdown

    for table in tables.values():
        console.line(markdown(table))
