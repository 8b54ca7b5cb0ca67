"""What the report of a run tells: data alone, read by whoever has the run's folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from viz.plots.canvas import Rounds
from viz.plots.trajectories import Trajectories
from viz.report.contact_sheet import Tile


@dataclass(frozen=True)
class SheetRow:
    """One target of the contact sheets: a heading, and its tiles."""

    heading: str
    tiles: Sequence[Tile]


@dataclass(frozen=True)
class Sheets:
    """Targets whose pictures are shown.

    Attributes:
        rows: a target each.
        note: which targets they are, and where the others lie.
        warnings: pictures that could not be read.
    """

    rows: Sequence[SheetRow] = ()
    note: str = ""
    warnings: Sequence[str] = ()


@dataclass(frozen=True)
class Measures:
    """What was measured on a run's targets.

    Attributes:
        source: the file; None where nothing was measured.
        figures: means over the targets by name, such as ``psnr_generated``.
        intervals: by the same names, 95 % intervals (low, high) of the means where known.
        views: figures of each target.
        notes: why figures are absent.
        poses: what the pose probe found; None where it was not asked.
        warnings: files that belong to another state of the run, or cannot be read.
    """

    source: str | None = None
    figures: Mapping[str, float | None] = field(default_factory=dict)
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    views: Sequence[Mapping[str, Any]] = ()
    notes: Sequence[str] = ()
    poses: Mapping[str, Any] | None = None
    warnings: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class Poses:
    """What a report says of cameras.

    Attributes:
        drawn: cameras; None where there are none.
        note: what is drawn, or why nothing is.
        errors: rows of (error, of the completed pictures, of the true ones); may be empty.
    """

    drawn: Trajectories | None = None
    note: str = ""
    errors: Sequence[tuple[str, float | None, float | None]] = ()


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
        measures: figures of the targets.
        sheets: pictures of the targets.
        poses: cameras, and errors of estimated ones.
    """

    title: str
    facts: Sequence[tuple[str, str]]
    rounds: Rounds
    changed: Sequence[tuple[str, str, str]]
    settings: Mapping[str, str]
    warnings: Sequence[str]
    measures: Measures
    sheets: Sheets
    poses: Poses
