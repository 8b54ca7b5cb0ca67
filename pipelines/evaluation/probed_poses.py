"""Where pictures really look from, found from the pictures alone, beside where they should."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.evaluation.pose_figures import pose_figures

if TYPE_CHECKING:
    from gvtools.evaluation.pose_probe.located import Located
    from gvtools.evaluation.posed_picture import PosedPicture


def probed_figures(
    found: Sequence[Located], pictures: Sequence[PosedPicture] | None
) -> dict[str, Any]:
    """The probe's summary, and ATE and RPE of the poses that it found, JSON-ready.

    Args:
        found: one for each picture.
        pictures: with the poses that they should have; None gives the summary alone.
    """
    from gvtools.evaluation.pose_probe.located import summarise
    from gvtools.evaluation.trajectories import absolute_errors, relative_errors

    summary = asdict(summarise(found))
    summary["rotation_auc"] = {f"{k:g}": v for k, v in summary["rotation_auc"].items()}
    out = {**summary, "views": [_view(one) for one in found]}
    if pictures is None:
        return out
    rows = [i for i, one in enumerate(found) if one.ok]
    requested, estimated = _poses(found, pictures, rows)
    out["rpe_pairs"] = "consecutive located views"
    out["auc"] = _auc(found, pictures)
    for align in ("none", "sim3"):
        out[f"ate_{align}"] = pose_figures(absolute_errors(requested, estimated, align=align))
        out[f"rpe_{align}"] = pose_figures(relative_errors(requested, estimated, align=align))
    return out


def _view(one: Located) -> dict[str, Any]:
    pose = one.cam_from_world
    return {
        "name": one.name,
        "status": one.status,
        "inliers": one.inliers,
        "matches": one.matches,
        "rotation_error_deg": one.rotation_error_deg,
        "center_error": one.center_error,
        "cam_from_world": None if pose is None else pose.tolist(),
    }


def _poses(
    found: Sequence[Located], pictures: Sequence[PosedPicture], rows: Sequence[int]
) -> tuple[Any, Any]:
    """(N, 4, 4) world_from_cam of the located pictures, as requested and as found."""
    requested = [pictures[i].camera.world_from_cam[0] for i in rows]
    located = [found[i].cam_from_world for i in rows]
    estimated = [np.linalg.inv(pose) for pose in located if pose is not None]
    return np.array(requested).reshape(-1, 4, 4), np.array(estimated).reshape(-1, 4, 4)


def _auc(found: Sequence[Located], pictures: Sequence[PosedPicture]) -> dict[str, float | None]:
    """Pose AUC over all pairs of the pictures; a pair with a failure counts as wrong."""
    from gvtools.evaluation.trajectories import AUC_THRESHOLDS, pose_auc

    rows = [i for i, one in enumerate(found) if one.ok]
    pairs = len(found) * (len(found) - 1) // 2
    keys = [f"{threshold:g}" for threshold in AUC_THRESHOLDS]
    if len(rows) < 2:
        return dict.fromkeys(keys, 0.0 if pairs else None)
    auc = pose_auc(*_poses(found, pictures, rows))
    share = auc.pairs / pairs
    return {key: share * (value or 0.0) for key, value in zip(keys, auc.auc.values(), strict=True)}
