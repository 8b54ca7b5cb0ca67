"""``gvtools benchmark``: a whole benchmark, every scene, number of views and method."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from gvtools.errors import OptionError, ProjectError
from gvtools.untrusted import read_json
from pipelines.commands.arguments import LpipsArguments

if TYPE_CHECKING:
    from gvtools.evaluation.published import Benchmark
    from pipelines.console import Console
    from pipelines.scoring.benchmark import BenchmarkCell

SUMMARY = "run a whole benchmark, and stand its means beside published rows"
EXAMPLES = (
    "gvtools benchmark llff --root nerf_llff_data --views 3,6,9",
    "gvtools benchmark few-view --root projects --methods default,none,mine=renders",
)


class BenchmarkArguments(LpipsArguments):
    """The command's arguments."""

    positional = ("name",)

    name: str
    """llff, dtu, mipnerf360-few, few-view (projects of one's own), or the paper's: realestate10k,
    dl3dv, mipnerf360, scannetv2, dl3dv-steps, scannetv2-ablation. [NAME]"""
    root: Path
    """The data set as downloaded, or a folder of projects. [DIR]"""
    out: Path | None = None
    """Of the results (runs/benchmark-NAME); goes on there. [DIR]"""
    views: str | None = None
    """Numbers of context views (default: the benchmark's). [N,...]"""
    scenes: str | None = None
    """Default: all of the benchmark's. [NAME,...]"""
    methods: str = "default"
    """default, a profile, a completer, paper, NAME=FILE.json (settings) or NAME=DIR (pictures of
    another method). [NAME,...]"""
    seconds: float | None = Field(None, gt=0)
    """Of each fit of Gaussians (default: the method's). [S]"""


def run(args: BenchmarkArguments, console: Console) -> None:
    """Measure what is not measured yet, and write the tables."""
    from gvtools.evaluation.published import load_benchmark
    from gvtools.evaluation.tables import markdown
    from gvtools.runs.folder import folder_lock
    from pipelines.scoring.benchmark import measure_apart, measure_cells
    from pipelines.scoring.benchmark_results import PAGE, write_results

    benchmark = load_benchmark(args.name)
    cells = planned_cells(args, benchmark, console)
    out, title = cells[0].out, f"Benchmark {args.name}"

    def write() -> None:
        write_results(benchmark, cells, out, title=title)

    _refuse_others(out, args.name)
    with folder_lock(out):
        measure_cells(cells, console=console, measure=measure_apart, after=write)
        tables = write_results(benchmark, cells, out, title=title)
    for table in tables.values():
        console.line(markdown(table))
    console.line(f"results in {out}: {PAGE}, results.json, and tables as .csv, .md and .tex")
    _check_some_measured(cells, args.root)


def _refuse_others(out: Path, name: str) -> None:
    """Refuse a folder with the tables of another benchmark, which would be overwritten."""
    from pipelines.scoring.benchmark_results import RESULTS

    try:
        found = read_json(out / RESULTS)["benchmark"]
    except (OSError, ValueError, KeyError, TypeError):
        return
    if found != name:
        raise OptionError(
            f"{out}: holds the results of {found!r}, not {name!r}; give another --out"
        )


def _check_some_measured(cells: tuple[BenchmarkCell, ...], root: Path) -> None:
    """Refuse a benchmark without any figure, which a script would take for a success."""
    from pipelines.scoring.benchmark import MEASURED, read_cell

    results = [read_cell(cell) for cell in cells]
    if not any(result and result["status"] == MEASURED for result in results):
        first = next((result["reason"] for result in results if result), "no results")
        raise ProjectError(f"{root}: none of {len(cells)} measurements succeeded, first {first}")


def planned_cells(
    args: BenchmarkArguments, benchmark: Benchmark, console: Console
) -> tuple[BenchmarkCell, ...]:
    """Every scene, number of views and method, scene by scene."""
    from pipelines.scoring.benchmark import BenchmarkCell, parse_methods
    from pipelines.scoring.benchmark_scenes import scene_names

    root = args.root.resolve()
    methods = parse_methods(args.methods)
    for method in methods:
        method.config(seconds=args.seconds)
    lpips, no_lpips = args.open_lpips()
    if lpips is None:
        console.line(f"LPIPS is not measured: {no_lpips}")
    chosen = None if lpips is None else (args.lpips_net, args.lpips_weights)
    scenes = _chosen_scenes(args.scenes, scene_names(benchmark, root))
    out = args.out or Path("runs") / f"benchmark-{args.name}"
    return tuple(
        BenchmarkCell(
            benchmark=args.name,
            root=root,
            scene=scene,
            views=views,
            method=method,
            seconds=args.seconds,
            lpips=chosen,
            out=out.resolve(),
        )
        for scene in scenes
        for views in _chosen_views(args.views, benchmark)
        for method in methods
    )


def _chosen_views(text: str | None, benchmark: Benchmark) -> tuple[int, ...]:
    if text is None:
        return benchmark.views
    try:
        numbers = tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise OptionError(f"--views {text!r}; expected numbers with commas between them") from None
    for number in numbers:
        benchmark.at(number)
    return numbers


def _chosen_scenes(text: str | None, known: tuple[str, ...]) -> tuple[str, ...]:
    from gvtools.specs import unknown

    if text is None:
        return known
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    for name in names:
        if name not in known:
            raise OptionError(unknown("scene", name, known))
    if not names:
        raise OptionError(f"--scenes {text!r}; expected at least one of {', '.join(known)}")
    return names
