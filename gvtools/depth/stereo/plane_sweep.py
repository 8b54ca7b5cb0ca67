"""Depth from photographs with known poses: the stages of multi-view stereo, view by view.

Of one view: a coarse sweep, then planes carried to finer levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate, reduced_size
from gvtools.depth.options import StereoOptions
from gvtools.depth.source import DepthMap
from gvtools.depth.stereo import filtering
from gvtools.depth.stereo.geometry import (
    DepthRange,
    Hypotheses,
    best_plane,
    choose_sources,
    disparity_rate,
    estimate_range,
    parabola,
    plane_hypotheses,
    range_of_depths,
)
from gvtools.depth.stereo.matching import (
    Level,
    Matcher,
    Pyramid,
    TorchMatcher,
    build_pyramid,
    level_of,
    resample,
    resample_colors,
    residual_flow,
    textured,
)
from gvtools.depth.stereo.matching_cpu import CpuMatcher
from gvtools.errors import DegenerateError
from gvtools.kernels import KernelSet
from gvtools.networks.compute import named_device
from gvtools.poses.dense_adjustment import PoseEquations, adjust_cameras, pose_equations
from gvtools.scenes.scene import Frame, Scene, View

# A new plane must be better by this much; ties keep what came from the coarser level.
GAIN = 0.004
FIT_RADIUS = 3
# Cost below which a first estimate tells the range of depths, and the share of pixels it needs.
SURE, SURE_SHARE = 0.3, 0.1
# Pixels by which the nearest depth must move in a source against infinity.
LEAST_DISPARITY = 0.5
# Below which a pixel is matched at all; by how much depth must match better than a turn alone; and
# the share of the matched pixels that have to.
MATCHED, BETTER, BETTER_SHARE = 0.3, 0.02, 0.05
# Expected errors of poses that are adjusted: radians, and a share of the typical depth.
ROTATION_ERROR, TRANSLATION_ERROR = 0.01, 0.005
ALIGNMENT_ROUNDS = 3
# Poses are left alone when the median motion that no depth explains is below this, pixels of the
# coarsest level: measured 0.16 with exact poses, 0.64 with those of a Kinect's tracker.
EXACT_ENOUGH = 0.25


class PlaneSweepStereo:
    """Depth from photographs with known poses; see gvtools.depth.source.DepthSource.

    Only ``views`` are ever looked at as sources. Each view's own estimate is computed once, when it
    or a view that it confirms is asked for, and kept (about 5 MB at 640x480); asking for the depth
    of all views therefore takes time linear in their number. Poses are adjusted, where they are, at
    the first question; depth is that of the adjusted camera, and a view outside ``views`` keeps the
    pose that it has.
    """

    name = "plane-sweep"

    def __init__(
        self, scene: Scene, *, options: StereoOptions | None = None, views: tuple[str, ...]
    ) -> None:
        """Prepare; nothing is computed yet."""
        self.options = options or StereoOptions()
        self.views = tuple(dict.fromkeys(views))
        self._pool = replace(scene, views=tuple(scene[name] for name in self.views), points=None)
        self._scene = scene
        self._matcher, self._device = make_matcher(self.options)
        self._pyramids: dict[str, Pyramid] = {}
        self._ranges: dict[str, DepthRange] = {}
        self._raw: dict[str, RawDepth] = {}
        self._poses: Cameras | None = None

    def covers(self, view: View) -> bool:
        """The views that it was given."""
        return view.name in self.views

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The depth of ``view``, whose pixels are ``frame``; 0 where it is not known well."""
        raw = self.raw(view, frame)
        options = self.options
        others = []
        for name in raw.sources:
            # No view of the pool may show what it does.
            with suppress(DegenerateError):
                others.append(self.raw(self._scene[name]))
        compared = filtering.agreement(
            raw.inverse_depth, raw.camera,
            [(other.inverse_depth, other.camera) for other in others],
            tolerance=options.tolerance,
        )  # fmt: skip
        matched = (raw.cost <= options.cost) & raw.textured
        confirmed = matched & (compared.views >= options.views)
        confidence = filtering.confidence_of(raw.cost, compared.views, compared.spread)
        inverse = compared.inverse_depth
        depth = torch.where(inverse > 0, 1 / inverse, torch.zeros_like(inverse)).cpu().numpy()
        guide = self._pyramid(view, frame).images[0].numpy()
        trust = confidence.cpu().numpy()
        known = self._outlined(depth, matched.cpu().numpy(), confirmed.cpu().numpy(), frame=frame)
        known = filtering.weighted_median(known, guide, trust, 2)
        height, width = frame.rgb.shape[:2]
        if known.shape != (height, width):
            full = build_pyramid(frame.rgb, view.camera, max_side=max(height, width), levels=1)
            known, trust = filtering.enlarge(known, guide, full.images[0].numpy(), trust)
        if frame.mask is not None:
            known = np.where(frame.mask, known, np.float32(0))
        return DepthMap(known, np.where(known > 0, trust, np.float32(1)), self.name)

    def _outlined(
        self,
        depth: NDArray[np.float32],
        matched: NDArray[np.bool_],
        confirmed: NDArray[np.bool_],
        *,
        frame: Frame,
    ) -> NDArray[np.float32]:
        """(H, W) confirmed depth, cut back to outlines and continued where it matches."""
        options = self.options
        known = np.where(confirmed, depth, np.float32(0))
        known = filtering.remove_speckles(known, options.tolerance, options.speckle)
        if not (options.trim or options.regrow):
            return known
        rgb = resample_colors(frame.rgb, depth.shape[1], depth.shape[0])
        candidates = np.where(matched, depth, known)
        if options.trim:
            known = filtering.trim_outlines(known, rgb, options.window // 2 + 2)
        if options.regrow:
            known = filtering.regrow(known, candidates, rgb, options.tolerance, options.regrow)
        return filtering.remove_speckles(known, options.tolerance, options.speckle)

    def raw(self, view: View, frame: Frame | None = None) -> RawDepth:
        """A view's own estimate, before other views are asked; kept for the views in ``views``."""
        if view.name in self._raw:
            return self._raw[view.name]
        _ = self.cameras  # poses first
        raw = self._fine(*self._coarse(view, frame))
        if view.name in self.views:
            self._raw[view.name] = raw
        return raw

    @property
    def cameras(self) -> Cameras:
        """The cameras of ``views`` with the poses that are used, adjusted or as given."""
        if self._poses is None:
            self._poses = self._pool.cameras
            align = self.options.align
            if self._scene.points is None if align is None else align:
                self._poses = self._aligned()
        return self._poses

    def _aligned(self) -> Cameras:
        """All poses of ``views`` adjusted to the pictures, in rounds of matching and solving."""
        cameras = self._pool.cameras
        for _ in range(ALIGNMENT_ROUNDS):
            measured = [self._measured(i, view) for i, view in enumerate(self._pool)]
            equations = [equation for equation in measured if equation is not None]
            off = [found.off for _, _, found in equations]
            if not off or not np.nanmedian(np.concatenate(off)) > EXACT_ENOUGH:
                break
            depths = [np.sqrt(r.lower * r.upper) for r in self._ranges.values()]
            cameras = adjust_cameras(
                cameras, equations,
                rotation=ROTATION_ERROR, translation=TRANSLATION_ERROR * float(np.median(depths)),
            )  # fmt: skip
            self._poses = cameras
        return cameras

    def _measured(self, row: int, view: View) -> tuple[int, list[int], PoseEquations] | None:
        """What a view's pictures say about the poses: its row, its sources' rows, equations."""
        try:
            coarse, reference, sources = self._coarse(view)
        except DegenerateError:
            return None
        cameras = concatenate([source.cameras[-1] for source in sources.values()])
        flow = residual_flow(coarse.level, coarse.inverse_depth, noise=self.options.noise)
        found = pose_equations(
            cameras, reference.cameras[-1], coarse.inverse_depth.cpu().numpy(),
            motion=torch.stack([flow.dx, flow.dy], -1).cpu().numpy(),
            weight=flow.weight.cpu().numpy(),
        )  # fmt: skip
        return None if found is None else (row, [self.views.index(n) for n in sources], found)

    def _coarse(
        self, view: View, frame: Frame | None = None
    ) -> tuple[CoarseDepth, Pyramid, dict[str, Pyramid]]:
        """The coarse estimate of a view, its pictures, and its sources' pictures by name."""
        reference = self._pyramid(view, frame)
        if view.name not in self._ranges:
            self._ranges[view.name] = self._range(view, reference)
        depths = self._ranges[view.name]
        sources = {name: self._pyramid(self._scene[name]) for name in self._sources(view, depths)}
        coarse = self._sweep(reference, list(sources.values()), depths, options=self.options)
        # Sparse points vouch for positions.
        if depths.origin != "points" and only_turned(coarse, self.options, self._matcher):
            raise DegenerateError(
                f"{self._scene.root}: the pictures beside {view.name} differ from it by a turn of "
                "the camera alone, whatever their positions say; stereo needs two viewpoints; add "
                "photographs taken a step aside"
            )
        return coarse, reference, sources

    def _sweep(
        self, reference: Pyramid, sources: Sequence[Pyramid], depths: DepthRange, *,
        options: StereoOptions,
    ) -> CoarseDepth:  # fmt: skip
        """Planes swept over the coarsest level, and their costs aggregated."""
        index, device = len(reference.images) - 1, self._device
        level = level_of(reference, sources, index, window=options.window, device=device)
        cameras = concatenate(
            [source.cameras[min(index, len(source.cameras) - 1)] for source in sources]
        )
        planes = plane_hypotheses(reference.cameras[index], cameras, depths, planes=options.planes)
        volume = self._matcher.sweep(level, planes.inverse_depths.to(device))
        total = self._matcher.aggregate(volume, level.reference)
        inverse_depth, which = best_plane(total, planes)
        cost = volume.gather(-1, which[..., None])[..., 0]
        return CoarseDepth(level, planes, inverse_depth, cost)

    def _fine(
        self, coarse: CoarseDepth, reference: Pyramid, sources: dict[str, Pyramid]
    ) -> RawDepth:
        """A coarse estimate carried to the finest level, and adjusted on each.

        Rounds of propagation double from a level to the coarser one, where they cost a quarter.
        """
        options, level, cost = self.options, coarse.level, coarse.cost
        planes = fit_planes(coarse.inverse_depth, (1 - cost).clamp(min=0.01))
        inverse, step = coarse.hypotheses.inverse_depths, coarse.hypotheses.step
        bounds = (float(inverse[0]), float(inverse[-1]))
        last = len(reference.images) - 1
        for index in range(last, -1, -1):
            if index < last:
                level = level_of(
                    reference, list(sources.values()), index, window=options.window,
                    device=self._device,
                )  # fmt: skip
                planes = upsample(planes, *level.reference.shape)
                step /= 2
            planes, cost = refine_planes(
                planes, level, self._matcher,
                step=step, bounds=bounds, iterations=options.iterations * 2**index,
            )  # fmt: skip
        detailed = textured(level.reference, window=options.window, noise=options.noise)
        camera = reference.cameras[0]
        return RawDepth(planes[0].clamp(*bounds), cost, detailed, camera, tuple(sources))

    def _range(self, view: View, reference: Pyramid) -> DepthRange:
        """Where the view's depths lie, narrowed by a first sweep when there are no points."""
        depths = estimate_range(self._known(view), view.name)
        if depths.origin == "points":
            return depths
        names = self._sources(view, depths)
        small = [_halve(self._pyramid(self._scene[name])) for name in names]
        options = self.options.replaced(window=5, planes=None)
        coarse = self._sweep(_halve(reference), small, depths, options=options)
        sure = coarse.cost < SURE
        if sure.float().mean() < SURE_SHARE:
            return depths
        found = (1 / coarse.inverse_depth[sure]).double().cpu().numpy()
        return range_of_depths(found, origin="pictures")

    def _sources(self, view: View, depths: DepthRange) -> tuple[str, ...]:
        names = choose_sources(
            self._known(view), view.name, self.views, count=self.options.sources, depths=depths
        )
        if names:
            # As large as the finest level, whose pixels are meant.
            most = self.options.max_side
            camera, *others = (
                each.resized(*reduced_size(int(each.width[0]), int(each.height[0]), most))
                for each in (self._scene[name].camera for name in (view.name, *names))
            )
            moved = enough_disparity(camera, concatenate(others), depths)
            names = tuple(name for name, far in zip(names, moved, strict=True) if far)
        if not names:
            raise DegenerateError(
                f"{self._scene.root}: none of the {len(self.views)} views shows what {view.name} "
                "does from another place; leave it out or add photographs beside it"
            )
        return names

    def _known(self, view: View) -> Scene:
        """The scene of the views that may be looked at and the view itself."""
        if self._scene.points is not None:
            return self._scene
        if view.name in self.views:
            return self._pool
        return replace(self._pool, views=(*self._pool.views, view))

    def _pyramid(self, view: View, frame: Frame | None = None) -> Pyramid:
        """The view's pictures, with its pose adjusted once poses are."""
        if view.name not in self._pyramids:
            rgb = (frame or view.load()).rgb
            options = self.options
            made = build_pyramid(rgb, view.camera, max_side=options.max_side, levels=options.levels)
            if view.name not in self.views:
                return made
            self._pyramids[view.name] = made
        pyramid = self._pyramids[view.name]
        if self._poses is None or view.name not in self.views:
            return pyramid
        pose = self._poses.cam_from_world[self.views.index(view.name)][None]
        cameras = tuple(replace(camera, cam_from_world=pose) for camera in pyramid.cameras)
        return replace(pyramid, cameras=cameras)


def make_matcher(options: StereoOptions) -> tuple[Matcher, torch.device]:
    """The back end of the options, and where its tensors live."""
    if options.backend == "cpu":
        return CpuMatcher(options), torch.device("cpu")
    return TorchMatcher(options), named_device(options.device, option="stereo.device")


def _halve(pyramid: Pyramid) -> Pyramid:
    """The coarsest level at half its size, alone."""
    image, camera = pyramid.images[-1], pyramid.cameras[-1]
    width, height = max(8, round(image.shape[1] / 2)), max(8, round(image.shape[0] / 2))
    return Pyramid((resample(image, width, height),), (camera.resized(width, height),))


def upsample(planes: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """The planes (3, h, w) of a coarser level, see Matcher.score, at the pixels of a finer one."""
    device = planes.device
    down, across = planes.shape[1] / height, planes.shape[2] / width
    y = (torch.arange(height, device=device) + 0.5) * down
    x = (torch.arange(width, device=device) + 0.5) * across
    row = y.long().clamp(max=planes.shape[1] - 1)
    column = x.long().clamp(max=planes.shape[2] - 1)
    near = planes[:, row][:, :, column]
    dy, dx = (y - row - 0.5)[:, None], (x - column - 0.5)[None]
    return torch.stack([near[0] + near[1] * dx + near[2] * dy, near[1] * across, near[2] * down])


def fit_planes(inverse_depth: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """The plane that fits the inverse depths round each pixel best, by weighted least squares.

    (3, H, W), see Matcher.score. Without enough weight in reach, the plane is parallel to the
    image.
    """
    size = 2 * FIT_RADIUS + 1
    offset = torch.arange(-FIT_RADIUS, FIT_RADIUS + 1, device=weight.device, dtype=weight.dtype)
    one = torch.ones_like(offset)
    # Differences to the centre's value: the sums stay exact when all inverse depths are alike.
    base = inverse_depth.mean()
    value = (inverse_depth - base) * weight

    def total(image: torch.Tensor, down: torch.Tensor, across: torch.Tensor) -> torch.Tensor:
        padded = F.pad(image[None, None], (FIT_RADIUS,) * 4)
        summed = F.conv2d(padded, down.view(1, 1, size, 1))
        return F.conv2d(summed, across.view(1, 1, 1, size))[0, 0]

    n = total(weight, one, one).clamp(min=1e-6)
    mx, my = total(weight, one, offset) / n, total(weight, offset, one) / n
    mw = total(value, one, one) / n
    xx = total(weight, one, offset**2) / n - mx * mx
    yy = total(weight, offset**2, one) / n - my * my
    xy = total(weight, offset, offset) / n - mx * my
    xw = total(value, one, offset) / n - mx * mw
    yw = total(value, offset, one) / n - my * mw
    # A little ridge: where the weights lie on a line, the slope across it is 0.
    xx, yy = xx + 0.05, yy + 0.05
    determinant = xx * yy - xy * xy
    a, b = (yy * xw - xy * yw) / determinant, (xx * yw - xy * xw) / determinant
    some = n > 1.5
    a, b = a * some, b * some
    w = torch.where(some, mw + base - a * mx - b * my, inverse_depth)
    return torch.stack([w, a, b])


def refine_planes(
    planes: torch.Tensor,
    level: Level,
    matcher: Matcher,
    *,
    step: float,
    bounds: tuple[float, float],
    iterations: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Propagate, adjust and refine planes (3, H, W) on one level; gives them and their costs.

    All pixels take the same kind of proposal at once: a neighbour's plane, a shifted plane, the
    plane fitted to the surroundings. What lowers the photometric cost is kept. Proposals follow
    each other, so planes travel several pixels per round. Nothing is drawn at random. ``step``:
    inverse depth that moves one pixel in the source that moves most.
    """
    planes = planes.clone()
    planes[0].clamp_(*bounds)
    cost = matcher.score(level, planes)

    def offer(proposal: torch.Tensor) -> None:
        nonlocal planes, cost
        proposal[0].clamp_(*bounds)
        price = matcher.score(level, proposal)
        better = price < cost - GAIN
        cost = torch.where(better, price, cost)
        planes = torch.where(better, proposal, planes)

    for i in range(iterations):
        reach = 1 if i % 2 == 0 else 3
        for dy, dx in ((0, reach), (reach, 0), (0, -reach), (-reach, 0)):
            offer(_shift(planes, dy, dx))
        offer(fit_planes(planes[0], (1 - cost).clamp(min=0.01)))
        for change in (0.5, -0.5) if i % 2 == 0 else (0.25, -0.25):
            offer(torch.stack([planes[0] + change * step, planes[1], planes[2]]))
    # The lowest point of a parabola through three costs.
    step *= 0.4
    sides = [
        matcher.score(level, torch.stack([planes[0] + side * step, planes[1], planes[2]]))
        for side in (-1, 1)
    ]
    shift = parabola(sides[0], cost, sides[1])
    return torch.stack([planes[0] + shift * step, planes[1], planes[2]]), cost


def _shift(planes: torch.Tensor, dy: int, dx: int) -> torch.Tensor:
    """Each pixel's neighbour's plane, continued to the pixel; the border keeps its own."""
    moved = planes.roll((dy, dx), dims=(1, 2))
    moved[0] += moved[1] * dx + moved[2] * dy
    if dy:
        edge = slice(0, dy) if dy > 0 else slice(dy, None)
        moved[:, edge] = planes[:, edge]
    if dx:
        edge = slice(0, dx) if dx > 0 else slice(dx, None)
        moved[:, :, edge] = planes[:, :, edge]
    return moved


@dataclass(frozen=True, eq=False)
class CoarseDepth:
    """What the coarsest level tells."""

    level: Level  # its pictures
    hypotheses: Hypotheses  # the planes that were tried
    inverse_depth: torch.Tensor  # (H, W) float32, 1 / scene units
    cost: torch.Tensor  # (H, W) float32 photometric cost there


@dataclass(frozen=True, eq=False)
class RawDepth:
    """Depth of one view on the finest level; every pixel has some."""

    inverse_depth: torch.Tensor  # (H, W) float32, 1 / scene units
    cost: torch.Tensor  # (H, W) float32 photometric cost
    textured: torch.Tensor  # (H, W) bool, where there is detail to match; see ``textured``
    camera: Cameras  # of the finest level, a batch of one
    sources: tuple[str, ...]  # names of the views that it was matched with


def enough_disparity(reference: Cameras, sources: Cameras, depths: DepthRange) -> NDArray[np.bool_]:
    """(S,) whether each source sees the nearest depth move at all, on the finest level."""
    rate = disparity_rate(reference, sources, depths.near, far=np.inf)
    return rate / depths.near >= LEAST_DISPARITY


def only_turned(coarse: CoarseDepth, options: StereoOptions, matcher: Matcher) -> bool:
    """Whether a turn of the camera explains the pictures as well as any depth does.

    Infinite depth moves pixels by the turn alone. Where cameras moved next to nothing, it matches
    every pixel at least as well as the depth that was found.
    """
    level, cost = coarse.level, coarse.cost
    detailed = textured(level.reference, window=options.window, noise=options.noise)
    turned = matcher.sweep(level, torch.zeros(1, device=cost.device))[..., 0]
    matched = detailed & (torch.minimum(cost, turned) < MATCHED)
    if not matched.any():
        return False
    return float((turned - cost > BETTER)[matched].float().mean()) < BETTER_SHARE


def compile_sweep() -> None:
    """Sweep one of three small photographs, which calls each kernel."""
    coarse = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    texture = coarse.repeat(8, axis=0).repeat(8, axis=1)
    views = []
    for number in range(3):
        pose = np.eye(4)[None]
        pose[0, 0, 3] = -0.1 * number
        camera = Cameras.pinhole(96, 96, focal=96.0, cam_from_world=pose, name=f"{number}")
        rgb = np.ascontiguousarray(texture[:, 12 * number : 12 * number + 96])
        views.append(View(f"{number}", camera, partial(Frame, rgb)))
    scene = Scene(Path(), "photographs", tuple(views))
    sweep = PlaneSweepStereo(scene, options=StereoOptions(max_side=64), views=scene.names)
    sweep.depth(scene, views[1], views[1].load())


KERNELS = KernelSet("plane sweep", compile_sweep, filtering.enlarge)
