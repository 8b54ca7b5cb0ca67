"""Depth of photographs as fitted Gaussians show it."""

from __future__ import annotations

import numpy as np

from gvtools.appearance.appearance import Appearance
from gvtools.depth.source import DepthMap
from gvtools.scenes.scene import Frame, Scene, View

# A pixel has depth where the Gaussians stop this share of the light.
OPAQUE = 0.8
# Mean difference of colours (0 to 1) from the photograph at which confidence is 1 / e.
TOLERANCE = 0.12
LEAST_CONFIDENCE = 0.05


class FittedDepth:
    """Depth of views by Gaussians that were fitted to them.

    Confidence falls where the Gaussians do not look like the photograph.
    """

    name = "fitted"

    def __init__(self, appearance: Appearance) -> None:
        self.appearance = appearance

    def covers(self, view: View) -> bool:
        """Every view."""
        return True

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The depth that the Gaussians show from the view's camera."""
        shown = self.appearance.picture(view.camera)
        off = np.abs(shown.rgb - frame.rgb / np.float32(255)).mean(axis=2)
        confidence = np.exp(-np.square(off / TOLERANCE)).astype(np.float32)
        known = np.where(shown.alpha > OPAQUE, self.appearance.depth(view.camera), np.float32(0))
        return DepthMap(known, np.maximum(confidence, LEAST_CONFIDENCE), self.name)
