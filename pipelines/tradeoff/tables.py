"""The sweep's tables: all trials, the front, and what each knob gives and takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gvtools.evaluation.tables import Column, Table

if TYPE_CHECKING:
    from pipelines.tradeoff.outcome import Outcome
    from pipelines.tradeoff.search import Search

MEASURED = (
    Column("a run", "s", "lower", 1),
    Column("memory", "MiB", "lower", 1),
    Column("observations", "", "lower", 0),
    Column("PSNR", "dB", "higher", 2),
    Column("SSIM", "", "higher", 4),
    Column("observed", "dB", "higher", 2),
    Column("generated", "dB", "higher", 2),
    Column("depth error", "median", "lower", 4),
)


def trial_table(search: Search) -> Table:
    """Every trial, in the order of the sweep."""
    columns = (
        Column("trial"),
        Column("share of the targets", "", None, 2),
        *MEASURED,
        Column("settings"),
    )
    rows = tuple(
        (entry.label, entry.share, *_measured(entry.outcome, search.targets),
         _said(entry.outcome.settings))
        for entry in search.tried
    )  # fmt: skip
    return Table(columns, rows, f"Trials, {search.targets} targets in a whole run")


def front_table(search: Search, best: Sequence[Outcome]) -> Table:
    """The outcomes that no other beats in both time and PSNR."""
    rows = tuple((*_measured(outcome, search.targets), _said(outcome.settings)) for outcome in best)
    return Table((*MEASURED, Column("settings")), rows, "Pareto front of time and PSNR")


def marginal_table(marginal: Sequence[Mapping[str, Any]]) -> Table:
    """One step of one knob, everything else as usual."""
    columns = (
        Column("setting"),
        Column("from"),
        Column("to"),
        Column("PSNR", "dB more", "higher", 2),
        Column("SSIM", "more", "higher", 4),
        Column("time", "x", "lower", 2),
        Column("memory", "x", "lower", 2),
        Column("observations", "x", "lower", 2),
    )
    keys = ("knob", "from", "to", "psnr", "ssim", "time", "bytes", "observations")
    rows = tuple(tuple(row[key] for key in keys) for row in marginal)
    return Table(columns, rows, "What each setting gives and takes by itself")


def _measured(outcome: Outcome, targets: int) -> tuple[float | int | None, ...]:
    return (
        outcome.seconds(targets),
        outcome.bytes / 2**20,
        outcome.observations,
        outcome.psnr,
        outcome.ssim,
        outcome.psnr_valid,
        outcome.psnr_generated,
        outcome.depth_rel,
    )


def _said(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{key}={value}" for key, value in settings.items()) or "as usual"
