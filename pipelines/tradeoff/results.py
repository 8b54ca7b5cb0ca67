"""What a sweep writes and prints: trials, marginal values, the front and a recommendation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.evaluation.tables import Column, Table, csv_text, markdown
from gvtools.files import replaced_when_written, write_text
from pipelines.tradeoff.sweep import Sweep, Trial, pareto_front
from viz.plots.pareto import draw_pareto

if TYPE_CHECKING:
    from pipelines.console import Console

MEASURED = (
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
MARGINAL = (
    Column("setting"),
    Column("from"),
    Column("to"),
    Column("PSNR", "dB more", "higher", 2),
    Column("SSIM", "more", "higher", 4),
    Column("time", "x", "lower", 2),
    Column("memory", "x", "lower", 2),
    Column("observations", "x", "lower", 2),
)


def write_results(
    sweep: Sweep,
    out: Path,
    *,
    title: str,
    budget: tuple[str, float | None],
    console: Console,
) -> Trial | None:
    """Write trials.csv, marginal.csv, front.csv and front.png, and print what they say.

    Args:
        sweep: finished.
        out: the folder.
        title: of the plot.
        budget: "seconds" or "bytes" of a run, and how many; None for no limit.
        console: prints the tables and the recommendation.

    Returns:
        The recommended trial; None where none is within the budget.
    """
    best = pareto_front(sweep.trials)
    chosen = sweep.recommended(budget)
    front = _table(best, "Pareto front of time and PSNR")
    marginal = Table(MARGINAL, tuple(sweep.steps()), "What each setting gives and takes by itself")
    write_text(out / "trials.csv", csv_text(_table(sweep.trials)))
    write_text(out / "marginal.csv", csv_text(marginal))
    write_text(out / "front.csv", csv_text(front))
    figure = draw_pareto(sweep.trials, front=best, chosen=chosen, budget=budget, title=title)
    with replaced_when_written(out / "front.png") as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    console.line(markdown(marginal))
    console.line(markdown(front))
    if sweep.left_out:
        console.warn(
            f"{len(sweep.left_out)} trials were left out for --limit: "
            f"{', '.join(sweep.left_out[:4])}; the same command with a longer one goes on"
        )
    if chosen is None:
        cheapest = min(sweep.trials, key=lambda trial: getattr(trial, budget[0]))
        console.warn(
            f"no trial is within the budget; the cheapest takes {cheapest.seconds:.1f} s "
            f"and {cheapest.bytes / 2**20:.0f} MiB; no profile.json is written"
        )
        return None
    console.line(
        f"recommended: {chosen.label}, {chosen.psnr:.2f} dB in {chosen.seconds:.1f} s, "
        f"{chosen.bytes / 2**20:.0f} MiB"
    )
    if sweep.smaller(chosen):
        console.warn("within the budget the pictures are smaller than what was asked for")
    return chosen


def _table(trials: Sequence[Trial], caption: str = "") -> Table:
    rows = [
        (t.label, t.seconds, t.bytes / 2**20, t.observations, t.psnr, t.ssim, t.psnr_valid,
         t.psnr_generated, t.depth_rel)
        for t in trials
    ]  # fmt: skip
    return Table(MEASURED, tuple(rows), caption)
