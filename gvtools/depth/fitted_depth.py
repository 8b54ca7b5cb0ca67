"""Depth of photographs as fitted Gaussians show it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance
from gvtools.depth.source import DepthMap, DepthSource
from gvtools.errors import DegenerateError
from gvtools.scenes.images import resize_nearest
from gvtools.scenes.scene import Frame, Scene, View

# A pixel has depth where the Gaussians stop this share of the light.
OPAQUE = 0.8
# Mean difference of colours (0 to 1) from the photograph at which confidence is 1 / e.
TOLERANCE = 0.12
LEAST_CONFIDENCE = 0.05
# Two depths agree that differ by less (relative).
AGREE = 0.05
# Confidence where another depth agrees, where it does not know, and where it contradicts.
CONFIRMED, ALONE, CONTRADICTED = 0.97, 0.6, 0.3


class FittedDepth:
    """Depth of views by Gaussians that were fitted to them.

    Confidence falls where the Gaussians do not look like the photograph, and where another depth of
    the same view does not confirm theirs. Where it does, the mean of both is taken.

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
        off = np.abs(shown.rgb - frame.rgb / np.float32(255)).mean(axis=2)
        confidence = np.exp(-np.square(off / TOLERANCE)).astype(np.float32)
        known = np.where(shown.alpha > OPAQUE, self.appearance.depth(view.camera), np.float32(0))
        other = self._other(scene, view, frame)
        if other is not None:
            both = (known > 0) & (other > 0)
            apart = np.abs(other / np.where(known > 0, known, np.float32(1)) - 1)
            agreed = both & (apart < AGREE)
            confidence *= np.where(agreed, CONFIRMED, np.where(both, CONTRADICTED, ALONE))
            known = np.where(agreed, (known + other) / 2, known)
        return DepthMap(known, np.maximum(confidence, np.float32(LEAST_CONFIDENCE)), self.name)

    def _other(self, scene: Scene, view: View, frame: Frame) -> NDArray[np.float32] | None:
        if self.other is None or not self.other.covers(view):
            return None
        try:
            found = self.other.depth(scene, view, frame).depth
        except DegenerateError:
            return None
        return resize_nearest(found, frame.rgb.shape[1], frame.rgb.shape[0])
