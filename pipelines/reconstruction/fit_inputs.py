"""What a fit starts from: the context's photographs with depth, and the first Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.fit_views import FitView
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.start import from_depth, from_points, pixels_with_depth
from gvtools.depth.choice import is_estimated, rough_source
from gvtools.depth.source import is_recorded
from gvtools.errors import DegenerateError, ShapeError
from gvtools.scenes.scene import Frame, View
from gvtools.view_selection import evenly_spread
from pipelines.reconstruction.prefetch import prefetch

if TYPE_CHECKING:
    from gvtools.depth.source import DepthSource
    from gvtools.memory.store.local_frame import LocalFrame
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan

# Fewer than FEW_POINTS sparse points are made up to ENOUGH_POINTS by pixels with depth, by a
# network or a plane sweep of at most SWEPT_VIEWS views. With points that three to seven photographs
# detected, held-out pictures gain 1.3 to 2.8 dB by this; with 25,000 instead of 10,000 up to 0.8 dB
# less. A sweep takes as long as hundreds of steps: where there are 9,000 points, these gain more.
FEW_POINTS, ENOUGH_POINTS, SWEPT_VIEWS = 5_000, 10_000, 12
# A fit needs at least so many sparse points and pixels with depth together.
FEWEST_POINTS = 100


def fit_views(plan: Plan, frame: LocalFrame, console: Console) -> list[FitView]:
    """The context's photographs, with recorded or estimated depth where the run takes one.

    Args:
        plan: of the run.
        frame: poses and Gaussians are fitted in its coordinates.
        console: is told of views without an estimate.
    """
    views = [plan.scene[name] for name in plan.context]
    poses = frame.cam_from_local(plan.scene.subset(plan.context).cameras.cam_from_world)
    frames = prefetch(lambda view: view.load(), views)
    return [
        FitView(
            loaded.rgb, view.camera.K[0], pose, loaded.mask,
            loaded.depth if is_recorded(plan.source, view) else None,
            _estimate(plan, view, loaded, console=console),
        )
        for view, pose, loaded in zip(views, poses, frames, strict=True)
    ]  # fmt: skip


def _estimate(
    plan: Plan, view: View, frame: Frame, *, console: Console
) -> NDArray[np.float32] | None:
    """(H, W) depth estimated by a network, scene units, if the run's depth source is one.

    Plane-sweep depth is not used as a loss: it holds no more information than the photographs, and
    where it is unsure, a fit to it loses up to 0.4 dB.
    """
    if not is_estimated(plan.source, view):
        return None
    try:
        return plan.source.depth(plan.scene, view, frame).depth
    except DegenerateError as error:
        console.warn(f"{view.name} is fitted without an estimate of its depth: {error}")
        return None


def first_gaussians(plan: Plan, views: Sequence[FitView], frame: LocalFrame) -> Gaussians:
    """Gaussians at recorded depth, else at sparse points and, if these are few, estimated depth.

    Raises:
        GvError: a camera with skew, or too few points and pixels with depth.
    """
    if any(view.K[0, 1] for view in views):
        raise ShapeError("cameras with skew; expected none; undistort the photographs first")
    seed, most = plan.config.seed, plan.config.refine.most_gaussians
    if any(view.depth is not None for view in views):
        return from_depth(views, frame=frame, seed=seed, most=most)
    points = plan.scene.points
    positions, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if points is not None:
        positions, colors = frame.from_world(points.positions), points.colors
    if len(positions) < FEW_POINTS:
        estimated = [replace(v, depth=v.estimate) for v in views if v.estimate is not None]
        lifted = estimated or _swept(plan, views)
        missing = ENOUGH_POINTS - len(positions)
        more = pixels_with_depth(lifted, seed=seed, count=missing)
        positions = np.concatenate([positions, more[0]])
        colors = np.concatenate([colors, more[1]])
    if len(positions) < FEWEST_POINTS:
        raise DegenerateError(
            f"{plan.scene.root}: {len(positions)} sparse points and pixels with depth in "
            f"{len(views)} views; expected at least {FEWEST_POINTS}; add photographs that overlap"
        )
    return from_points(positions, colors, frame=frame, most=most)


def _swept(plan: Plan, views: Sequence[FitView]) -> list[FitView]:
    """At most SWEPT_VIEWS views with plane-sweep depth; views that overlap no other are skipped."""
    from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo

    if len(plan.context) < 2:
        return []
    source: DepthSource = PlaneSweepStereo(
        plan.scene, options=plan.config.stereo, views=plan.context
    )
    if len(views) > SWEPT_VIEWS:
        # At a coarse size: depth is swept for the neighbours of each view, too.
        source = rough_source(plan.scene, source)
    swept = []
    for name, view in evenly_spread(list(zip(plan.context, views, strict=True)), SWEPT_VIEWS):
        frame = Frame(view.rgb, None, view.mask)
        with suppress(DegenerateError):
            depth = source.depth(plan.scene, plan.scene[name], frame).depth
            swept.append(replace(view, depth=depth))
    return swept
