"""Runs measured, ranked beside published rows, and written as JSON and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.published import Benchmark, benchmark_names, load_benchmark
from gvtools.evaluation.tables import Cell, Table
from gvtools.files import write_json
from gvtools.runs.run import Run, load_run
from pipelines.console import Console
from pipelines.evaluation.record import (
    EvaluationOptions,
    described,
    joined,
    name_apart,
    setting_of,
)
from pipelines.evaluation.run_evaluation import evaluate_run
from pipelines.evaluation.tables import (
    comparison,
    measured_row,
    summary_table,
    view_table,
    write_tables,
)

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips


def load_benchmarks(shown: Sequence[str], data_set: str | None) -> dict[str, Benchmark]:
    """Published benchmarks by name: those with the paper's protocol, and those asked for.

    Args:
        shown: names that the user asked for.
        data_set: name that the user gave.
    """
    if data_set is not None:
        load_benchmark(data_set)
    known = {name: load_benchmark(name) for name in benchmark_names()}
    papers = {name: b for name, b in known.items() if b.splits[0].kind == "protocol"}
    return papers | {name: load_benchmark(name) for name in shown}


def load_runs(paths: Sequence[Path], *, project: Path | None) -> list[Run]:
    """Runs with at least one completed target each."""
    resolved = [path.resolve() for path in paths]
    if len(set(resolved)) < len(resolved):
        raise OptionError("a run is given twice; expected each once")
    runs = [load_run(path, project=project) for path in paths]
    for run in runs:
        if len(run.rounds) < 2:
            raise ProjectError(
                f"{run.path}: no round of targets is done; expected one; add --resume to it"
            )
    return runs


def evaluate_runs(
    runs: Sequence[Run],
    options: EvaluationOptions,
    *,
    lpips: Lpips | None,
    no_lpips: str | None,
    console: Console,
) -> list[dict[str, Any]]:
    """The figures of each run, with what they were measured on.

    Args:
        runs: with at least one completed target each.
        options: what to measure.
        lpips: the network, or None.
        no_lpips: why there is none.
        console: for progress.
    """
    matcher = _matcher(options.matcher)
    evaluations = []
    for run in runs:
        console.line(f"{run.path}: {len(run.rounds) - 1} rounds")
        if not run.complete:
            console.warn(f"{run.path}: not every round is done; measured are those that are")
        figures = evaluate_run(
            run,
            parts=options.parts,
            lpips=lpips,
            no_lpips=no_lpips,
            matcher=matcher,
            control=options.control,
            seed=options.seed,
            console=console,
        )
        evaluations.append(described(run, figures))
    name_apart(evaluations)
    return evaluations


def write_evaluation(
    runs: Sequence[Run],
    evaluations: Sequence[dict[str, Any]],
    options: EvaluationOptions,
    *,
    benchmarks: dict[str, Benchmark],
    shown: Sequence[str],
    out: Path,
    console: Console,
) -> dict[str, Any]:
    """Write evaluation.json and the tables, print the summary, and return the figures.

    Args:
        runs: that were measured.
        evaluations: of these, see ``evaluate_runs``.
        options: what was measured.
        benchmarks: published rows by name.
        shown: names of those that are printed.
        out: folder.
        console: where the tables go.
    """
    setting = setting_of(options, runs, evaluations)
    row = measured_row(options.name, evaluations, setting)
    # Of several numbers of context views, that of the runs, if there are rows of it.
    alike = {
        name: benchmark.at(
            setting.context if setting.context in benchmark.views else benchmark.context
        )
        for name, benchmark in benchmarks.items()
    }
    comparisons = {name: comparison(row, benchmark) for name, benchmark in alike.items()}
    figures = joined(evaluations, row.figures, options)
    over = figures["over_scenes"] if len(evaluations) > 1 else {}
    tables = {"summary": summary_table(evaluations, "Evaluation", over)}
    for number, evaluation in enumerate(evaluations):
        if "images" in evaluation:
            views = evaluation["images"]["views"]
            key = "views" if len(evaluations) == 1 else f"views_{number:03d}"
            tables[key] = view_table(views, evaluation["name"])
    tables |= {f"published_{name}": table for name, table in comparisons.items()}
    write_json(out / "evaluation.json", figures)
    write_tables(out, tables)
    for table in (tables["summary"], *(comparisons[name] for name in shown)):
        _print(table, console)
    console.line(f"results in {out}: evaluation.json, and tables as .csv, .md and .tex")
    return figures


def _matcher(name: str) -> Any:
    if name == "sift":
        return None
    from gvtools.features import LightGlueMatcher

    return LightGlueMatcher()


def _print(table: Table, console: Console) -> None:
    if table.caption:
        console.line(table.caption)

    def shown(value: Any) -> Any:
        if not isinstance(value, Cell):
            return value
        if value.value is None or value.rank is None:
            return value.value
        return f"{value.value:.4g} #{value.rank}"

    rows = [[shown(value) for value in row] for row in table.rows]
    console.table([column.heading for column in table.columns], rows)
    for note in table.notes:
        console.line(f"  {note}")
