"""Methods side by side on the same cases: scores, times, and tables with paired intervals."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from benchmarks.experiments.cases import Case
from benchmarks.experiments.generated_pixels import (
    GeneratedScore,
    figures,
    paired_interval,
    score,
)
from benchmarks.experiments.perceptual_distance import NAME, SqueezeNetDistance
from gvtools.completers.base import Completer, Completion
from gvtools.errors import CheckpointError
from gvtools.evaluation.tables import Column, Table

# Figures whose smaller values are better.
LOWER = ("depth", "depth_view", "distance", "distance_view")
# Whose differences a table shows.
COMPARED = ("psnr", "depth", "distance")
COLUMNS = {
    "psnr": Column("PSNR", "dB, pooled", "higher", 2),
    "psnr_view": Column("PSNR", "dB, view mean", "higher", 2),
    "depth": Column("depth error", "median, pooled", "lower", 4),
    "depth_view": Column("depth error", "median, view mean", "lower", 4),
    "distance": Column("perceptual distance", "pooled", "lower", 3),
    "distance_view": Column("perceptual distance", "view mean", "lower", 3),
    "energy": Column("gradient energy", "of truth", None, 3),
}


@dataclass
class Judged:
    """A method's scores, one a case, and what they took.

    Attributes:
        scores: in the order of the cases.
        seconds: of the completer, over all cases.
        views: completed.
    """

    scores: list[GeneratedScore] = field(default_factory=list)
    seconds: float = 0.0
    views: int = 0

    def row(self) -> dict[str, float | None]:
        """Figures, and seconds a view."""
        return {**figures(self.scores), "seconds": self.seconds / max(self.views, 1)}


def judge(
    methods: Mapping[str, Completer],
    cases: Iterable[Case],
    *,
    distance: SqueezeNetDistance | None,
    seed: int = 0,
) -> dict[str, Judged]:
    """Every method on every case; methods take turns, so that the machine's noise is shared.

    Each method completes the first case once before its time counts.

    Args:
        methods: by the name of their row.
        cases: each is made once.
        distance: None leaves the perceptual distance out.
        seed: of the completers.
    """
    judged = {name: Judged() for name in methods}
    for number, case in enumerate(cases):
        truth = None if distance is None else distance.features(case.rgb)
        for name, completer in methods.items():
            if not number:
                completer.complete(case.context, case.guidance, seed=seed)
            begun = time.perf_counter()
            made = completer.complete(case.context, case.guidance, seed=seed)
            judged[name].seconds += time.perf_counter() - begun
            judged[name].views += len(case.guidance)
            judged[name].scores.append(scored(case, made, distance, truth))
    return judged


def perceptual() -> tuple[SqueezeNetDistance | None, str]:
    """The perceptual distance and its name; None and the reason where its weights are absent."""
    try:
        return SqueezeNetDistance(), NAME
    except CheckpointError as error:
        return None, str(error)


def scored(
    case: Case, made: Completion, distance: SqueezeNetDistance | None, truth: list[Tensor] | None
) -> GeneratedScore:
    """The score of a case's completed views; ``truth`` has the true pictures' features."""
    maps = None
    if distance is not None and truth is not None:
        maps = distance.maps(np.clip(made.rgb, 0, 1).astype(np.float32), truth)
    return score(
        made.rgb,
        made.depth,
        true_rgb=case.rgb,
        true_depth=case.depth,
        generated=case.generated,
        distance=maps,
    )


def table(
    judged: Mapping[str, Judged],
    *,
    caption: str,
    against: Mapping[str, str] | None = None,
    notes: tuple[str, ...] = (),
) -> Table:
    """One row a method; with ``against`` the paired intervals to the rows that it names."""
    columns = [Column("method"), *COLUMNS.values(), Column("seconds", "a view", "lower", 3)]
    compared = [] if against is None else [f for f in COMPARED if f in against]
    columns += [Column(f"{COLUMNS[f].title}, difference", "95 %") for f in compared]
    rows: list[tuple[Any, ...]] = []
    for name, entry in judged.items():
        found = entry.row()
        row: list[Any] = [name, *(found[key] for key in COLUMNS), found["seconds"]]
        row += [difference_text(entry, judged[(against or {})[f]], f) for f in compared]
        rows.append(tuple(row))
    return Table(tuple(columns), tuple(rows), caption, notes)


def comparisons(
    judged: Mapping[str, Judged],
    pairs: Iterable[tuple[str, str, Mapping[str, str]]],
    *,
    caption: str,
) -> Table:
    """Paired differences of chosen rows in every figure, pooled and of the view means.

    Args:
        judged: all rows.
        pairs: a row, what it is compared with, and that in each figure. Those of absent rows are
            left out.
        caption: of the table.
    """
    shown = (Column(f"{c.title}, {c.unit.split(', ')[-1]}") for c in COLUMNS.values())
    columns = (Column("method"), Column("against"), *shown)
    rows = tuple(
        (name, said, *(difference_text(judged[name], judged[peers[f]], f) for f in COLUMNS))
        for name, said, peers in pairs
        if name in judged and set(peers.values()) <= set(judged)
    )
    notes = ("Differences with 95 % of the paired bootstrap over scenes.",)
    return Table(columns, rows, caption, notes)


def records(
    judged: Mapping[str, Judged], against: Mapping[str, str] | None = None
) -> list[dict[str, Any]]:
    """Rows for JSON, with paired intervals of each figure to the row that ``against`` names."""
    rows = []
    for name, entry in judged.items():
        row: dict[str, Any] = {"method": name, **entry.row()}
        if against is not None:
            row["difference"] = {
                figure: {
                    "to": peer,
                    "by": paired_interval(entry.scores, judged[peer].scores, figure),
                }
                for figure, peer in against.items()
                if peer != name
                and entry.row()[figure] is not None
                and judged[peer].row()[figure] is not None
            }
        rows.append(row)
    return rows


def peers(judged: Mapping[str, Judged], names: Iterable[str]) -> dict[str, str]:
    """The best of some rows in each figure."""
    listed = list(names)
    return {figure: best(judged, listed, figure) for figure in COLUMNS}


def best(judged: Mapping[str, Judged], names: Iterable[str], figure: str) -> str:
    """The name with the best figure; gradient energy is best at 1."""
    found = {name: judged[name].row()[figure] for name in names}
    known = {name: value for name, value in found.items() if value is not None}
    if not known:
        return next(iter(found))
    if figure == "energy":
        return min(known, key=lambda name: abs(np.log(max(known[name], 1e-12))))
    sign = 1 if figure in LOWER else -1
    return min(known, key=lambda name: sign * known[name])


def difference_text(entry: Judged, other: Judged, figure: str) -> str:
    """A figure's difference from another method's with its interval; "-" where there is none."""
    if entry is other or entry.row()[figure] is None or other.row()[figure] is None:
        return "-"
    digits = COLUMNS[figure].digits
    middle, low, high = (
        f"{value:+.{digits}f}" for value in paired_interval(entry.scores, other.scores, figure)
    )
    return f"{middle} ({low} .. {high})"
