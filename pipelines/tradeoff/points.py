"""A sweep's trials as its plot takes them: from the search, or read back from tradeoff.json."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from gvtools.errors import ProjectError
from pipelines.tradeoff.outcome import Outcome, front
from viz.plots.pareto import TradeOff

FILE = "tradeoff.json"
# What tells one project from another, of a run's identity.
PROJECT = ("project", "reading")


def trial_point(label: str, outcome: Outcome, targets: int) -> dict[str, Any]:
    """One trial, for viz.plots.pareto.

    Args:
        label: "start", "combination", "profile NAME", or the setting that it changes.
        outcome: what it gave.
        targets: of the run that its seconds are to stand for.
    """
    kind = label if label in ("start", "combination") else "trial"
    return {
        "label": label,
        "kind": "profile" if label.startswith("profile") else kind,
        "seconds": outcome.seconds(targets),
        "bytes": outcome.bytes,
        "psnr": outcome.psnr,
    }


def project_of(identity: Mapping[str, Any]) -> dict[str, Any]:
    """What a sweep remembers of its project.

    Args:
        identity: of a run, as run.json holds it.
    """
    return {key: identity[key] for key in PROJECT}


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
        found = json.loads(file.read_text(encoding="utf-8"))
        if of is not None and {key: found[key] for key in PROJECT} != project_of(of):
            return None
        targets = int(found["targets"])
        share = max(entry["share"] for entry in found["trials"])
        entries = [entry for entry in found["trials"] if entry["share"] == share]
        outcomes = [_outcome(entry) for entry in entries]
        points = [
            trial_point(entry["label"], outcome, targets)
            for entry, outcome in zip(entries, outcomes, strict=True)
        ]
        chosen = found["recommended"]
        of_time = found["budget_of"] == "seconds"
        fastest = front(outcomes, lambda outcome: outcome.seconds(targets))
        best = [points[outcomes.index(outcome)] for outcome in fastest]
        return TradeOff(
            str(file),
            points,
            best,
            None if chosen is None else trial_point("recommended", _outcome(chosen), targets),
            found["budget"] if of_time else None,
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ProjectError(
            f"{file}: no trade-off of this version ({error!r}); run gvtools tradeoff again"
        ) from None


def _outcome(entry: Mapping[str, Any]) -> Outcome:
    return Outcome(**{field.name: entry[field.name] for field in fields(Outcome)})
