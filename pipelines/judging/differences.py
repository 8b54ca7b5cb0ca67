"""Methods against each other, view by view: differences with their bootstrap intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import combinations
from typing import Any

from gvtools.evaluation.intervals import mean_interval

# Of each figure, whether more is better.
PAIRED = {
    "psnr": True,
    "ssim": True,
    "lpips": False,
    "psnr_valid": True,
    "ssim_valid": True,
    "lpips_valid": False,
    "psnr_never_observed": True,
    "ssim_never_observed": True,
    "lpips_never_observed": False,
}


def differences(methods: Sequence[Mapping[str, Any]], seed: int) -> list[dict[str, Any]]:
    """For each pair of methods and figure: first minus second over the views that both have.

    Args:
        methods: as measured, with ``images``.
        seed: of resampling.

    Returns:
        One entry a pair and figure that some view has: mean, interval, number of views, and the
        share of them in which the first is better.
    """
    out = []
    for first, second in combinations(methods, 2):
        for figure, more in PAIRED.items():
            pairs = _pairs(first, second, figure)
            if not pairs:
                continue
            apart = [a - b for a, b in pairs]
            better = [value > 0 if more else value < 0 for value in apart]
            out.append(
                {
                    "first": first["name"],
                    "second": second["name"],
                    "figure": figure,
                    **asdict(mean_interval(apart, seed=seed)),
                    "first_better": sum(better) / len(better),
                }
            )
    return out


def _pairs(
    first: Mapping[str, Any], second: Mapping[str, Any], figure: str
) -> list[tuple[float, float]]:
    """The figures of the views that both methods have; equal pictures' infinities left out."""
    others = {(v["name"], v["round"]): v[figure] for v in second["images"]["views"]}
    pairs = [
        (view[figure], others.get((view["name"], view["round"])))
        for view in first["images"]["views"]
    ]
    return [
        (a, b) for a, b in pairs if a is not None and b is not None and not (a == b == float("inf"))
    ]
