"""Depth Anything 3 as a depth source: several photographs a pass, one scale a scene.

The network sees the known cameras, so that all views of a pass share one unit; what is left is one
factor for the scene. It comes from the sparse points where there are any, from the predicted camera
centres otherwise (the paper's s*), and is refused where neither supports it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.cameras import concatenate
from gvtools.completers.geoverse.camera_encoding import normalised_poses
from gvtools.completers.geoverse.objective import center_similarity
from gvtools.completers.geoverse.views import model_size, resample, resample_depth
from gvtools.depth.options import FoundationOptions
from gvtools.depth.source import DepthMap, depth_of_points
from gvtools.errors import CheckpointError, DegenerateError
from gvtools.networks.compute import autocast, inference_type, named_device
from gvtools.networks.depth_anything.geometry_head import ViewGeometry, camera_centres
from gvtools.networks.depth_anything.network import (
    DepthAnything3,
    find_weights,
    load_depth_anything,
    relative_cameras,
)
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.similarity import align_depth_scale

# Fewer sparse points on known depth, in all views together, say nothing of the scale.
MIN_POINTS_IN_ALL = 50
# Fewer centres fit each other by chance: of four at random, one set in a hundred correlates by more
# than 0.956, of three by 0.998, of two by 1.
MIN_CORRELATION = 0.97
# So many passes of fewer views count together where their scales agree within this factor.
MIN_PASSES, PASSES_AGREE = 3, 1.35


@dataclass(frozen=True)
class FoundationScale:
    """How the network's unit became the scene's."""

    status: str  # "aligned", or "unsupported: ..." with the reason
    support: str  # "points" or "cameras"
    scale: float  # scene units per unit of the network (after the known cameras' own unit)
    count: int  # points, or centres

    @property
    def ok(self) -> bool:
        """Whether the scale may be used."""
        return self.status == "aligned"


@dataclass(frozen=True, eq=False)
class Pass:
    """One forward pass of the network."""

    # (h, w) z-depth by view, at the network's size, in its unit.
    depth: dict[str, NDArray[np.float32]]
    confidence: dict[str, NDArray[np.float32]]  # (h, w) in [0, 1) by view
    # (V, 3) predicted camera centres, frame of the first view, its unit.
    centres: NDArray[np.float64]
    unit: float  # scene units a unit of the known cameras that the network saw; 1 without them


def _fit_scale(scene: Scene, passes: Sequence[Pass], *, min_centres: int) -> FoundationScale:
    """One scale for some passes: by their sparse points, or by their cameras' centres."""
    if scene.points is None:
        return _fit_cameras(scene, passes, min_centres=min_centres)
    pairs = [
        (measured.astype(np.float64) * part.unit, known)
        for part in passes
        for name, depth in part.depth.items()
        for measured, known in [depth_of_points(scene, name, depth)]
    ]
    depth, reference = (np.concatenate([np.zeros(0), *side]) for side in zip(*pairs, strict=True))
    fitted = align_depth_scale(
        depth, reference, valid=depth > 0, min_support=MIN_POINTS_IN_ALL, inlier_band=0.1
    )
    by_points = FoundationScale(fitted.status, "points", fitted.scale, fitted.support)
    # Points that fit no scale refuse the depth itself; what the centres say does not mend it.
    if by_points.ok or by_points.count >= MIN_POINTS_IN_ALL:
        return by_points
    by_cameras = _fit_cameras(scene, passes, min_centres=min_centres)
    return by_cameras if by_cameras.ok else by_points


def _fit_cameras(scene: Scene, passes: Sequence[Pass], *, min_centres: int) -> FoundationScale:
    """The median of the passes' own fits, weighted by their views."""
    scales, weights, reason = [], [], "no pass"
    for part in passes:
        known = np.concatenate([scene[name].camera.centers for name in part.depth])
        fitted = center_similarity(
            torch.from_numpy(part.centres * part.unit)[None], torch.from_numpy(known)[None]
        )
        if not bool(fitted.ok[0]):
            reason = fitted.status[0]
        elif float(fitted.correlation[0]) < MIN_CORRELATION:
            reason = f"centres correlate by {float(fitted.correlation[0]):.2f}"
        else:
            scales.append(float(fitted.scale[0]))
            weights.append(len(part.depth))
    if scales and max(weights) < min_centres:
        # Each of them would fit by chance; several that agree do not.
        agree = len(scales) >= MIN_PASSES and max(scales) <= PASSES_AGREE * min(scales)
        if not agree:
            reason = f"{max(weights)} views a pass, at least {min_centres} are needed"
            scales = []
    if not scales:
        return FoundationScale(f"unsupported: {reason}", "cameras", np.nan, 0)
    scale = float(np.median(np.repeat(scales, weights)))
    return FoundationScale("aligned", "cameras", scale, sum(weights))


class FoundationDepth:
    """Depth of photographs by Depth Anything 3; see gvtools.depth.source.DepthSource.

    All passes are made when the first depth is asked for, since the scale is the scene's; kept are
    a depth and a confidence map a view at the network's size (1.5 MB at 504x378).
    """

    name = "da3"

    def __init__(
        self, scene: Scene, *, views: Sequence[str], options: FoundationOptions | None = None
    ) -> None:
        """Prepare; nothing is computed yet."""
        self.options = options or FoundationOptions()
        self.views = tuple(dict.fromkeys(views))
        self._scene = scene
        if self.options.weights is None:
            raise CheckpointError(
                "depth da3: needs weights; give --set da3.weights=DIR, a folder with "
                "model.safetensors of DA3-SMALL or DA3-BASE (gvtools weights list), or use auto"
            )
        self._weights = find_weights(Path(self.options.weights))
        self._device = named_device(self.options.device, option="da3.device")
        self._passes: dict[str, Pass] = {}
        self._scales: dict[str, FoundationScale] = {}

    @property
    def files(self) -> tuple[Path, ...]:
        """What decides the depth beside the pictures: the weights."""
        return (self._weights,)

    def covers(self, view: View) -> bool:
        """The views that it was given."""
        return view.name in self.views

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The depth of ``view``, whose pixels are ``frame``."""
        fitted = self.scale(view.name)
        if not fitted.ok:
            raise DegenerateError(
                f"depth da3: no scale for {view.name}: {fitted.status}; give a project with sparse "
                "points or with cameras that move, or use plane-sweep"
            )
        made = self._passes[view.name]
        size = frame.rgb.shape[:2]
        factor = made.unit * fitted.scale
        small = torch.from_numpy(made.depth[view.name])[None]
        certain = torch.from_numpy(made.confidence[view.name])[None, None]
        depth = resample_depth(small, size)[0].numpy() * np.float32(factor)
        confidence = resample(certain, size)[0, 0].numpy()
        known = np.isfinite(depth) & (depth > 0) & (confidence >= self.options.min_confidence)
        if frame.mask is not None:
            known &= frame.mask
        confidence = np.clip(confidence, 1e-3, 1)
        return DepthMap(
            np.where(known, depth, np.float32(0)),
            np.where(known, confidence, np.float32(1)),
            self.name,
        )

    def scale(self, name: str) -> FoundationScale:
        """How the unit of a view's pass became the scene's; computes what is needed for it."""
        if not self._passes:
            self._compute()
        return self._scales[name]

    def _compute(self) -> None:
        """All passes, then the scale: one for the scene with known cameras, else one a pass."""
        dtype = inference_type(self.options.precision, self._device)
        network = load_depth_anything(self._weights, device=self._device, dtype=dtype)
        with autocast(self._device, dtype):
            passes = [self._pass(network, *group) for group in self._groups(network)]
        for made in passes:
            self._passes |= dict.fromkeys(made.depth, made)
        sharing = [passes] if self.options.cameras else [[made] for made in passes]
        for together in sharing:
            fitted = _fit_scale(self._scene, together, min_centres=self.options.min_centres)
            for made in together:
                self._scales |= dict.fromkeys(made.depth, fitted)

    def _groups(self, network: DepthAnything3) -> list[tuple[tuple[str, ...], tuple[int, int]]]:
        """Views that go together, in order, all of one size at the network's resolution."""
        sizes: dict[tuple[int, int], list[str]] = {}
        for name in self.views:
            camera = self._scene[name].camera
            size = model_size(
                int(camera.height[0]),
                int(camera.width[0]),
                longest=self.options.longest,
                patch=network.config.encoder.patch,
            )
            sizes.setdefault(size, []).append(name)
        most = self.options.views
        groups = []
        for size, names in sizes.items():
            # As equal as can be: a last pass of one view alone would have no baseline.
            count = -(-len(names) // most)
            bounds = [round(index * len(names) / count) for index in range(count + 1)]
            groups += [(tuple(names[a:b]), size) for a, b in itertools.pairwise(bounds)]
        return groups

    @torch.no_grad()
    def _pass(self, network: DepthAnything3, names: tuple[str, ...], size: tuple[int, int]) -> Pass:
        """One forward pass over some views, at a size."""
        views = [self._scene[name] for name in names]
        cameras = concatenate([view.camera for view in views]).resized(size[1], size[0])
        pictures = []
        for view in views:
            rgb = torch.from_numpy(view.load().rgb).permute(2, 0, 1)[None].float() / 255
            pictures.append(resample(rgb, size)[0].clamp(0, 1))
        images = torch.stack(pictures)[None].to(self._device)
        # The camera encoder's unit has a floor, a tenth of a scene unit: in shares of the views'
        # extent it means the same in every scene.
        extent, scale = normalised_poses(
            torch.from_numpy(cameras.world_from_cam)[None], reference=0
        )
        pose, unit = relative_cameras(torch.linalg.inv(extent))
        known = {}
        if self.options.cameras:
            known = {
                "cam_from_world": pose.float().to(self._device),
                "K": torch.from_numpy(cameras.K).float()[None].to(self._device),
            }
        geometry: ViewGeometry = network(images, **known)
        centres = camera_centres(geometry.ray, geometry.ray_confidence)[0].double().cpu().numpy()
        depth = geometry.depth[0].float().cpu().numpy()
        confidence = (1 - 1 / geometry.depth_confidence[0].float()).cpu().numpy()
        return Pass(
            dict(zip(names, depth, strict=True)),
            dict(zip(names, confidence, strict=True)),
            centres,
            float(unit[0] / scale[0]) if self.options.cameras else 1.0,
        )
