"""``gvtools trajectory``: how far estimated poses are from a reference."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError
from pipelines.commands.arguments import add_root_argument, refuse_root

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("metric", choices=("ate", "rpe"), help="absolute or relative error")
    for name in ("reference", "estimate"):
        parser.add_argument(
            name,
            type=Path,
            metavar=name.upper(),
            help="a TUM, KITTI or EuRoC file, a COLMAP model, a project, or a run",
        )
    add_root_argument(parser)
    parser.add_argument(
        "--align",
        choices=("none", "se3", "sim3"),
        default="sim3",
        help="of the estimate's centres to the reference's (default sim3)",
    )
    parser.add_argument(
        "--delta", type=int, default=1, metavar="N", help="frames between the poses of a pair (1)"
    )
    parser.add_argument("--all-pairs", action="store_true", help="pairs start at every frame")
    parser.add_argument(
        "--associate",
        default="auto",
        metavar="HOW",
        help="time, name, index, or auto: what both have, in the order name, time, index",
    )
    parser.add_argument(
        "--max-difference",
        type=float,
        default=0.01,
        metavar="SECONDS",
        help="of times that belong together (default %(default)s)",
    )
    parser.add_argument(
        "--offset", type=float, default=0.0, metavar="SECONDS", help="to add to the estimate's"
    )
    parser.add_argument("--layout", default="auto", metavar="NAME", help="tum, kitti or euroc")
    parser.add_argument(
        "--allow-mirrored",
        action="store_true",
        help="give figures also where the estimate is the reference's mirror image",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")


def run(args: argparse.Namespace, console: Console) -> None:
    """Associate, align, measure."""
    from gvtools.evaluation.trajectories import absolute_errors, pose_auc, relative_errors
    from gvtools.files import write_json
    from pipelines.inputs.trajectory_source import LAYOUTS, associate, open_trajectory
    from pipelines.scoring.measurement import pose_figures

    if args.layout not in LAYOUTS:
        raise OptionError(f"--layout {args.layout!r}; expected one of {', '.join(LAYOUTS)}")
    if not args.max_difference >= 0:
        raise OptionError(f"--max-difference {args.max_difference}; expected 0 or more seconds")
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
    if args.json is not None:
        write_json(args.json, figures)
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
