"""How well pictures of one scene agree with each other: depth, matches, features, MEt3R."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.evaluation.means import interval, mean

if TYPE_CHECKING:
    from gvtools.evaluation.posed_picture import PosedPicture
    from pipelines.console import Console
    from pipelines.evaluation.measured_target import MeasuredTarget

# Matching goes over all pairs; more views than these are sampled evenly.
MOST_MATCHED = 30


def consistency_figures(
    pictures: Sequence[PosedPicture],
    *,
    surfaces: Sequence[PosedPicture] | None = None,
    seed: int,
    label: str,
    console: Console,
) -> dict[str, Any]:
    """The measures of one set of pictures, JSON-ready; pairs are consecutive ones.

    Args:
        pictures: in the order of the run.
        surfaces: the same with the depth by which features are carried; None takes their own.
        seed: of resampling and robust estimates.
        label: of progress.
        console: for progress.
    """
    from gvtools.evaluation.consistency.depth_reprojection import depth_reprojection_of_views
    from gvtools.evaluation.consistency.feature_consistency import feature_consistency
    from gvtools.evaluation.consistency.geometric_verification import verify_geometry

    depth = asdict(depth_reprojection_of_views(pictures))
    pairs = list(pairwise(surfaces or pictures))
    features = [
        feature_consistency(first, second)
        for first, second in console.track(pairs, f"{label}: pairs")
    ]
    matched = _sampled(pictures, MOST_MATCHED)
    console.line(f"{label}: matching {len(matched)} pictures")
    geometry = asdict(verify_geometry(matched, seed=seed))
    return {
        "pairs": "consecutive views in the order of the run",
        "depth_reprojection": depth,
        "geometric_verification": geometry | {"sampled_of": len(pictures)},
        "feature_consistency": {
            "network": features[0].network if features else None,
            "score": interval([pair.score for pair in features], seed),
            "unrelated": mean([pair.unrelated for pair in features]),
            "overlap": mean([pair.overlap for pair in features]),
            "pairs": [asdict(pair) for pair in features],
        },
        "met3r": _met3r(pictures, seed),
    }


def with_surfaces(targets: Sequence[MeasuredTarget]) -> list[PosedPicture]:
    """The targets' pictures; those without depth of their own have the memory's."""
    return [
        target.picture
        if target.picture.depth is not None
        else replace(target.picture, depth=target.surface)
        for target in targets
    ]


def _met3r(pictures: Sequence[PosedPicture], seed: int) -> dict[str, Any]:
    from gvtools.evaluation.consistency.feature_consistency import load_met3r, met3r_score

    metric, status = load_met3r()
    scores = []
    if metric is not None:
        scores = [met3r_score(a, b, metric) for a, b in pairwise(pictures)]
        measured = sum(pair.score is not None for pair in scores)
        status = "measured" if measured else "empty: no pair with overlap"
    return {
        "status": status,
        "score": interval([pair.score for pair in scores], seed),
        "pairs": [asdict(pair) for pair in scores],
    }


def _sampled(pictures: Sequence[PosedPicture], most: int) -> list[PosedPicture]:
    rows = np.unique(
        np.linspace(0, len(pictures) - 1, min(most, len(pictures))).round().astype(int)
    )
    return [pictures[row] for row in rows]
