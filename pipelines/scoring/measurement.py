"""The one path by which pictures are measured, whoever made them: images, consistency, poses.

The targets' true pictures are measured once in the same way, however many sets of pictures of them
there are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import DegenerateError, ProjectError
from gvtools.evaluation.images import FIGURES, Lpips, view_figures
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.evaluation.statistics import mean_interval, mean_known
from gvtools.scenes.inspection import spread

if TYPE_CHECKING:
    from gvtools.evaluation.pose_probe import Located, PoseProbe
    from gvtools.evaluation.statistics import ErrorStatistics
    from gvtools.evaluation.trajectories import PoseAuc, PoseErrors
    from gvtools.features import FeatureMatcher
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.runs.run import Run
    from gvtools.scenes.scene import Frame
    from pipelines.console import Console

PARTS = ("images", "consistency", "poses")
NEVER_OBSERVED = "never_observed"
# Of pictures that any method made: what the context never observed is the same region for all.
JUDGED = (*FIGURES, *(f"{name}_{NEVER_OBSERVED}" for name in ("psnr", "ssim", "lpips")))
# Of a set of pose errors.
POSE_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
# Context views that the probe locates by the others, to tell its own error.
CONTROLS = 8
# Matching goes over all pairs; more views than these are sampled evenly.
MOST_MATCHED = 30


@dataclass(frozen=True, eq=False)
class MeasuredTarget:
    """One target with all that its figures need."""

    number: int  # of its round, from 1
    picture: PosedPicture  # what is measured, seen from where it is meant to be
    observed: NDArray[np.bool_]  # (H, W), pixels that the context observed, by the memory
    generated: NDArray[np.bool_]  # (H, W), pixels that the run's completer made
    truth: Frame | None
    # Share of the pixels that the memory supported before and after the round; None where no run
    # completed the target.
    coverage: float | None = None
    coverage_after: float | None = None
    # (H, W) z-depth of the memory, scene units, 0 = none, by which features are carried between
    # pictures without depth of their own.
    surface: NDArray[np.float32] | None = None

    @property
    def key(self) -> tuple[str, int]:
        """Name and round, by which a run has it once."""
        return self.picture.name, self.number


def load_measured(path: Path, *, project: Path | None = None) -> Run:
    """A run with at least one completed target; ``project`` is where its project lies now."""
    from gvtools.runs.run import load_run

    run = load_run(path, project=project)
    if len(run.rounds) < 2:
        raise ProjectError(
            f"{path}: no round of targets is done; expected one; add --resume to reconstruct"
        )
    return run


def run_targets(run: Run) -> list[MeasuredTarget]:
    """The completed targets of a run with the pictures that it made, in the order of its rounds."""
    return [
        MeasuredTarget(
            view.round,
            PosedPicture(files.name, files.camera, files.picture, files.depth),
            files.observed,
            files.generated,
            None if truth is None else truth.load(),
            coverage=view.report["coverage"],
            coverage_after=view.report["coverage_after"],
        )
        for view, files, truth in run.targets()
    ]


def true_pictures(targets: Sequence[MeasuredTarget]) -> list[PosedPicture]:
    """The true pictures of the targets that have one, from the same cameras."""
    return [
        PosedPicture(t.picture.name, t.picture.camera, t.truth.rgb, t.truth.depth, t.truth.mask)
        for t in targets
        if t.truth is not None
    ]


def context_pictures(run: Run, memory: SpatialMemory) -> list[PosedPicture]:
    """The context views, with the depth of the memory's points as each sees them.

    The memory is that after round 0, which holds the context alone.
    """
    pictures = []
    for name in run.context:
        view = run.scenes[0][name]
        frame = view.load()
        depth = memory.project(view.camera).depth[0]
        pictures.append(PosedPicture(name, view.camera, frame.rgb, depth, frame.mask))
    return pictures


def matcher_called(name: str) -> FeatureMatcher | None:
    """The pose probe's matcher, "sift" or "lightglue"; None is the probe's own, SIFT."""
    if name == "sift":
        return None
    from gvtools.features import LightGlueMatcher

    return LightGlueMatcher()


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasureOptions:
    """What is measured of pictures, and how."""

    parts: Sequence[str]  # of PARTS
    lpips: Lpips | None = None
    no_lpips: str | None = None  # why there is none
    lpips_net: str = "vgg"  # that was asked for
    matcher: str = "sift"  # of the pose probe, or "lightglue"
    control: bool = True  # measure the true pictures as well, to read the figures by
    seed: int = 0  # of resampling, matching and robust estimates


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurement:
    """Measures sets of pictures of the same targets, against one context and truth."""

    options: MeasureOptions
    context: Callable[[], list[PosedPicture]]  # with the memory's depth; called when needed
    truths: Sequence[PosedPicture]  # the true pictures of all targets
    names: Sequence[str] = FIGURES  # of figures of pictures, or JUDGED
    console: Console
    matcher: FeatureMatcher | None = None  # None is the pose probe's own, SIFT

    def of(self, targets: Sequence[MeasuredTarget]) -> dict[str, Any]:
        """The figures by part, JSON-ready; what could not be measured is None.

        Reasons stand under ``notes`` and ``status``.
        """
        out: dict[str, Any] = {}
        if "images" in self.options.parts:
            out["images"] = self._images(targets)
        if "consistency" in self.options.parts:
            out["consistency"] = self._consistency(targets)
        if "poses" in self.options.parts:
            out["poses"] = self._poses([target.picture for target in targets])
        return out

    def _means(self, views: Sequence[dict[str, Any]]) -> dict[str, Any]:
        seed = self.options.seed
        return {name: interval([view[name] for view in views], seed) for name in self.names}

    def _images(self, targets: Sequence[MeasuredTarget]) -> dict[str, Any]:
        """A row a view, means over all views and over each round."""
        views = [self._view(target) for target in self.console.track(targets, "images")]
        notes = {}
        if self.options.no_lpips and not self.options.lpips:
            notes["lpips"] = self.options.no_lpips
        if not any(target.truth for target in targets):
            notes["psnr"] = "no target has a true picture"
        if any(view["psnr"] == float("inf") for view in views):
            notes["psnr"] = "infinite, and null in JSON, where pictures are equal"
        masks = [t.truth.mask for t in targets if t.truth and t.truth.mask is not None]
        return {
            "mean": self._means(views),
            "rounds": [
                {"round": number, **self._means([v for v in views if v["round"] == number])}
                for number in sorted({view["round"] for view in views})
            ],
            "views": views,
            "settings": {
                "psnr": "peak 1, mean over pixels and channels",
                "ssim": "Gaussian window 11x11, sigma 1.5, population covariances, data range 1",
                "lpips": f"lpips package, network {self.options.lpips.net}"
                if self.options.lpips
                else None,
                # Of the true picture of which the least counts.
                "masked_share": max((1 - float(mask.mean()) for mask in masks), default=0.0),
            },
            "notes": notes,
        }

    def _view(self, target: MeasuredTarget) -> dict[str, Any]:
        figures: dict[str, Any] = {
            "name": target.picture.name,
            "round": target.number,
            "coverage": target.coverage,
            "coverage_after": target.coverage_after,
            "observed": float(target.observed.mean()),
            **dict.fromkeys(self.names),
        }
        if target.truth is not None:
            figures |= view_figures(
                target.picture.rgb,
                target.truth,
                observed=target.observed,
                generated=target.generated,
                others={NEVER_OBSERVED: ~target.observed} if self.names == JUDGED else {},
                depth=target.picture.depth,
                lpips=self.options.lpips,
            )
        return figures

    def _consistency(self, targets: Sequence[MeasuredTarget]) -> dict[str, Any]:
        pictures = [target.picture for target in targets]
        # Pictures without depth of their own have the memory's.
        surfaces = [
            picture if picture.depth is not None else replace(picture, depth=target.surface)
            for picture, target in zip(pictures, targets, strict=True)
        ]
        generated = self._agreement(pictures, surfaces, label="consistency")
        if not self.options.control or len(self.truths) < 2:
            return {"generated": generated}
        return {"generated": generated, "true_pictures": self._true_consistency}

    @cached_property
    def _true_consistency(self) -> dict[str, Any]:
        label = "consistency of the true pictures"
        return self._agreement(self.truths, self.truths, label=label)

    def _agreement(
        self, pictures: Sequence[PosedPicture], surfaces: Sequence[PosedPicture], *, label: str
    ) -> dict[str, Any]:
        """How well pictures of one scene agree, in the order of the run.

        ``surfaces`` are the same with the depth by which features are carried.
        """
        from gvtools.evaluation.feature_consistency import feature_consistency
        from gvtools.evaluation.geometric_verification import verify_geometry
        from gvtools.evaluation.posed_picture import depth_reprojection_of_views

        depth = asdict(depth_reprojection_of_views(pictures))
        pairs = self.console.track(list(pairwise(surfaces)), f"{label}: pairs")
        features = [feature_consistency(first, second) for first, second in pairs]
        matched = [pictures[row] for row in spread(len(pictures), MOST_MATCHED)]
        self.console.line(f"{label}: matching {len(matched)} pictures")
        geometry = asdict(verify_geometry(matched, seed=self.options.seed))
        return {
            "pairs": "consecutive views in the order of the run",
            "depth_reprojection": depth,
            "geometric_verification": geometry | {"sampled_of": len(pictures)},
            "feature_consistency": {
                "network": features[0].network if features else None,
                "score": interval([pair.score for pair in features], self.options.seed),
                "unrelated": mean_known([pair.unrelated for pair in features]),
                "overlap": mean_known([pair.overlap for pair in features]),
                "pairs": [asdict(pair) for pair in features],
            },
            "met3r": _met3r(pictures, self.options.seed),
        }

    def _poses(self, pictures: Sequence[PosedPicture]) -> dict[str, Any]:
        probe = self._probe
        if isinstance(probe, str):
            return {"status": f"degenerate: {probe}", "success_share": None}
        located = [probe.locate(picture) for picture in self.console.track(pictures, "pose probe")]
        return {
            "status": "measured",
            "matcher": type(self.matcher).__name__ if self.matcher else "SiftMatcher",
            **_probed_figures(located, pictures),
            **self._true_poses,
        }

    @cached_property
    def _probe(self) -> PoseProbe | str:
        """The probe, or why there is none."""
        from gvtools.evaluation.pose_probe import PoseProbe

        try:
            return PoseProbe(self._context, matcher=self.matcher, seed=self.options.seed)
        except DegenerateError as error:
            return str(error)

    @cached_property
    def _context(self) -> list[PosedPicture]:
        return self.context()

    @cached_property
    def _true_poses(self) -> dict[str, Any]:
        """The same of the true pictures, and of context views that the others locate."""
        probe, out = self._probe, {}
        if isinstance(probe, str) or not self.options.control:
            return {}
        if self.truths:
            tracked = self.console.track(self.truths, "pose probe, true pictures")
            out["true_pictures"] = _probed_figures([probe.locate(p) for p in tracked], self.truths)
        if len(self._context) > 2:
            out["context_left_out"] = _probed_figures(probe.leave_one_out(CONTROLS), None)
        return out


def interval(values: Iterable[float | None], seed: int) -> dict[str, Any]:
    """Mean, ends of its bootstrap interval, and number of the values that are there, for JSON."""
    return asdict(mean_interval(values, seed=seed))


def _met3r(pictures: Sequence[PosedPicture], seed: int) -> dict[str, Any]:
    from gvtools.evaluation.feature_consistency import load_met3r, met3r_score

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


def pose_figures(errors: PoseErrors, auc: PoseAuc | None = None) -> dict[str, Any]:
    """Pose errors as JSON has them: those of the translation at the top, null where none is."""
    notes: dict[str, str] = {}
    if not errors.ok:
        notes["rmse"] = errors.status
    elif errors.translation_share is None:
        notes["translation_share"] = "the reference's centres have no extent"
    if errors.ok and errors.rotation_deg is None:
        notes["rotation_deg"] = errors.status
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


def statistics_figures(statistics: ErrorStatistics | None) -> dict[str, Any]:
    """Statistics by name; null, and n 0, where there are none."""
    return asdict(statistics) if statistics else dict.fromkeys(POSE_STATISTICS) | {"n": 0}


def _probed_figures(
    located: Sequence[Located], pictures: Sequence[PosedPicture] | None
) -> dict[str, Any]:
    """The probe's summary, and where the pictures' own poses are given, ATE, RPE and AUC."""
    from gvtools.evaluation.pose_probe import summarise
    from gvtools.evaluation.trajectories import (
        AUC_THRESHOLDS,
        absolute_errors,
        pose_auc,
        relative_errors,
    )

    summary = asdict(summarise(located))
    summary["rotation_auc"] = {f"{k:g}": v for k, v in summary["rotation_auc"].items()}
    keys = ("name", "status", "inliers", "matches", "rotation_error_deg", "center_error")
    views = [
        {key: getattr(one, key) for key in keys}
        | {"cam_from_world": None if one.cam_from_world is None else one.cam_from_world.tolist()}
        for one in located
    ]
    out = {**summary, "views": views}
    if pictures is None:
        return out
    rows = [row for row, one in enumerate(located) if one.ok]
    requested = np.array([pictures[row].camera.world_from_cam[0] for row in rows])
    poses = [one.cam_from_world for one in located if one.ok]
    estimated = np.array([np.linalg.inv(pose) for pose in poses if pose is not None])
    both = requested.reshape(-1, 4, 4), estimated.reshape(-1, 4, 4)
    out["rpe_pairs"] = "consecutive located views"
    # Over all pairs of the pictures; one with a failure counts as wrong.
    pairs = len(located) * (len(located) - 1) // 2
    if len(rows) < 2:
        out["auc"] = {f"{threshold:g}": 0.0 if pairs else None for threshold in AUC_THRESHOLDS}
    else:
        auc = pose_auc(*both)
        share = auc.pairs / pairs
        out["auc"] = {f"{key:g}": share * (value or 0.0) for key, value in auc.auc.items()}
    for align in ("none", "sim3"):
        out[f"ate_{align}"] = pose_figures(absolute_errors(*both, align=align))
        out[f"rpe_{align}"] = pose_figures(relative_errors(*both, align=align))
    return out
