"""What the page of a benchmark shows, collected from its cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.benchmark.measure import Cell

if TYPE_CHECKING:
    from gvtools.evaluation.published import Benchmark
    from gvtools.evaluation.tables import Table
    from viz.report.benchmark_page import BenchmarkPage, PictureRow
    from viz.report.contact_sheet import Tile


def page_of(
    benchmark: Benchmark,
    cells: Sequence[Cell],
    by_views: Mapping[int, Sequence[Any]],
    *,
    tables: Mapping[str, Table],
    title: str,
) -> BenchmarkPage:
    """The page's content.

    Args:
        benchmark: of the cells.
        cells: all, measured or not.
        by_views: ``pipelines.benchmark.results.MethodResult`` by number of context views.
        tables: by name.
        title: above all.
    """
    from viz.report.benchmark_page import BenchmarkPage

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


def _pictures(scene: str, cells: Sequence[Cell]) -> PictureRow | None:
    """The middle target of a scene: a given view, the photograph, each method and its error."""
    from viz.report.benchmark_page import PictureRow

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
    return PictureRow(heading, known) if len(known) > 2 else None


def _tile(path: Path, label: str, where: str) -> Tile | None:
    from PIL import Image

    from viz.report.contact_sheet import Tile, data_uri

    if not path.is_file():
        return None
    with Image.open(path) as picture:
        width, height = picture.size
    return Tile(
        label, f"{where}: {label}", data_uri(path.read_bytes(), "image/jpeg"), width, height
    )
