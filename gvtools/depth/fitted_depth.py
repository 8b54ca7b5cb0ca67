"""Depth of photographs as fitted Gaussians show it."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance
from gvtools.depth.source import DepthMap, DepthSource
from gvtools.depth.stereo.consistency import agreement
from gvtools.errors import DegenerateError
from gvtools.scenes.images import resize_nearest
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.view_selection import nearest_views

# A pixel has depth where the Gaussians stop this share of the light.
OPAQUE = 0.8
# Mean difference of colours (0 to 1) from the photograph at which confidence is 1 / e.
TOLERANCE = 0.12
LEAST_CONFIDENCE = 0.05
# Two depths of a view agree that differ by less, and those of two views (relative).
AGREE, AGREE_ACROSS = 0.05, 0.03
# Views near a view whose own depth maps are asked.
NEAR = 8
# Confidence by how many depth maps agree, found without the Gaussians: the shares of pixels that
# were right to 5 % in five scenes, the kitchen and four rendered ones. Where none agrees and the
# view's own contradicts.
CONFIRMED = np.array([0.35, 0.82, 0.9, 0.93, 0.96, 0.97, 0.98, 0.98, 0.99, 0.99], np.float32)
CONTRADICTED = np.float32(0.25)
# Just outside of a nearer thing pixels take its depth: where depth is deeper by this share within
# so many pixels, confidence falls to a part.
RIM, RIM_PIXELS, AT_RIM = 1.1, 9, np.float32(0.6)


class FittedDepth:
    """Depth of views by Gaussians that were fitted to them.

    Confidence is by how many depth maps agree that were found without the Gaussians: the view's
    own and those of views near it. The mean of all that agree is taken. Without such maps it falls
    where the Gaussians do not look like the photograph.

    Args:
        appearance: the Gaussians.
        other: depth that was found without them; None for none.
    """

    name = "fitted"

    def __init__(self, appearance: Appearance, other: DepthSource | None = None) -> None:
        self.appearance, self.other = appearance, other

    def covers(self, view: View) -> bool:
        """Every view."""
        return True

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The depth that the Gaussians show from the view's camera."""
        shown = self.appearance.picture(view.camera)
        known = np.where(shown.alpha > OPAQUE, self.appearance.depth(view.camera), np.float32(0))
        if self.other is None:
            off = np.abs(shown.rgb - frame.rgb / np.float32(255)).mean(axis=2)
            confidence = np.exp(-np.square(off / np.float32(TOLERANCE)))
        else:
            known, confidence = self._confirmed(known, scene, view)
            deepest = cv2.dilate(known, np.ones((RIM_PIXELS, RIM_PIXELS), np.uint8))
            confidence = np.where(deepest > RIM * known, AT_RIM * confidence, confidence)
        return DepthMap(known, np.maximum(confidence, np.float32(LEAST_CONFIDENCE)), self.name)

    def _confirmed(
        self, known: NDArray[np.float32], scene: Scene, view: View
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The mean of the depth and all that agrees with it, and its confidence."""
        assert self.other is not None
        near = [each for each in scene.views if each.name != view.name and self.other.covers(each)]
        if near:
            cameras = scene.subset([each.name for each in near]).cameras
            near = [near[row] for row in nearest_views(cameras, view.camera, NEAR)]
        maps = ((each, self._other(scene, each)) for each in near)
        others = [(_inverse(found), each.camera) for each, found in maps if found is not None]
        found = agreement(_inverse(known), view.camera, others, tolerance=AGREE_ACROSS)
        count, inverse = found.views.numpy(), found.inverse_depth.numpy()
        own = self._other(scene, view)
        if own is not None:
            own = resize_nearest(own, *known.shape[::-1])
            apart = np.abs(own / np.where(known > 0, known, np.float32(1)) - 1)
            agreed = (known > 0) & (own > 0) & (apart < AGREE)
            total = (1 + count) * inverse + agreed / np.where(agreed, own, np.float32(1))
            count = count + agreed
            inverse = total / (1 + count)
            contradicted = (count == 0) & (known > 0) & (own > 0)
            confidence = np.where(contradicted, CONTRADICTED, CONFIRMED[count])
        else:
            confidence = CONFIRMED[count]
        depth = np.where(known > 0, 1 / np.where(known > 0, inverse, 1), 0)
        return depth.astype(np.float32), confidence

    def _other(self, scene: Scene, view: View) -> NDArray[np.float32] | None:
        if self.other is None or not self.other.covers(view):
            return None
        try:
            return self.other.depth(scene, view, view.load()).depth
        except DegenerateError:
            return None


def _inverse(depth: NDArray[np.float32]) -> torch.Tensor:
    return torch.from_numpy(np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)).float()
