"""What the report of a run tells: data alone, read by whoever has the run's folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from viz.plots.canvas import Rounds
from viz.plots.pareto import TradeOff
from viz.plots.trajectories import Trajectories
from viz.report.contact_sheet import Tile


@dataclass(frozen=True)
class SheetRow:
    """One target of the contact sheets: a heading, and its tiles."""

    heading: str
    tiles: Sequence[Tile]


@dataclass(frozen=True, eq=False)
class RunReport:
    """All that a report tells; every text may come from a user's files.

    Attributes:
        title: of the run.
        facts: what was run, by name, in order.
        rounds: reports of the whole rounds, the context's (round 0) first; at least that one.
        changed: settings that differ from the defaults, as (setting, value, default).
        settings: all of them, by dotted name.
        warnings: what a reader has to know.
        figures: means over the targets by name, such as ``psnr_generated``; each a number or None.
        intervals: by the same names, 95 % intervals (low, high) of the means where known.
        figures_from: the file that they were read from; None where there are none.
        views: figures of each target.
        notes: why figures are absent.
        sheet: the targets that are shown.
        sheet_note: which they are, and where the others lie.
        poses: cameras; None where they are unknown.
        poses_note: what is drawn, or why nothing is.
        pose_errors: rows of (error, of the completed pictures, of the true ones); may be empty.
        trade_off: where a sweep was made.
    """

    title: str
    facts: Sequence[tuple[str, str]]
    rounds: Rounds
    changed: Sequence[tuple[str, str, str]]
    settings: Mapping[str, str]
    warnings: Sequence[str] = ()
    figures: Mapping[str, float | None] = field(default_factory=dict)
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    figures_from: str | None = None
    views: Sequence[Mapping[str, Any]] = ()
    notes: Sequence[str] = ()
    sheet: Sequence[SheetRow] = ()
    sheet_note: str = ""
    poses: Trajectories | None = None
    poses_note: str = ""
    pose_errors: Sequence[tuple[str, float | None, float | None]] = ()
    trade_off: TradeOff | None = None
