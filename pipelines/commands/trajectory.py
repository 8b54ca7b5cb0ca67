"""``gvtools trajectory``: how far estimated poses are from a reference."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from pipelines.commands.arguments import RootArguments, refuse_root

if TYPE_CHECKING:
    from gvtools.evaluation.trajectories import PoseErrors
    from pipelines.console import Console

SUMMARY = "measure the pose errors (ATE, RPE, AUC) of a trajectory against its reference"
EXAMPLES = (
    "gvtools trajectory ate groundtruth.txt estimate.txt --align sim3",
    "gvtools trajectory rpe colmap/sparse/0 runs/mine --delta 10 --all-pairs --json rpe.json",
)
# All pairs of longer trajectories are too many, and say no more.
MOST_FOR_AUC = 2000


class TrajectoryArguments(RootArguments):
    """The command's arguments."""

    positional = ("metric", "reference", "estimate")

    metric: Literal["ate", "rpe"]
    """Absolute or relative error."""
    reference: Path
    """A TUM, KITTI or EuRoC file, a COLMAP model, a project, or a run. [REFERENCE]"""
    estimate: Path
    """Likewise. [ESTIMATE]"""
    align: Literal["none", "se3", "sim3"] = "sim3"
    """Of the estimate's centres to the reference's."""
    delta: int = 1
    """Frames between the poses of a pair. [N]"""
    all_pairs: bool = False
    """Pairs start at every frame."""
    associate: Literal["auto", "time", "name", "index"] = "auto"
    """Auto: what both have, in the order name, time, index."""
    max_difference: float = Field(0.01, ge=0)
    """Of times that belong together. [seconds]"""
    offset: float = 0.0
    """To add to the estimate's. [seconds]"""
    layout: Literal["auto", "tum", "kitti", "euroc"] = "auto"
    """Of trajectory files."""
    allow_mirrored: bool = False
    """Give figures also where the estimate is the reference's mirror image."""
    json_: Path | None = None
    """Write the figures there. [FILE]"""


def run(args: TrajectoryArguments, console: Console) -> None:
    """Associate, align, measure."""
    from gvtools.evaluation.trajectories import absolute_errors, pose_auc, relative_errors
    from gvtools.files import write_json
    from pipelines.inputs.trajectory_source import associate, open_trajectory
    from pipelines.scoring.measurement import pose_figures

    refuse_root(args.root, (args.reference, args.estimate))
    reference = open_trajectory(args.reference, layout=args.layout, root=args.root)
    estimate = open_trajectory(args.estimate, layout=args.layout, root=args.root)
    first, second, how = associate(
        reference,
        estimate,
        how=args.associate,
        max_difference=args.max_difference,
        offset=args.offset,
    )
    poses = reference.poses[first], estimate.poses[second]
    refuse = not args.allow_mirrored
    if args.metric == "ate":
        errors = absolute_errors(*poses, align=args.align, refuse_mirrored=refuse)
        auc = pose_auc(*poses) if len(first) <= MOST_FOR_AUC else None
    else:
        errors = relative_errors(
            *poses,
            align=args.align,
            delta=args.delta,
            all_pairs=args.all_pairs,
            refuse_mirrored=refuse,
        )
        auc = None
    figures = {
        "metric": args.metric,
        "align": args.align,
        "association": how,
        "poses_reference": len(reference),
        "poses_estimate": len(estimate),
        "associated": len(first),
        **({"delta": args.delta, "all_pairs": args.all_pairs} if args.metric == "rpe" else {}),
        **pose_figures(errors, auc),
    }
    if args.metric == "ate" and auc is None:
        figures["notes"]["auc"] = f"not measured over more than {MOST_FOR_AUC} poses"
    if args.json_ is not None:
        write_json(args.json_, figures)
    else:
        _print(figures, errors, console)
    if not errors.ok:
        console.warn(f"no figures: {errors.status}")


def _print(figures: dict[str, Any], errors: PoseErrors, console: Console) -> None:
    from pipelines.scoring.measurement import POSE_STATISTICS, statistics_figures

    console.line(
        f"{figures['metric'].upper()}: {figures['associated']} poses of "
        f"{figures['poses_reference']} and {figures['poses_estimate']}, associated by "
        f"{figures['association']}; {figures['status']}"
        + (f", scale {errors.scale:.6g}" if figures["align"] == "sim3" and errors.scale else "")
    )
    rows = [
        [
            name,
            *(statistics_figures(statistics)[key] for key in POSE_STATISTICS),
            statistics_figures(statistics)["n"],
        ]
        for name, statistics in (
            ("translation, scene units", errors.translation),
            (f"translation / extent {errors.extent:.4g}", errors.translation_share),
            ("rotation, degrees", errors.rotation_deg),
        )
    ]
    console.table(["error", *POSE_STATISTICS, "n"], rows)
    if figures.get("auc"):
        shares = ", ".join(
            f"@{key} {value:.4f}" for key, value in figures["auc"].items() if value is not None
        )
        console.line(f"pose AUC over {figures['auc_pairs']} pairs, degrees: {shares or '-'}")
