"""Depth from photographs with known poses: the stages of multi-view stereo, view by view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate
from gvtools.depth.options import StereoOptions
from gvtools.depth.source import DepthMap
from gvtools.depth.stereo import filtering
from gvtools.depth.stereo.filtering import agreement, confidence_of
from gvtools.depth.stereo.geometry import DepthRange, choose_sources, estimate_range
from gvtools.depth.stereo.matching import (
    Matcher,
    Pyramid,
    build_pyramid,
    resample,
    resample_colors,
    textured,
    working_size,
)
from gvtools.depth.stereo.matching_cpu import CpuMatcher
from gvtools.depth.stereo.matching_torch import TorchMatcher, residual_flow
from gvtools.depth.stereo.single_view import (
    CoarseDepth,
    RawDepth,
    coarse_depth,
    enough_disparity,
    fine_depth,
    narrow_range,
    only_turned,
)
from gvtools.errors import DegenerateError, OptionError
from gvtools.poses.dense_adjustment import PoseEquations, adjust_cameras, pose_equations
from gvtools.scenes.scene import Frame, Scene, View

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
        if len(self.views) < 2:
            raise OptionError(
                f"stereo: {len(self.views)} view(s) to look at; expected at least 2; name more"
            )
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
        others = [other for other in map(self._confirming, raw.sources) if other is not None]
        compared = agreement(
            raw.inverse_depth, raw.camera,
            [(other.inverse_depth, other.camera) for other in others],
            tolerance=options.tolerance,
        )  # fmt: skip
        matched = (raw.cost <= options.cost) & raw.textured
        confirmed = matched & (compared.views >= options.views)
        confidence = confidence_of(raw.cost, compared.views, compared.spread)
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
        nothing = np.float32(0)
        known = np.where(confirmed, depth, nothing)
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
        coarse, reference, sources, names = self._coarse(view, frame)
        raw = fine_depth(
            coarse, reference, sources, names=names,
            options=self.options, matcher=self._matcher, device=self._device,
        )  # fmt: skip
        if view.name in self.views:
            self._raw[view.name] = raw
        return raw

    def _confirming(self, name: str) -> RawDepth | None:
        """A source's own estimate; None when no view of the pool shows what it does."""
        try:
            return self.raw(self._scene[name])
        except DegenerateError:
            return None

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
            coarse, reference, sources, names = self._coarse(view, None)
        except DegenerateError:
            return None
        cameras = concatenate([source.cameras[-1] for source in sources])
        flow = residual_flow(coarse.level, coarse.inverse_depth, noise=self.options.noise)
        found = pose_equations(
            cameras, reference.cameras[-1], coarse.inverse_depth.cpu().numpy(),
            motion=torch.stack([flow.dx, flow.dy], -1).cpu().numpy(),
            weight=flow.weight.cpu().numpy(),
        )  # fmt: skip
        return None if found is None else (row, [self.views.index(n) for n in names], found)

    def _coarse(
        self, view: View, frame: Frame | None
    ) -> tuple[CoarseDepth, Pyramid, list[Pyramid], tuple[str, ...]]:
        """The coarse estimate of a view, its pictures, and its sources' pictures and names."""
        reference = self._pyramid(view, frame)
        if view.name not in self._ranges:
            self._ranges[view.name] = self._range(view, reference)
        depths = self._ranges[view.name]
        names = self._sources(view, depths)
        sources = [self._pyramid(self._scene[name]) for name in names]
        coarse = coarse_depth(
            reference, sources, depths,
            options=self.options, matcher=self._matcher, device=self._device,
        )  # fmt: skip
        if depths.origin != "points":
            self._refuse_turned(view, coarse)
        return coarse, reference, sources, names

    def _refuse_turned(self, view: View, coarse: CoarseDepth) -> None:
        """Raise when a turn alone explains the pictures; sparse points vouch for positions."""
        options = self.options
        detailed = textured(coarse.level.reference, window=options.window, noise=options.noise)
        if only_turned(coarse.level, coarse.cost, detailed, matcher=self._matcher):
            raise DegenerateError(
                f"{self._scene.root}: the pictures beside {view.name} differ from it by a turn of "
                "the camera alone, whatever their positions say; stereo needs two viewpoints; add "
                "photographs taken a step aside"
            )

    def _range(self, view: View, reference: Pyramid) -> DepthRange:
        """Where the view's depths lie, narrowed by a first sweep when there are no points."""
        depths = estimate_range(self._known(view), view.name)
        if depths.origin == "points":
            return depths
        names = self._sources(view, depths)
        small = [_halve(self._pyramid(self._scene[name])) for name in names]
        coarse = coarse_depth(
            _halve(reference), small, depths,
            options=self.options.replaced(window=5, planes=None),
            matcher=self._matcher, device=self._device,
        )  # fmt: skip
        return narrow_range(depths, coarse)

    def _sources(self, view: View, depths: DepthRange) -> tuple[str, ...]:
        names = choose_sources(
            self._known(view), view.name, self.views, count=self.options.sources, depths=depths
        )
        if names:
            # As large as the finest level, whose pixels are meant.
            camera, *others = (
                self._finest(self._scene[name].camera) for name in (view.name, *names)
            )
            moved = enough_disparity(camera, concatenate(others), depths)
            names = tuple(name for name, far in zip(names, moved, strict=True) if far)
        if not names:
            raise DegenerateError(
                f"{self._scene.root}: none of the {len(self.views)} views shows what {view.name} "
                "does from another place; leave it out or add photographs beside it"
            )
        return names

    def _finest(self, camera: Cameras) -> Cameras:
        """The camera of the finest level."""
        width, height = int(camera.width[0]), int(camera.height[0])
        return camera.resized(*working_size(width, height, self.options.max_side))

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
    there = torch.cuda.is_available()
    if options.device == "cuda" and not there:
        raise OptionError("stereo device 'cuda': torch sees no CUDA device; choose 'auto' or 'cpu'")
    cuda = options.device == "cuda" or (options.device == "auto" and there)
    return TorchMatcher(options), torch.device("cuda" if cuda else "cpu")


def _halve(pyramid: Pyramid) -> Pyramid:
    """The coarsest level at half its size, alone."""
    image, camera = pyramid.images[-1], pyramid.cameras[-1]
    width, height = max(8, round(image.shape[1] / 2)), max(8, round(image.shape[0] / 2))
    return Pyramid((resample(image, width, height),), (camera.resized(width, height),))
