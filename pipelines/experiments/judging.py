"""Methods side by side on the same cases: scores, times, and tables with paired intervals."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from gvtools.completers.base import Completer, Completion
from gvtools.evaluation.generated_pixels import (
    GeneratedScore,
    figures,
    paired_interval,
    score,
)
from gvtools.evaluation.perceptual_distance import SqueezeNetDistance
from gvtools.evaluation.tables import Column, Table
from pipelines.experiments.cases import Case

# Figures whose smaller values are better.
LOWER = ("depth", "depth_view", "distance", "distance_view")
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

    Args:
        methods: by the name of their row.
        cases: each is made once.
        distance: None leaves the perceptual distance out.
        seed: of the completers.
    """
    judged = {name: Judged() for name in methods}
    for case in cases:
        truth = None if distance is None else distance.features(case.rgb)
        for name, completer in methods.items():
            begun = time.perf_counter()
            made = completer.complete(case.context, case.guidance, seed=seed)
            judged[name].seconds += time.perf_counter() - begun
            judged[name].views += len(case.guidance)
            judged[name].scores.append(scored(case, made, distance, truth))
    return judged


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
    against: str | None = None,
    notes: tuple[str, ...] = (),
) -> Table:
    """One row a method; with ``against`` the PSNR's and the depth's paired interval to that row."""
    columns = [Column("method"), *COLUMNS.values(), Column("seconds", "a view", "lower", 3)]
    rows: list[tuple[Any, ...]] = []
    if against is not None:
        columns += [
            Column(f"PSNR - {against}", "dB, 95 %"),
            Column(f"distance - {against}", "95 %"),
        ]
    for name, entry in judged.items():
        found = entry.row()
        row: list[Any] = [name, *(found[key] for key in COLUMNS), found["seconds"]]
        if against is not None:
            row += [
                _shown(entry, judged[against], "psnr"),
                _shown(entry, judged[against], "distance"),
            ]
        rows.append(tuple(row))
    return Table(tuple(columns), tuple(rows), caption, notes)


def records(judged: Mapping[str, Judged], against: str | None = None) -> list[dict[str, Any]]:
    """Rows for JSON, with paired intervals of every figure to the row ``against``."""
    rows = []
    for name, entry in judged.items():
        row: dict[str, Any] = {"method": name, **entry.row()}
        if against is not None and name != against:
            row["against"] = against
            row["difference"] = {
                key: paired_interval(entry.scores, judged[against].scores, key)
                for key in COLUMNS
                if entry.row()[key] is not None and judged[against].row()[key] is not None
            }
        rows.append(row)
    return rows


def best(judged: Mapping[str, Judged], names: Iterable[str], figure: str) -> str:
    """The name with the best figure; gradient energy is best at 1."""
    found = {name: judged[name].row()[figure] for name in names}
    known = {name: value for name, value in found.items() if value is not None}
    if figure == "energy":
        return min(known, key=lambda name: abs(np.log(max(known[name], 1e-12))))
    sign = 1 if figure in LOWER else -1
    return min(known, key=lambda name: sign * known[name])


def _shown(entry: Judged, other: Judged, figure: str) -> str:
    if entry is other or entry.row()[figure] is None or other.row()[figure] is None:
        return "-"
    middle, low, high = paired_interval(entry.scores, other.scores, figure)
    return f"{middle:+.2f} ({low:+.2f} .. {high:+.2f})"
