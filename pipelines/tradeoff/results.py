"""What a sweep writes: tables, plot and tradeoff.json, which reports and plots read back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import ProjectError
from gvtools.evaluation.tables import Column, Table, csv_text, markdown
from pipelines.tradeoff.sweep import Sweep, Trial, pareto_front
from pipelines.tradeoff.trial import Outcome
from viz.plots.pareto import TradeOff, draw_pareto

if TYPE_CHECKING:
    from pipelines.console import Console

FILE = "tradeoff.json"
# What tells one project from another, of a run's identity.
PROJECT = ("project", "reading")
MEASURED = (
    Column("a run", "s", "lower", 1),
    Column("memory", "MiB", "lower", 1),
    Column("observations", "", "lower", 0),
    Column("PSNR", "dB", "higher", 2),
    Column("SSIM", "", "higher", 4),
    Column("observed", "dB", "higher", 2),
    Column("generated", "dB", "higher", 2),
    Column("depth error", "median", "lower", 4),
    Column("settings"),
)
MARGINAL = {
    "setting": Column("setting"),
    "from": Column("from"),
    "to": Column("to"),
    "psnr": Column("PSNR", "dB more", "higher", 2),
    "ssim": Column("SSIM", "more", "higher", 4),
    "time": Column("time", "x", "lower", 2),
    "bytes": Column("memory", "x", "lower", 2),
    "observations": Column("observations", "x", "lower", 2),
}


def write_results(
    sweep: Sweep,
    out: Path,
    *,
    title: str,
    identity: Mapping[str, Any],
    budget: tuple[str, float | None],
    console: Console,
) -> Trial | None:
    """Write trials.csv, front.csv, front.png and tradeoff.json, and print what they say.

    Args:
        sweep: finished.
        out: the folder.
        title: of the plot.
        identity: of the start, as run.json holds it.
        budget: "seconds" or "bytes" of a run, and how many; None for no limit.
        console: prints the tables and the recommendation.

    Returns:
        The recommended trial; None where none is within the budget.
    """
    from gvtools.files import write_json, write_text

    budget_of, most = budget

    def fits(outcome: Outcome) -> bool:
        return most is None or getattr(outcome, budget_of) <= most

    front = pareto_front(sweep.trials)
    chosen = sweep.recommended(fits)
    marginal = sweep.marginal_values()
    edge = Table(MEASURED, _rows(front), "Pareto front of time and PSNR")
    labelled = zip(sweep.trials, _rows(sweep.trials), strict=True)
    every = Table((Column("trial"), *MEASURED), tuple((t.label, *row) for t, row in labelled))
    write_text(out / "trials.csv", csv_text(every))
    write_text(out / "front.csv", csv_text(edge))
    data = {
        **{key: identity[key] for key in PROJECT},
        "budget": most,
        "budget_of": budget_of,
        "trials": [_entry(trial) for trial in sweep.trials],
        "front": [_entry(trial) for trial in front],
        "marginal": marginal,
        "recommended": None if chosen is None else _entry(chosen),
        "refused": sweep.refused,
        "left_out": sweep.left_out,
    }
    write_json(out / FILE, data)
    _draw(_trade_off(FILE, data), out / "front.png", title)
    console.line(markdown(_marginal_table(marginal)))
    console.line(markdown(edge))
    if sweep.left_out:
        console.warn(
            f"{len(sweep.left_out)} trials were left out for --limit: "
            f"{', '.join(sweep.left_out[:4])}; the same command with a longer one goes on"
        )
    _print_recommendation(sweep, chosen, budget_of, console=console)
    return chosen


def _marginal_table(marginal: Sequence[Mapping[str, Any]]) -> Table:
    values = tuple(tuple(row[key] for key in MARGINAL) for row in marginal)
    caption = "What each setting gives and takes by itself"
    return Table(tuple(MARGINAL.values()), values, caption)


def _draw(drawn: TradeOff, path: Path, title: str) -> None:
    from gvtools.files import replaced_when_written

    with replaced_when_written(path) as temporary:
        draw_pareto(drawn, title=title).savefig(temporary, format="png", dpi=120)


def _print_recommendation(
    sweep: Sweep, chosen: Trial | None, budget_of: str, *, console: Console
) -> None:
    if chosen is None:
        cheapest = min((t.outcome for t in sweep.trials), key=lambda o: getattr(o, budget_of))
        console.warn(
            f"no trial is within the budget; the cheapest takes {cheapest.seconds:.1f} s "
            f"and {cheapest.bytes / 2**20:.0f} MiB; no profile.json is written"
        )
        return
    outcome = chosen.outcome
    console.line(
        f"recommended: {chosen.label}, {outcome.psnr:.2f} dB in {outcome.seconds:.1f} s, "
        f"{outcome.bytes / 2**20:.0f} MiB"
    )
    if sweep.smaller(outcome):
        console.warn("within the budget the pictures are smaller than what was asked for")


def read_trade_off(file: Path, *, of: Mapping[str, Any] | None = None) -> TradeOff | None:
    """The sweep of a tradeoff.json.

    Args:
        file: the JSON.
        of: identity of the run whose project is to be the sweep's; None takes any.

    Returns:
        None where it is the sweep of another project.

    Raises:
        ProjectError: it cannot be read, or is of another version.
    """
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        if of is not None and any(data[key] != of[key] for key in PROJECT):
            return None
        return _trade_off(str(file), data)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ProjectError(
            f"{file}: no trade-off of this version ({error!r}); run gvtools tradeoff again"
        ) from None


def _trade_off(source: str, data: Mapping[str, Any]) -> TradeOff:
    """The content of a tradeoff.json as plots take it."""
    chosen = data["recommended"]
    return TradeOff(
        source,
        [_point(entry) for entry in data["trials"]],
        [_point(entry) for entry in data["front"]],
        None if chosen is None else _point(chosen),
        data["budget"] if data["budget_of"] == "seconds" else None,
    )


def _point(entry: Mapping[str, Any]) -> dict[str, Any]:
    label = entry["label"]
    kind = "start" if label == "start" else "profile" if label.startswith("profile") else "trial"
    return {"kind": kind, **{key: entry[key] for key in ("label", "seconds", "bytes", "psnr")}}


def _entry(trial: Trial) -> dict[str, Any]:
    return {"label": trial.label, **asdict(trial.outcome)}


def _rows(trials: Sequence[Trial]) -> tuple[tuple[Any, ...], ...]:
    rows = []
    for trial in trials:
        o = trial.outcome
        settings = ", ".join(f"{key}={value}" for key, value in o.settings.items())
        rows.append((o.seconds, o.bytes / 2**20, o.observations, o.psnr, o.ssim, o.psnr_valid,
                     o.psnr_generated, o.depth_rel, settings or "as given"))  # fmt: skip
    return tuple(rows)
