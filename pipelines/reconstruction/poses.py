"""Refinement of a run's poses, before everything else: those of trackers err by pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gvtools.appearance.fit_views import FitView
from gvtools.runs.layout import POSES
from gvtools.runs.poses import RunPoses, posed, with_poses
from gvtools.scenes.reduced import reduced
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
    recorded: bool,
    say: Callable[[str], None] | None = None,
) -> RunPoses | None:
    """Poses on which the context agrees; None where the given ones stay.

    Args:
        scene: the project.
        context: names of its views.
        targets: move like the context near them, if that errs alike.
        recorded: whether depth is recorded: it tells the scale, and poses where features do not.
        say: is told what was found.
    """
    from gvtools.appearance.refined_poses import refined_poses
    from gvtools.capture.pose_adjustment import SIDE, adjusted_poses, can_adjust, tracks_of

    scene = reduced(scene, SIDE)
    # Lengths stay small there, also in a world whose origin is far away.
    frame = grid_frame(scene, context)
    views = [scene[name] for name in context]
    given = scene.subset(context).cameras
    given = posed(given, frame.cam_from_local(given.cam_from_world))
    tracks = tracks_of(scene, context, frame)
    exact = tracks is not None and tracks.exact(given)
    if not recorded and (exact or not can_adjust(given, tracks)):
        return None
    needed = views if recorded or tracks is None else []
    frames = list(prefetch(lambda view: view.load(), needed))
    adjusted = adjusted_poses(frames, given, tracks=tracks)
    if recorded:
        fitted = [
            FitView(loaded.rgb, view.camera.K[0], pose, loaded.mask, loaded.depth)
            for view, pose, loaded in zip(views, given.cam_from_world, frames, strict=True)
        ]
        poses = None if adjusted is None else adjusted.scaled(frames, given)
        result = (None if poses is None else refined_poses(fitted, poses)) or refined_poses(fitted)
    else:
        result = None if adjusted is None else adjusted.refined(given)
    if say is not None and (recorded or result is not None):
        same = "as given; no others agree better with neighbouring views"
        say(f"poses: {same if result is None else result}")
    if result is None:
        return None
    moved = [result.corrected(pose) for pose in frame.cam_from_local(targets.cam_from_world)]
    return RunPoses(
        frame.cam_from_world(result.poses),
        frame.cam_from_world(np.array(moved).reshape(-1, 4, 4)),
        result.by_features,
    )


def saved(round_0: Path, context: Sequence[str], targets: Cameras) -> RunPoses | None:
    """The refined poses of a run whose round 0 is complete; None where the given ones stayed.

    None, too, where they are of another number of views: the run is another one then, and is
    refused for that.
    """
    path = round_0 / POSES
    poses = RunPoses.load(path) if path.exists() else None
    if poses is None or (len(poses.context), len(poses.targets)) != (len(context), len(targets)):
        return None
    return poses
