"""Before everything else: the poses of RGB-D views, which come from a tracker, are refined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvtools.appearance.fit_views import FitView
from gvtools.runs.layout import POSES
from gvtools.runs.poses import RunPoses, posed, with_poses
from pipelines.reconstruction.prefetch import prefetch
from pipelines.reconstruction.voxel_edge import grid_frame

if TYPE_CHECKING:
    from gvtools.cameras import Cameras
    from gvtools.scenes.scene import Scene
    from pipelines.reconstruction.plan import Plan


def applied(poses: RunPoses, plan: Plan) -> Plan:
    """A plan with other poses of its context and targets."""
    targets = replace(plan.targets, cameras=posed(plan.targets.cameras, poses.targets))
    scene = with_poses(plan.scene, plan.context, poses.context)
    return replace(plan, scene=scene, targets=targets)


def refined(
    scene: Scene,
    context: Sequence[str],
    targets: Cameras,
    *,
    say: Callable[[str], None] | None = None,
) -> RunPoses | None:
    """Poses on which the context agrees; None where the given ones stay.

    Args:
        scene: the project.
        context: names of its views; only where all have recorded depth are they refined.
        targets: move like the context near them, if that errs alike.
        say: is told what was found.
    """
    views = [scene[name] for name in context]
    if not all(view.has_depth for view in views):
        return None
    from gvtools.appearance.refined_poses import refined_poses

    # Lengths stay small there, also in a world whose origin is far away.
    frame = grid_frame(scene, context)
    given = frame.cam_from_local(scene.subset(context).cameras.cam_from_world)
    frames = prefetch(lambda view: view.load(), views)
    result = refined_poses([
        FitView(loaded.rgb, view.camera.K[0], pose, loaded.mask, loaded.depth)
        for view, pose, loaded in zip(views, given, frames, strict=True)
    ])  # fmt: skip
    if say is not None:
        same = "as given; no others agree better with neighbouring views"
        say(f"poses: {same if result is None else result}")
    if result is None:
        return None
    moved = [result.corrected(pose) for pose in frame.cam_from_local(targets.cam_from_world)]
    return RunPoses(
        frame.cam_from_world(result.poses),
        frame.cam_from_world(np.array(moved).reshape(-1, 4, 4)),
    )


def saved(round_0: Path, context: Sequence[str], targets: Cameras) -> RunPoses | None:
    """The refined poses of a run whose round 0 is complete; None where the given ones stayed.

    None, too, where they are of another number of views: the run is another one then, and is
    refused for that.

    Raises:
        MemoryFileError: damaged.
    """
    path = round_0 / POSES
    poses = RunPoses.load(path) if path.exists() else None
    if poses is None or (len(poses.context), len(poses.targets)) != (len(context), len(targets)):
        return None
    return poses
