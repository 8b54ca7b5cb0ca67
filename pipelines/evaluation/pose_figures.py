"""Pose errors as JSON and tables have them."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gvtools.evaluation.trajectories import PoseAuc, PoseErrors, Statistics

FIGURES = ("rmse", "mean", "median", "std", "min", "max")


def pose_figures(errors: PoseErrors, auc: PoseAuc | None = None) -> dict[str, Any]:
    """The figures as JSON has them: those of the translation at the top, null where none is."""
    notes: dict[str, str] = {}
    if not errors.ok:
        notes["rmse"] = errors.status
    elif errors.translation_share is None:
        notes["translation_share"] = "the reference's centres have no extent"
    out: dict[str, Any] = {
        "status": errors.status,
        **statistics_figures(errors.translation),
        "scale": errors.scale,
        "extent": errors.extent,
        "translation_share": statistics_figures(errors.translation_share),
        "rotation_deg": statistics_figures(errors.rotation_deg),
    }
    if auc is not None:
        out["auc"] = {f"{threshold:g}": value for threshold, value in auc.auc.items()}
        out["auc_pairs"] = auc.pairs
        out["auc_pairs_without_motion"] = auc.still
        if auc.status != "measured":
            notes["auc"] = auc.status
    return {**out, "notes": notes}


def statistics_figures(statistics: Statistics | None) -> dict[str, Any]:
    """Statistics by name; null, and n 0, where there are none."""
    if statistics is None:
        return dict.fromkeys(FIGURES) | {"n": 0}
    return asdict(statistics)
