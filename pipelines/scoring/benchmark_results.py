"""The results of a benchmark: comparison with published rows, intervals, scenes, an HTML page."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.evaluation.published import (
    MEASURED,
    Benchmark,
    MeasuredRow,
    Setting,
    common,
    comparison_table,
    side_by_side,
)
from gvtools.evaluation.statistics import Interval, mean_interval, mean_known
from gvtools.evaluation.tables import Column, Table, Value
from gvtools.files import write_json, write_text
from pipelines.scoring.benchmark import FAILED, BenchmarkCell, read_cell
from pipelines.scoring.tables import write_tables

if TYPE_CHECKING:
    from viz.report.page import BenchmarkPage, SheetRow
    from viz.report.pictures import Thumbnail

RESULTS, PAGE = "results.json", "index.html"
MIB = 2**20
# What a method knows and costs, beside the figures of the benchmark.
COSTS = (
    Column("Observed", "dB", digits=2),
    Column("Coverage", digits=3),
    Column("A run", "s", digits=1),
    Column("Peak", "MiB", digits=0),
)


@dataclass(frozen=True, kw_only=True)
class MethodResult:
    """One method with one number of context views, over the scenes."""

    row: MeasuredRow  # means over the scenes, and how they were measured
    intervals: Mapping[str, Interval]  # by figure, of the mean over the scenes that have it
    seconds: float | None  # mean of a run; None for pictures that were made elsewhere
    peak_bytes: int | None  # most main memory of any run; None likewise
    failures: Mapping[str, str]  # by scene that failed, why
    scenes: Mapping[str, Mapping[str, Any]]  # by scene, what ``measure_cell`` returned


def method_results(benchmark: Benchmark, cells: Sequence[BenchmarkCell]) -> list[MethodResult]:
    """The results of the methods, in the cells' order, without methods not yet measured."""
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
    peaks = [r["peak_bytes"] for r in scenes.values() if r.get("peak_bytes") is not None]
    setting = _setting(benchmark, list(scenes.values()), failed=len(failures), lpips=lpips)
    return MethodResult(
        row=MeasuredRow(name, figures, setting),
        intervals=intervals,
        seconds=mean_known([r.get("seconds") for r in scenes.values()]),
        peak_bytes=max(peaks, default=None),
        failures=failures,
        scenes=scenes,
    )


def _setting(
    benchmark: Benchmark, results: Sequence[Mapping[str, Any]], *, failed: int, lpips: Any
) -> Setting:
    size = common(tuple(result["resolution"] or ()) for result in results)
    rounds = [names for result in results for names in result["split"]["rounds"]]
    poses = {result["poses_from"] for result in results}
    met3r = {result["met3r"] for result in results}
    masked = any(result.get("masked_share") for result in results)
    return Setting(
        data_set=benchmark.name,
        resolution=(size[0], size[1]) if size else None,
        context=benchmark.context,
        targets=common(map(len, rounds)),
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
    """A table of published and measured rows, with ranks where they are comparable."""
    rows = side_by_side([result.row for result in results], benchmark)
    table = comparison_table(rows, benchmark)
    by_name = {result.row.system: result for result in results}
    first = next(iter(benchmark.figures.values()))
    ends = [Column(f"{first.label} {end}", digits=first.digits) for end in ("low", "high")]
    body: list[tuple[Value, ...]] = []
    for row, cells in zip(rows, table.rows, strict=True):
        result = by_name.get(row.system) if row.origin == MEASURED else None
        interval = result.intervals[first.name] if result else None
        own = interval.low if interval else None, interval.high if interval else None
        costs = _costs(result.row.figures, result.seconds, result.peak_bytes) if result else ()
        scenes = len(result.scenes) if result else None
        body.append((*cells[:3], *own, *cells[3:], *(costs or [None] * len(COSTS)), scenes))
    notes = [
        f"{first.label} low and high: 95 % bootstrap interval of the mean over scenes. Observed: "
        "PSNR of the pixels that stand on observations. A run: mean wall-clock seconds. Peak: the "
        "most main memory of any run.",
        *(f"{result.row.system}, {scene}: failed: {reason}" for result in results
          for scene, reason in result.failures.items()),
        *table.notes,
    ]  # fmt: skip
    columns = (*table.columns[:3], *ends, *table.columns[3:], *COSTS, Column("Scenes"))
    caption = f"{benchmark.name}, {benchmark.context} context views"
    return Table(columns, tuple(body), caption, tuple(notes))


def _costs(
    figures: Mapping[str, Any], seconds: float | None, peak_bytes: int | None
) -> tuple[Value, ...]:
    """The values of COSTS."""
    peak = None if peak_bytes is None else peak_bytes / MIB
    return figures.get("psnr_observed"), figures.get("coverage"), seconds, peak


def interval_table(benchmark: Benchmark, by_views: Mapping[int, Sequence[MethodResult]]) -> Table:
    """For each number of views, method and figure one row: mean over scenes, its interval."""
    columns = (Column("views"), Column("method"), Column("figure"), Column("mean", digits=4),
               Column("low", digits=4), Column("high", digits=4), Column("scenes"))  # fmt: skip
    rows = (
        (views, result.row.system, name, *astuple(interval))
        for views, results in by_views.items()
        for result in results
        for name, interval in result.intervals.items()
        if interval.n
    )
    return Table(columns, tuple(rows), f"{benchmark.name}: means over scenes")


def scene_table(benchmark: Benchmark, by_views: Mapping[int, Sequence[MethodResult]]) -> Table:
    """One row for each cell that was tried: its figures, or why it failed."""
    columns = [Column("scene"), Column("views"), Column("method")]
    columns += [figure.column for figure in benchmark.figures.values()]
    columns += [*COSTS, Column("targets"), Column("note")]
    rows: list[tuple[Value, ...]] = []
    for views, results in by_views.items():
        for result in results:
            for scene, one in result.scenes.items():
                values = [one["figures"].get(name) for name in benchmark.figures]
                costs = _costs(one["figures"], one.get("seconds"), one.get("peak_bytes"))
                head = scene, views, result.row.system
                rows.append((*head, *values, *costs, len(one["views"]), ""))
            for scene, reason in result.failures.items():
                gaps = [None] * (len(benchmark.figures) + len(COSTS) + 1)
                rows.append((scene, views, result.row.system, *gaps, f"failed: {reason}"))
    rows.sort(key=lambda row: (str(row[0]), row[1]))
    return Table(tuple(columns), tuple(rows), f"{benchmark.name}: scenes")


def write_results(
    benchmark: Benchmark, cells: Sequence[BenchmarkCell], out: Path, *, title: str
) -> dict[int, Table]:
    """Write results.json, the tables (CSV, Markdown, LaTeX), and the HTML page."""
    from viz.report.page import benchmark_html

    views = dict.fromkeys(cell.views for cell in cells)
    by_views = {number: method_results(benchmark.at(number), cells) for number in views}
    by_views = {number: results for number, results in by_views.items() if results}
    compared = {n: comparison(benchmark.at(n), results) for n, results in by_views.items()}
    tables = {f"{number}_views": table for number, table in compared.items()}
    tables["intervals"] = interval_table(benchmark, by_views)
    tables["scenes"] = scene_table(benchmark, by_views)
    write_tables(out, tables)
    write_json(out / RESULTS, {"benchmark": cells[0].benchmark, **_plain(by_views)})
    page = _page(benchmark, cells, by_views, tables=tables, title=title)
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


def _page(
    benchmark: Benchmark,
    cells: Sequence[BenchmarkCell],
    by_views: Mapping[int, Sequence[MethodResult]],
    *,
    tables: Mapping[str, Table],
    title: str,
) -> BenchmarkPage:
    from viz.report.page import BenchmarkPage

    methods = dict.fromkeys(cell.method.name for cell in cells)
    scenes = dict.fromkeys(cell.scene for cell in cells)
    lines: dict[str, list[tuple[int, float, float | None, float | None]]] = {}
    for views, results in by_views.items():
        for result in results:
            interval = result.intervals["psnr"]
            if interval.mean is not None:
                point = (views, interval.mean, interval.low, interval.high)
                lines.setdefault(result.row.system, []).append(point)
    rules = dict.fromkeys(benchmark.split_of(views).source for views in by_views)
    size = benchmark.resolution
    return BenchmarkPage(
        title=title,
        facts=(
            ("scenes", ", ".join(scenes)),
            ("methods", ", ".join(methods)),
            ("context views", ", ".join(map(str, by_views))),
            ("pictures", f"{size[0]}x{size[1]}" if size else "as recorded, or the split's share"),
            ("views chosen by", "; ".join(rules)),
        ),
        tables=tables,
        lines=lines,
        pictures=tuple(
            row
            for scene in scenes
            for views in by_views
            if (row := _pictures(scene, [c for c in cells if (c.scene, c.views) == (scene, views)]))
        ),
    )


def _pictures(scene: str, cells: Sequence[BenchmarkCell]) -> SheetRow | None:
    """The middle target of a scene: a given view, the photograph, each method and its error."""
    from viz.report.page import SheetRow

    folder, views = cells[0].result.parent, cells[0].views
    heading = f"{scene}, {views} context views"
    shared = (("context", "a given view"), ("truth", "photograph"))
    tiles = [_tile(folder / f".{name}.jpg", label, heading) for name, label in shared]
    for cell in cells:
        for ending, label in ((".jpg", cell.method.name), (".error.jpg", "error")):
            path = cell.result.with_name(f"{cell.method.name}{ending}")
            # What a failed cell left of an earlier attempt is not its own.
            if cell.result.is_file():
                tiles.append(_tile(path, label, f"{heading}, {cell.method.name}"))
    known = tuple(tile for tile in tiles if tile is not None)
    return SheetRow(heading, known) if len(known) > 2 else None


def _tile(path: Path, label: str, where: str) -> Thumbnail | None:
    from PIL import Image

    from viz.report.pictures import Thumbnail, data_uri

    if not path.is_file():
        return None
    with Image.open(path) as picture:
        width, height = picture.size
    return Thumbnail(
        label, f"{where}: {label}", data_uri(path.read_bytes(), "image/jpeg"), width, height
    )
