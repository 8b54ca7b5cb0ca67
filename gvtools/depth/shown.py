"""Depth of a photograph as the memory's projection, or fitted Gaussians, show it."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance
from gvtools.cameras import Cameras
from gvtools.depth.source import DepthMap
from gvtools.depth.stereo.filtering import agreement
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.scenes.images import resize_nearest
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.view_selection import nearest_views

# Colours that differ by less, in the mean over a window, may be of one surface: pictures have
# noise, edges are half a pixel off, and surfaces shine. In a picture darker than BRIGHT it is less.
SAME_COLOR, BRIGHT, WINDOW = 0.2, 0.5, 5
# A photograph this many times brighter or darker than memory tells too little.
MOST_GAIN = 4.0
# What such depth names as its source.
MEMORY = "memory"


def depth_from_memory(
    memory: SpatialMemory,
    camera: Cameras,
    rgb: NDArray[np.uint8],
    *,
    least: float,
    options: SplatOptions | None = None,
) -> DepthMap | None:
    """The memory's projected depth of a photograph, if the projection matches enough of it.

    A pixel matches where the memory's observed content shows the photograph's colour, but for a
    gain per channel that all pixels share; the darker the photograph, the less may be off. None
    where fewer pixels than the share ``least`` match.
    """
    if not len(memory):
        return None
    known = memory.project(camera, options=options)
    valid = known.valid[0] & ~known.generated[0]
    if valid.mean() < least or not valid.any():
        return None
    seen = (rgb / np.float32(255)).astype(np.float32)
    shown = known.rgb[0]
    level = np.median(seen[valid], axis=0)
    gain = level / np.maximum(np.median(shown[valid], axis=0), 1 / 255)
    if gain.max() > MOST_GAIN or gain.min() < 1 / MOST_GAIN:
        return None
    tolerance = SAME_COLOR * min(1.0, float(level.mean()) / BRIGHT)
    off = np.abs(shown * gain.astype(np.float32) - seen).mean(-1) * valid
    size = (WINDOW, WINDOW)
    mean = cv2.blur(off, size) / np.maximum(cv2.blur(valid.astype(np.float32), size), 1e-6)
    matching = valid & (mean < tolerance)
    if matching.mean() < least:
        return None
    depth = np.where(matching, known.depth[0], np.float32(0))
    confidence = np.where(matching, np.minimum(known.confidence[0], 1), np.float32(1))
    return DepthMap(depth, confidence.astype(np.float32), MEMORY)


# A pixel has depth where the Gaussians stop this share of the light.
OPAQUE = 0.8
# Mean difference of colours (0 to 1) from the photograph at which confidence is 1 / e.
TOLERANCE = 0.12
LEAST_CONFIDENCE = 0.05
# Two depths of a view agree that differ by less, and those of two views (relative).
AGREE, AGREE_ACROSS = 0.05, 0.03
# Views near a view whose own depth maps are asked.
NEAR = 8
# Confidence by how many swept depth maps, 0 to NEAR + 1, agree: the shares of pixels that were
# right to 5 % in five scenes, the kitchen and four rendered ones. Where none agrees and the view's
# own contradicts.
CONFIRMED = np.array([0.35, 0.82, 0.9, 0.93, 0.96, 0.97, 0.98, 0.98, 0.99, 0.99], np.float32)
CONTRADICTED = np.float32(0.25)
# Just outside of a nearer thing pixels take its depth: where depth is deeper by this share within
# a window of so many pixels, confidence falls to a part.
RIM, RIM_PIXELS, AT_RIM = 1.1, 9, np.float32(0.6)
# Less confident depth is as often wrong as right.
GUESSED = 0.5


class SweptDepth(Protocol):
    """Depth of views that was found without the Gaussians."""

    def covers(self, view: View) -> bool:
        """Whether there is time for the view."""

    def depth(self, view: View) -> NDArray[np.float32] | None:
        """(H, W) z-depth of its picture at some size, scene units; None if no other shows it."""


class FittedDepth:
    """Depth of views by Gaussians that were fitted to them.

    Confidence is by how many depth maps agree that were found without the Gaussians: the view's own
    and those of views near it. The mean of all that agree is taken. Without such maps it falls
    where the Gaussians do not look like the photograph.
    """

    name = "fitted"

    def __init__(self, appearance: Appearance, swept: SweptDepth | None = None) -> None:
        self.appearance, self.swept = appearance, swept

    def covers(self, view: View) -> bool:
        """Every view."""
        return True

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The depth that the Gaussians show from the view's camera."""
        known = self.appearance.depth(view.camera, opaque=OPAQUE)
        guessed = None
        if self.swept is None:
            shown = self.appearance.picture(view.camera)
            off = np.abs(shown.rgb - frame.rgb / np.float32(255)).mean(axis=2)
            confidence = np.exp(-np.square(off / np.float32(TOLERANCE)))
        else:
            known, confidence = self._confirmed(known, scene, view, swept=self.swept)
            deepest = cv2.dilate(known, np.ones((RIM_PIXELS, RIM_PIXELS), np.uint8))
            confidence = np.where(deepest > RIM * known, AT_RIM * confidence, confidence)
            guessed = (known > 0) & (confidence < GUESSED)
        confidence = np.maximum(confidence, np.float32(LEAST_CONFIDENCE))
        return DepthMap(known, confidence, self.name, guessed=guessed)

    @staticmethod
    def _confirmed(
        known: NDArray[np.float32], scene: Scene, view: View, *, swept: SweptDepth
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The mean of a view's depth and of all swept depth that agrees, and its confidence."""
        near = [each for each in scene.views if each.name != view.name and swept.covers(each)]
        if near:
            cameras = scene.subset([each.name for each in near]).cameras
            near = [near[row] for row in nearest_views(cameras, view.camera, NEAR)]
        maps = [(each.camera, swept.depth(each)) for each in near]
        others = [
            (_inverse(depth), camera.resized(*depth.shape[::-1]))
            for camera, depth in maps
            if depth is not None
        ]
        own = swept.depth(view) if swept.covers(view) else None
        # Compared at the size of the maps: finer depth takes the corrections of the pixel it is in.
        size = known.shape[::-1]
        sides = [max(depth.shape) for depth in (own, *(d for _, d in maps)) if depth is not None]
        scale = min(max(sides, default=max(size)) / max(size), 1.0)
        small = resize_nearest(known, *(max(round(side * scale), 1) for side in size))
        known_there = small > 0
        camera = view.camera.resized(*small.shape[::-1])
        compared = agreement(_inverse(small), camera, others, tolerance=AGREE_ACROSS)
        count, inverse = compared.views.numpy(), compared.inverse_depth.numpy()
        contradicted = np.zeros(small.shape, np.bool_)
        if own is not None:
            own = resize_nearest(own, *small.shape[::-1])
            both = known_there & (own > 0)
            agreed = both & (np.abs(own / np.where(known_there, small, np.float32(1)) - 1) < AGREE)
            total = (1 + count) * inverse + agreed / np.where(agreed, own, np.float32(1))
            count = count + agreed
            inverse = total / (1 + count)
            contradicted = both & (count == 0)
        confidence = np.where(contradicted, CONTRADICTED, CONFIRMED[count])
        factor = np.where(known_there, 1 / np.where(known_there, inverse * small, 1), 1)
        depth = known * resize_nearest(factor, *size)
        return depth.astype(np.float32), resize_nearest(confidence, *size)


def _inverse(depth: NDArray[np.float32]) -> torch.Tensor:
    return torch.from_numpy(np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)).float()
