"""What a sweep writes and prints: its trials, the front and a recommendation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.evaluation.tables import Column, Table, csv_text, markdown
from gvtools.files import replaced_when_written, write_text
from pipelines.tradeoff.sweep import Trial, described, pareto_front, recommended
from viz.plots.pareto import draw_pareto

if TYPE_CHECKING:
    from pipelines.console import Console

COLUMNS = (
    Column("trial"),
    Column("a run", "s", "lower", 1),
    Column("memory", "MiB", "lower", 1),
    Column("observations", "", "lower", 0),
    Column("PSNR", "dB", "higher", 2),
    Column("SSIM", "", "higher", 4),
    Column("observed", "dB", "higher", 2),
    Column("generated", "dB", "higher", 2),
    Column("depth error", "median", "lower", 4),
)


def write_results(
    trials: Sequence[Trial], out: Path, *, title: str, budget: float | None, console: Console
) -> Trial | None:
    """Write trials.csv, front.csv and front.png, and print what they say.

    Args:
        trials: at least one.
        out: the folder.
        title: of the plot.
        budget: seconds of a run; None for no limit.
        console: prints the tables and the recommendation.

    Returns:
        The recommended trial; None where none is within the budget.
    """
    best, chosen = pareto_front(trials), recommended(trials, budget)
    figure = draw_pareto(trials, front=best, chosen=chosen, budget=budget, title=title)
    with replaced_when_written(out / "front.png") as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    for name, rows, caption in (
        ("trials", trials, "Trials"),
        ("front", best, "Pareto front of time and PSNR"),
    ):
        table = _table(rows, caption)
        write_text(out / f"{name}.csv", csv_text(table))
        console.line(markdown(table))
    if chosen is None:
        cheapest = min(trials, key=lambda trial: trial.seconds)
        console.warn(
            f"no trial is within the budget; the cheapest takes {cheapest.seconds:.1f} s; "
            "no profile.json is written"
        )
        return None
    console.line(f"recommended: {chosen.label}, {described(chosen)}")
    return chosen


def _table(trials: Sequence[Trial], caption: str) -> Table:
    rows = [
        (t.label, t.seconds, t.bytes / 2**20, t.observations, t.psnr, t.ssim, t.psnr_valid,
         t.psnr_generated, t.depth_rel_valid)
        for t in trials
    ]  # fmt: skip
    return Table(COLUMNS, tuple(rows), caption)
