"""Gaussians that a fit begins with: at points and pixels with depth, or from a file, placed.

And the swept depth of a run's photographs, as far as there is time for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.population import (
    STARTING_GAUSSIANS,
    from_depth,
    from_points,
    pixels_with_depth,
)
from gvtools.appearance.splat.project_kernels import VALUES
from gvtools.depth.choice import is_estimated
from gvtools.depth.source import DepthMap, is_recorded
from gvtools.errors import DegenerateError
from gvtools.poses.refinement import FitView
from gvtools.scans.registration import (
    ESTIMATE,
    FEWEST,
    Placement,
    Surface,
    given_placement,
    register,
)
from gvtools.scenes.inspection import spread
from gvtools.scenes.matching import paired
from gvtools.scenes.resized import reduced
from gvtools.scenes.scene import View
from gvtools.splat_files import holds_splats, read_splats
from gvtools.splats import LOG_SCALE, LOGIT, QUATERNION, Splats, place_gaussians
from gvtools.untrusted import read_json
from pipelines.reconstruction.prepare import photographed

if TYPE_CHECKING:
    from gvtools.memory.store.local_frame import LocalFrame
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan

# Fewer than FEW_POINTS sparse points are made up to ENOUGH_POINTS by pixels with depth, by a
# network or a plane sweep. With points that three to seven photographs detected, held-out pictures
# gain 1.3 to 2.8 dB by this; with 25,000 instead of 10,000 up to 0.8 dB less.
FEW_POINTS, ENOUGH_POINTS = 5_000, 10_000
# A fit needs at least so many sparse points and pixels with depth together.
FEWEST_POINTS = 100
# The progress at which a fit begins with fitted Gaussians. The fox in 30 s: 30.55 dB so, 30.33 at
# 0.35, 30.21 at 0.6, 29.76 at 0.85 and 29.39 without them.
GIVEN = 0.15
# Gaussians of at least this opacity are surfaces, by which they are placed.
OPAQUE = 0.5
# Splats lie where they belong if pictures of them beat the photographs' mean colour by LEAST_GAIN
# [dB] (median of LOOKED_AT, SIDE px long). NEAR: the near plane, in median distances.
LEAST_GAIN, LOOKED_AT, SIDE, NEAR = 2.0, 5, 160, 0.02
# Where splats may lie: where converters leave the axes of SPZ (right, up, back) or glTF, too.
AXES = (
    Placement(np.eye(4), "as it is"),
    Placement(np.diag([1.0, -1.0, -1.0, 1.0]), "turned half around x"),
    Placement(np.diag([-1.0, -1.0, 1.0, 1.0]), "turned half around z"),
)
# The smallest fitness of a placement of splats that photographs may decide on.
LEAST_SUPPORT = 0.25
# Folders above a file in which its cameras are sought; how far they may be from the project's on
# average: centres as a share of the extent, and turns.
ABOVE, ALIKE = 3, 0.02
# Longer side at which photographs are swept [px].
SWEPT_SIDE = 320
# A view of 0.1 megapixels takes one core about so long to sweep [s]; a fit for a given
# time takes at most SWEEP_SHARE of it for the sweep, by smaller pictures or else without.
SWEEP_SECONDS, SWEEP_SHARE, SMALL_SIDE = 0.8, 0.15, 160
# So many views are swept however little time there is, where a fit has few points to begin with.
FEWEST_SWEPT = 12


class Sweep:
    """Plane-sweep depth of a run's photographs, at a size that its fit has time for.

    Each view is swept once, when it is asked for; ``scene`` is the project at that size.
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

        A fit that ``begins`` needs points: with few, some views are swept however little time.
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
        rows = spread(len(plan.context), max(views, FEWEST_SWEPT))
        return cls(plan, SMALL_SIDE, [plan.context[row] for row in rows])

    def depth(self, view: View) -> NDArray[np.float32] | None:
        """(H, W) z-depth, scene units, of ``scene``'s view; None if no other shows what it does."""
        depth_map = self.map_of(view)
        return None if depth_map is None else depth_map.depth

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


@dataclass(frozen=True, eq=False)
class GivenStart:
    """What a fit begins with instead of sparse points or depth."""

    gaussians: Gaussians
    fitted: bool  # whether they are Gaussians already, so that a fit goes on instead of beginning


def given_start(plan: Plan, frame: LocalFrame, console: Console) -> GivenStart | None:
    """The Gaussians of ``refine.init``; None where it names no file."""
    options = plan.config.refine
    if options.init is None:
        return None
    path = Path(options.init)
    if not holds_splats(path):
        from gvtools.scans.read import read_scan

        scan = read_scan(path)
        positions = scan.positions + scan.origin
        placement = _placed(positions, plan, console, path=path)
        local = frame.from_world(placement.apply(positions) if placement else positions)
        some = from_points(local, scan.colors, frame=frame, most=options.most_gaussians)
        console.line(f"fitting begins with {len(some):,} of {len(scan):,} points of {path}")
        return GivenStart(some, fitted=False)
    splats = read_splats(path)
    opaque = splats.opacities > OPAQUE
    surface = splats.positions[opaque if opaque.any() else slice(None)] + splats.origin

    def shows(placed: Placement) -> bool:
        return _shows(_local(splats, placed, frame), plan, frame)

    tried = AXES if _asked(plan) == ESTIMATE else ()
    placement = next((placed for placed in tried if shows(placed)), None)
    if placement is not None:
        console.line(f"{path.name}: placement {placement.how}, since the photographs show it")
    else:
        placement = _placed(surface, plan, console, path=path, shows=shows)
    values = _strongest(_local(splats, placement, frame), options.most_gaussians)
    fewer = f" of {len(splats):,}" if len(values) < len(splats) else ""
    cut = "" if splats.values.shape[1] <= VALUES else ", without harmonics above degree 2"
    console.line(f"fitting begins with {len(values):,}{fewer} Gaussians of {path}{cut}")
    return GivenStart(Gaussians(values, frame=frame), fitted=True)


def _shows(values: NDArray[np.float32], plan: Plan, frame: LocalFrame) -> bool:
    """Whether Gaussians in a frame look like the photographs, more than their mean colour does."""
    gaussians = Gaussians(values, frame=frame)
    gains = []
    for row in spread(len(plan.context), LOOKED_AT):
        view = plan.scene[plan.context[row]]
        rgb = view.load().rgb
        factor = min(SIDE / max(rgb.shape[:2]), 1)
        size = [max(1, round(side * factor)) for side in rgb.shape[1::-1]]
        photograph = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)) / 255
        camera = view.camera.resized(*size)
        depth = np.linalg.norm(frame.to_world(values[:, :LOG_SCALE]) - camera.centers[0], axis=1)
        shown = Appearance(gaussians, float(NEAR * np.median(depth))).picture(camera).rgb
        errors = [np.square(each - photograph).mean() for each in (shown, photograph.mean((0, 1)))]
        gains.append(10 * np.log10((errors[1] + 1e-9) / (errors[0] + 1e-9)))
    return bool(np.median(gains) > LEAST_GAIN)


def _asked(plan: Plan) -> str:
    """The placement that the user gives; that of a scan beside it is not the start's."""
    return plan.config.scan.placement if plan.config.scan.file is None else ESTIMATE


def _placed(
    positions: NDArray[np.float64],
    plan: Plan,
    console: Console,
    *,
    path: Path,
    shows: Callable[[Placement], bool] | None = None,
) -> Placement | None:
    """Where surfaces of a file lie; None: as they are, where the project knows hardly any.

    With ``shows``, photographs decide where few points support a placement.
    """
    options = plan.config.scan
    if (asked := _asked(plan)) != ESTIMATE:
        return given_placement(asked)
    if (placement := _by_cameras(path, plan)) is not None:
        console.line(f"{path.name}: placement {placement.summary()}")
        return placement
    try:
        known = photographed(plan)
    except DegenerateError:
        known = None
    if known is None or len(known.positions) < FEWEST:
        console.warn(
            f"{path}: taken as it lies, since the project has fewer than {FEWEST} points to place "
            "it by; give --cloud-placement where it lies elsewhere"
        )
        return None
    least = options.min_fitness if shows is None else min(LEAST_SUPPORT, options.min_fitness)
    try:
        placement = register(
            Surface(positions, None), known, least=least,
            metric=plan.scene.metric, seed=plan.config.seed,
        )  # fmt: skip
        few = max(placement.fitness or 0, placement.scan_fitness or 0) < options.min_fitness
        if shows is not None and few and not shows(placement):
            raise DegenerateError(
                f"nothing like the photographs where it fits best ({placement.summary()}); give "
                "its placement"
            )
    except DegenerateError as error:
        raise DegenerateError(f"{path}: {error} (--cloud-placement)") from None
    console.line(f"{path.name}: placement {placement.summary()}")
    return placement


def _by_cameras(path: Path, plan: Plan) -> Placement | None:
    """By the cameras that 3D Gaussian Splatting leaves above its splats."""
    files = [folder / "cameras.json" for folder in path.resolve().parents[:ABOVE]]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        return None
    try:
        entries = read_json(file)
        told = [np.column_stack([entry["rotation"], entry["position"]]) for entry in entries]
        rows = paired([str(entry["img_name"]) for entry in entries], plan.scene.names)
        theirs = np.array([told[row] for row, _ in rows], np.float64).reshape(-1, 3, 4)
    except (KeyError, TypeError, ValueError, DegenerateError):
        # Somebody else's file of that name, or one whose names say too little.
        return None
    mine = plan.scene.cameras.world_from_cam[[row for _, row in rows]]
    if len(rows) < 2 or not np.isfinite(theirs).all():
        return None
    u, alike, vt = np.linalg.svd(
        np.mean(mine[:, :3, :3] @ theirs[:, :, :3].transpose(0, 2, 1), axis=0)
    )
    middles = mine[:, :3, 3].mean(axis=0), theirs[:, :, 3].mean(axis=0)
    moved, around = mine[:, :3, 3] - middles[0], (theirs[:, :, 3] - middles[1]) @ (u @ vt).T
    scale = np.sqrt((moved**2).sum() / max((around**2).sum(), 1e-300))
    off = np.linalg.norm(moved - scale * around, axis=1).mean()
    if alike.min() < 1 - ALIKE or off > ALIKE * np.ptp(moved, axis=0).max():
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = scale * u @ vt
    matrix[:3, 3] = middles[0] - matrix[:3, :3] @ middles[1]
    return Placement(matrix, f"by {len(rows)} cameras of {file.name}")


def _local(splats: Splats, placement: Placement | None, frame: LocalFrame) -> NDArray[np.float32]:
    """(N, VALUES) rows in a frame; harmonics above degree 2 are left out."""
    world, origin = splats.values, splats.origin
    if placement is not None:
        world, _ = place_gaussians(world, placement.world_from_scan)
        origin = placement.apply(origin[None])[0]
    local, _ = place_gaussians(world, np.block([[frame.axes.T, np.zeros((3, 1))], [0, 0, 0, 1]]))
    rows = np.zeros((len(local), VALUES), np.float32)
    count = min(VALUES, local.shape[1])
    rows[:, :count] = local[:, :count]
    rows[:, :LOG_SCALE] += frame.from_world(origin)
    return rows


def _strongest(values: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    """At most so many rows: those of the most light, which is opacity times area."""
    if len(values) <= most:
        return values
    sizes = np.sort(values[:, LOG_SCALE:QUATERNION], axis=1)[:, 1:].sum(axis=1)
    light = sizes - np.log1p(np.exp(-values[:, LOGIT]))
    return values[np.sort(np.argsort(-light, kind="stable")[:most])]


def first_gaussians(plan: Plan, views: Sequence[FitView], frame: LocalFrame) -> Gaussians:
    """Gaussians at recorded depth; where views lack it, at sparse points, and estimates if few."""
    seed, most = plan.config.seed, plan.config.refine.most_gaussians
    recorded = [view for view in views if view.depth is not None]
    if len(recorded) == len(views):
        return from_depth(views, frame=frame, seed=seed, most=most)
    points = plan.scene.points
    share = 1.0 if points is None else len(recorded) / len(views)
    parts = [pixels_with_depth(recorded, seed=seed, count=round(share * STARTING_GAUSSIANS))]
    if points is not None:
        parts.append((frame.from_world(points.positions), points.colors))
    known = sum(len(part[0]) for part in parts)
    if known < FEW_POINTS:
        count = ENOUGH_POINTS - known
        parts.append(pixels_with_depth(_estimated(views), seed=seed, count=count))
    positions, colors = (np.concatenate(each) for each in zip(*parts, strict=True))
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
    """
    if any(view.depth is not None for view in views):
        return None
    more = pixels_with_depth(_estimated(views), seed=0, count=ENOUGH_POINTS)[0]
    return np.concatenate([start.values[:, :LOG_SCALE], more.astype(np.float32)])


def _estimated(views: Sequence[FitView]) -> list[FitView]:
    """Those with an estimate, as their depth."""
    return [replace(v, depth=v.estimate) for v in views if v.estimate is not None]
