"""What a fit starts from: the context's photographs with depth, and the first Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from gvtools.appearance.fit_views import FitView
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import LOG_SCALE
from gvtools.appearance.start import from_depth, from_points, pixels_with_depth
from gvtools.depth.choice import is_estimated
from gvtools.depth.source import DepthMap, is_recorded
from gvtools.errors import DegenerateError, ShapeError
from gvtools.scenes.images import resize_nearest
from gvtools.scenes.reduced import reduced
from gvtools.scenes.scene import Frame, View
from gvtools.view_selection import evenly_spread
from pipelines.reconstruction.prefetch import prefetch

if TYPE_CHECKING:
    from gvtools.memory.store.local_frame import LocalFrame
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan

# Fewer than FEW_POINTS sparse points are made up to ENOUGH_POINTS by pixels with depth, by a
# network or a plane sweep. With points that three to seven photographs detected, held-out pictures
# gain 1.3 to 2.8 dB by this; with 25,000 instead of 10,000 up to 0.8 dB less.
FEW_POINTS, ENOUGH_POINTS = 5_000, 10_000
# Longer side at which photographs are swept, and at which they enter the memory after a fit, which
# has their colours [px].
SWEPT_SIDE = 320
# A view takes about so long to sweep at 0.1 megapixels, all cores together [s]; a fit for a given
# time takes at most SWEEP_SHARE of it for the sweep, by smaller pictures or else without.
SWEEP_SECONDS, SWEEP_SHARE, SMALL_SIDE = 0.8, 0.15, 160
# So many views are swept however little time there is, where a fit has few points to begin with.
FEWEST_SWEPT = 12
# A fit needs at least so many sparse points and pixels with depth together.
FEWEST_POINTS = 100


def fit_views(
    plan: Plan, frame: LocalFrame, console: Console, *, sweep: Sweep | None = None
) -> list[FitView]:
    """The context's photographs, with recorded or estimated depth where there is some.

    Args:
        plan: of the run.
        frame: poses and Gaussians are fitted in its coordinates.
        console: is told of views without an estimate.
        sweep: gives an estimate of depth.
    """
    views = [plan.scene[name] for name in plan.context]
    poses = frame.cam_from_local(plan.scene.subset(plan.context).cameras.cam_from_world)
    frames = prefetch(lambda view: view.load(), views)
    return [
        FitView(
            loaded.rgb, view.camera.K[0], pose, loaded.mask,
            loaded.depth if is_recorded(plan.source, view) else None,
            _estimate(plan, view, loaded, sweep=sweep, console=console),
        )
        for view, pose, loaded in zip(views, poses, frames, strict=True)
    ]  # fmt: skip


def _estimate(
    plan: Plan, view: View, frame: Frame, *, sweep: Sweep | None, console: Console
) -> NDArray[np.float32] | None:
    """(H, W) estimated depth, scene units: by a network if that is the run's source, or a sweep."""
    if is_estimated(plan.source, view):
        try:
            return plan.source.depth(plan.scene, view, frame).depth
        except DegenerateError as error:
            console.warn(f"{view.name} is fitted without an estimate of its depth: {error}")
            return None
    if sweep is None or not sweep.covers(view):
        return None
    depth = sweep.depth(view)
    return None if depth is None else resize_nearest(depth, *frame.rgb.shape[1::-1])


def first_gaussians(plan: Plan, views: Sequence[FitView], frame: LocalFrame) -> Gaussians:
    """Gaussians at recorded depth, else at sparse points and, if these are few, estimated depth."""
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
        missing = ENOUGH_POINTS - len(positions)
        more = pixels_with_depth(estimated, seed=seed, count=missing)
        positions = np.concatenate([positions, more[0]])
        colors = np.concatenate([colors, more[1]])
    if len(positions) < FEWEST_POINTS:
        raise DegenerateError(
            f"{plan.scene.root}: {len(positions)} sparse points and pixels with depth in "
            f"{len(views)} views; expected at least {FEWEST_POINTS}; add photographs that overlap"
        )
    return from_points(positions, colors, frame=frame, most=most)


def known_surface(start: Gaussians, views: Sequence[FitView]) -> NDArray[np.float32] | None:
    """(N, 3) points on surfaces, which nothing may float before; None where depth is recorded.

    Recorded depth keeps Gaussians on surfaces by itself, and where only some views have it, it
    tells nothing of what the others see.

    Args:
        start: Gaussians at sparse points and pixels with depth.
        views: of the fit; their estimates tell of surfaces without sparse points.
    """
    if any(view.depth is not None for view in views):
        return None
    estimated = [replace(v, depth=v.estimate) for v in views if v.estimate is not None]
    more = pixels_with_depth(estimated, seed=0, count=ENOUGH_POINTS)[0]
    return np.concatenate([start.values[:, :LOG_SCALE], more.astype(np.float32)])


class Sweep:
    """Plane-sweep depth of a run's photographs, at a size that its fit has time for.

    Each view is swept once, when it is asked for.

    Attributes:
        scene: the project at that size.
    """

    def __init__(self, plan: Plan, side: int, names: Sequence[str]) -> None:
        from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo

        self.scene = reduced(plan.scene, side)
        stereo = plan.config.stereo
        options = stereo.replaced(max_side=min(stereo.max_side, side))
        self._source = PlaneSweepStereo(self.scene, options=options, views=plan.context)
        self._names, self._kept = frozenset(names), dict[str, DepthMap | None]()

    @classmethod
    def of(cls, plan: Plan, *, begins: bool = True) -> Sweep | None:
        """The sweep of a run; None if it has other depth, one view, or too little time.

        Args:
            plan: of the run.
            begins: whether a new fit needs points to begin with; with few, some views are swept
                even if there is no time for all.
        """
        recorded = any(is_recorded(plan.source, plan.scene[name]) for name in plan.context)
        estimated = any(is_estimated(plan.source, plan.scene[name]) for name in plan.context)
        if recorded or estimated or len(plan.context) < 2:
            return None
        few = plan.scene.points is None or len(plan.scene.points.positions) < FEW_POINTS
        limit, views = plan.config.refine.limit, len(plan.context)
        for side in (SWEPT_SIDE, SMALL_SIDE):
            each = SWEEP_SECONDS * (side / SWEPT_SIDE) ** 2 / get_num_threads()
            if limit is not None:
                views = int(SWEEP_SHARE * limit / each)
            if views >= len(plan.context):
                return cls(plan, side, plan.context)
        if not (few and begins):
            return None
        return cls(plan, SMALL_SIDE, list(evenly_spread(plan.context, max(views, FEWEST_SWEPT))))

    def depth(self, view: View) -> NDArray[np.float32] | None:
        """(H, W) z-depth, scene units, of ``scene``'s view; None if no other shows what it does."""
        found = self.map_of(view)
        return None if found is None else found.depth

    def map_of(self, view: View) -> DepthMap | None:
        """The depth with its confidence."""
        if view.name not in self._kept:
            view, found = self.scene[view.name], None
            with suppress(DegenerateError):
                found = self._source.depth(self.scene, view, view.load())
            self._kept[view.name] = found
        return self._kept[view.name]

    def covers(self, view: View) -> bool:
        """The context's views, or those of them that there is time for."""
        return view.name in self._names
