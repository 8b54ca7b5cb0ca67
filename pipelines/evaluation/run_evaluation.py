"""Everything that is measured on a finished run: pictures, consistency, poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.evaluation.intervals import mean_interval
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.evaluation.view_figures import FIGURES, view_figures
from gvtools.runs.memory_file import load_memory
from gvtools.runs.run import Run

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from gvtools.evaluation.pose_probe.features import FeatureMatcher
    from gvtools.scenes.scene import Frame
    from pipelines.console import Console

PARTS = ("images", "consistency", "poses")
# Matching goes over all pairs; more views than these are sampled evenly.
MOST_MATCHED = 30
# Context views that the probe locates by the others, to tell its own error.
CONTROLS = 8


@dataclass(frozen=True, eq=False)
class _Target:
    """One target with all that its figures need."""

    number: int
    entry: dict[str, Any]
    picture: PosedPicture
    observed: Any
    generated: Any
    truth: Frame | None


def evaluate_run(
    run: Run,
    *,
    parts: Sequence[str],
    lpips: Lpips | None,
    no_lpips: str | None,
    matcher: FeatureMatcher | None = None,
    control: bool = True,
    seed: int = 0,
    console: Console,
) -> dict[str, Any]:
    """Measure one run.

    The figures are JSON-ready, by part; what could not be measured is None, with the reason under
    ``notes``.

    Args:
        run: with at least one round of targets.
        parts: of PARTS.
        lpips: the network, or None.
        no_lpips: why there is none.
        matcher: of the pose probe; None is SIFT.
        control: measure the true pictures of the targets as well, to read the figures by.
        seed: of resampling, matching and robust estimates.
        console: for progress.
    """
    targets = [
        _Target(
            view.round,
            dict(view.report),
            PosedPicture(files.name, files.camera, files.picture, files.depth),
            files.observed,
            files.generated,
            None if truth is None else truth.load(),
        )
        for view, files, truth in run.targets()
    ]
    out: dict[str, Any] = {
        "rounds": len(run.rounds) - 1,
        "views": len(targets),
        "coverage": _mean([target.entry["coverage"] for target in targets]),
        "seconds_per_view": _seconds_per_view(run),
    }
    if "images" in parts:
        out["images"] = _images(targets, lpips, no_lpips, seed=seed, console=console)
    if "consistency" in parts:
        out["consistency"] = _consistency(targets, control, seed, console=console)
    if "poses" in parts:
        out["poses"] = _poses(run, targets, matcher, control=control, seed=seed, console=console)
    return out


def _images(
    targets: Sequence[_Target],
    lpips: Lpips | None,
    no_lpips: str | None,
    *,
    seed: int,
    console: Console,
) -> dict[str, Any]:
    views = []
    for target in console.track(targets, "images"):
        figures: dict[str, Any] = {
            "name": target.picture.name,
            "round": target.number,
            "coverage": target.entry["coverage"],
            "coverage_after": target.entry["coverage_after"],
            "observed": float(target.observed.mean()),
            **dict.fromkeys(FIGURES),
        }
        if target.truth is not None:
            figures |= view_figures(
                target.picture.rgb,
                target.truth,
                observed=target.observed,
                generated=target.generated,
                depth=target.picture.depth,
                lpips=lpips,
            )
        views.append(figures)
    notes = {}
    if lpips is None and no_lpips:
        notes["lpips"] = no_lpips
    if not any(target.truth for target in targets):
        notes["psnr"] = "no target has a true picture"
    if any(view["psnr"] == float("inf") for view in views):
        notes["psnr"] = "infinite, and null in JSON, where pictures are equal"
    masked = [
        1 - float(t.truth.mask.mean()) for t in targets if t.truth and t.truth.mask is not None
    ]
    numbers = sorted({view["round"] for view in views})
    return {
        "mean": {name: _interval([view[name] for view in views], seed) for name in FIGURES},
        "rounds": [
            {
                "round": number,
                **{
                    name: _interval([v[name] for v in views if v["round"] == number], seed)
                    for name in FIGURES
                },
            }
            for number in numbers
        ],
        "views": views,
        "settings": {
            "psnr": "peak 1, mean over pixels and channels",
            "ssim": "Gaussian window 11x11, sigma 1.5, population covariances, data range 1",
            "lpips": f"lpips package, network {lpips.net}" if lpips else None,
            "masked_share": max(masked, default=0.0),
        },
        "notes": notes,
    }


def _consistency(
    targets: Sequence[_Target],
    control: bool,
    seed: int,
    *,
    console: Console,
) -> dict[str, Any]:
    pictures = [target.picture for target in targets]
    out = {"generated": _consistent(pictures, seed, console, label="consistency")}
    true = _true_pictures(targets)
    if control and len(true) > 1:
        label = "consistency of the true pictures"
        out["true_pictures"] = _consistent(true, seed, console, label=label)
    return out


def _true_pictures(targets: Sequence[_Target]) -> list[PosedPicture]:
    return [
        PosedPicture(
            target.picture.name,
            target.picture.camera,
            target.truth.rgb,
            target.truth.depth,
            target.truth.mask,
        )
        for target in targets
        if target.truth is not None
    ]


def _consistent(
    pictures: Sequence[PosedPicture],
    seed: int,
    console: Console,
    *,
    label: str,
) -> dict[str, Any]:
    """The three measures of one set of pictures; pairs are consecutive ones."""
    from gvtools.evaluation.consistency.depth_reprojection import depth_reprojection_of_views
    from gvtools.evaluation.consistency.feature_consistency import (
        feature_consistency,
        load_met3r,
        met3r_score,
    )
    from gvtools.evaluation.consistency.geometric_verification import verify_geometry

    depth = asdict(depth_reprojection_of_views(pictures))
    features = [
        feature_consistency(first, second)
        for first, second in console.track(list(pairwise(pictures)), f"{label}: pairs")
    ]
    matched = _sampled(pictures, MOST_MATCHED)
    console.line(f"{label}: matching {len(matched)} pictures")
    geometry = asdict(verify_geometry(matched, seed=seed))
    out: dict[str, Any] = {
        "pairs": "consecutive views in the order of the run",
        "depth_reprojection": depth,
        "geometric_verification": geometry | {"sampled_of": len(pictures)},
        "feature_consistency": {
            "network": features[0].network if features else None,
            "score": _interval([pair.score for pair in features], seed),
            "unrelated": _mean([pair.unrelated for pair in features]),
            "overlap": _mean([pair.overlap for pair in features]),
            "pairs": [asdict(pair) for pair in features],
        },
    }
    metric, status = load_met3r()
    scores = []
    if metric is not None:
        scores = [met3r_score(a, b, metric) for a, b in pairwise(pictures)]
        measured = sum(pair.score is not None for pair in scores)
        status = "measured" if measured else "empty: no pair with overlap"
    out["met3r"] = {
        "status": status,
        "score": _interval([pair.score for pair in scores], seed),
        "pairs": [asdict(pair) for pair in scores],
    }
    return out


def _poses(
    run: Run,
    targets: Sequence[_Target],
    matcher: FeatureMatcher | None,
    *,
    control: bool,
    seed: int,
    console: Console,
) -> dict[str, Any]:
    from gvtools.errors import DegenerateError
    from gvtools.evaluation.pose_probe.probe import PoseProbe

    try:
        probe = PoseProbe(_context_pictures(run), matcher=matcher, seed=seed)
    except DegenerateError as error:
        return {"status": f"degenerate: {error}", "success_share": None}
    found = [probe.locate(target.picture) for target in console.track(targets, "pose probe")]
    out: dict[str, Any] = {
        "status": "measured",
        "matcher": type(matcher).__name__ if matcher else "SiftMatcher",
        **_pose_figures(found, [target.picture for target in targets]),
    }
    if control:
        pictures = _true_pictures(targets)
        if pictures:
            true = [probe.locate(p) for p in console.track(pictures, "pose probe, true pictures")]
            out["true_pictures"] = _pose_figures(true, pictures)
        if len(run.context) > 2:
            left_out = probe.leave_one_out(CONTROLS)
            out["context_left_out"] = _pose_figures(left_out, None)
    return out


def _context_pictures(run: Run) -> list[PosedPicture]:
    """The context views, with the depth of the memory's observed points as each sees them."""
    memory = load_memory(run.path, up_to=0)
    pictures = []
    for name in run.context:
        view = run.scenes[0][name]
        frame = view.load()
        depth = memory.project(view.camera).depth[0]
        pictures.append(PosedPicture(name, view.camera, frame.rgb, depth, frame.mask))
    return pictures


def _pose_figures(found: Sequence[Any], pictures: Sequence[PosedPicture] | None) -> dict[str, Any]:
    """The probe's summary, and ATE and RPE of the poses that it found."""
    from gvtools.evaluation.pose_probe.located import summarise
    from gvtools.evaluation.trajectories import absolute_errors, relative_errors
    from pipelines.evaluation.pose_figures import pose_figures

    summary = asdict(summarise(found))
    summary["rotation_auc"] = {f"{k:g}": v for k, v in summary["rotation_auc"].items()}
    out = {
        **summary,
        "views": [
            {
                "name": one.name,
                "status": one.status,
                "inliers": one.inliers,
                "matches": one.matches,
                "rotation_error_deg": one.rotation_error_deg,
                "center_error": one.center_error,
                "cam_from_world": None
                if one.cam_from_world is None
                else one.cam_from_world.tolist(),
            }
            for one in found
        ],
    }
    if pictures is None:
        return out
    rows = [i for i, one in enumerate(found) if one.ok]
    requested = np.array([pictures[i].camera.world_from_cam[0] for i in rows]).reshape(-1, 4, 4)
    estimated = np.array([np.linalg.inv(found[i].cam_from_world) for i in rows]).reshape(-1, 4, 4)
    out["rpe_pairs"] = "consecutive located views"
    out["auc"] = _auc(found, pictures)
    for align in ("none", "sim3"):
        out[f"ate_{align}"] = pose_figures(absolute_errors(requested, estimated, align=align))
        out[f"rpe_{align}"] = pose_figures(relative_errors(requested, estimated, align=align))
    return out


def _auc(found: Sequence[Any], pictures: Sequence[PosedPicture]) -> dict[str, float | None]:
    """Pose AUC over all pairs of the pictures; a pair with a failure counts as wrong."""
    from gvtools.evaluation.trajectories import AUC_THRESHOLDS, pose_auc

    rows = [i for i, one in enumerate(found) if one.ok]
    pairs = len(found) * (len(found) - 1) // 2
    keys = [f"{threshold:g}" for threshold in AUC_THRESHOLDS]
    if len(rows) < 2:
        return dict.fromkeys(keys, 0.0 if pairs else None)
    requested = np.array([pictures[i].camera.world_from_cam[0] for i in rows])
    estimated = np.array([np.linalg.inv(found[i].cam_from_world) for i in rows])
    auc = pose_auc(requested, estimated)
    share = auc.pairs / pairs
    return {key: share * (value or 0.0) for key, value in zip(keys, auc.auc.values(), strict=True)}


def _sampled(pictures: Sequence[PosedPicture], most: int) -> list[PosedPicture]:
    rows = np.unique(
        np.linspace(0, len(pictures) - 1, min(most, len(pictures))).round().astype(int)
    )
    return [pictures[row] for row in rows]


def _interval(values: Sequence[float | None], seed: int) -> dict[str, Any]:
    return asdict(mean_interval(values, seed=seed))


def _mean(values: Sequence[float | None]) -> float | None:
    return mean_interval(values).mean


def _seconds_per_view(run: Run) -> float | None:
    reports = run.rounds[1:]
    views = sum(len(report["views"]) for report in reports)
    return sum(report["seconds"]["total"] for report in reports) / views if views else None
