"""Pictures against their true ones: a row a view, means over all views and over each round."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from gvtools.evaluation.view_figures import FIGURES, view_figures
from pipelines.evaluation.means import interval

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from pipelines.console import Console
    from pipelines.evaluation.measured_target import MeasuredTarget

NEVER_OBSERVED = "never_observed"
# Of pictures that any method made: what the context never observed is the same region for all.
JUDGED = (*FIGURES, *(f"{name}_{NEVER_OBSERVED}" for name in ("psnr", "ssim", "lpips")))


def picture_figures(
    targets: Sequence[MeasuredTarget],
    lpips: Lpips | None,
    no_lpips: str | None,
    *,
    names: Sequence[str] = FIGURES,
    seed: int,
    console: Console,
) -> dict[str, Any]:
    """The figures of the pictures, JSON-ready.

    Args:
        targets: with the pictures.
        lpips: the network, or None.
        no_lpips: why there is none.
        names: FIGURES, or JUDGED.
        seed: of resampling.
        console: for progress.
    """
    views = []
    for target in console.track(targets, "images"):
        figures: dict[str, Any] = {
            "name": target.picture.name,
            "round": target.number,
            "coverage": target.coverage,
            "coverage_after": target.coverage_after,
            "observed": float(target.observed.mean()),
            **dict.fromkeys(names),
        }
        if target.truth is not None:
            figures |= view_figures(
                target.picture.rgb,
                target.truth,
                observed=target.observed,
                generated=target.generated,
                others={NEVER_OBSERVED: ~target.observed} if names == JUDGED else {},
                depth=target.picture.depth,
                lpips=lpips,
            )
        views.append(figures)
    numbers = sorted({view["round"] for view in views})
    return {
        "mean": {name: interval([view[name] for view in views], seed) for name in names},
        "rounds": [
            {
                "round": number,
                **{
                    name: interval([v[name] for v in views if v["round"] == number], seed)
                    for name in names
                },
            }
            for number in numbers
        ],
        "views": views,
        "settings": {
            "psnr": "peak 1, mean over pixels and channels",
            "ssim": "Gaussian window 11x11, sigma 1.5, population covariances, data range 1",
            "lpips": f"lpips package, network {lpips.net}" if lpips else None,
            "masked_share": _masked_share(targets),
        },
        "notes": _notes(targets, views, no_lpips=None if lpips else no_lpips),
    }


def _masked_share(targets: Sequence[MeasuredTarget]) -> float:
    """The largest share of a true picture that does not count."""
    masks = [t.truth.mask for t in targets if t.truth and t.truth.mask is not None]
    return max((1 - float(mask.mean()) for mask in masks), default=0.0)


def _notes(
    targets: Sequence[MeasuredTarget], views: Sequence[dict[str, Any]], *, no_lpips: str | None
) -> dict[str, str]:
    notes = {}
    if no_lpips:
        notes["lpips"] = no_lpips
    if not any(target.truth for target in targets):
        notes["psnr"] = "no target has a true picture"
    if any(view["psnr"] == float("inf") for view in views):
        notes["psnr"] = "infinite, and null in JSON, where pictures are equal"
    return notes
