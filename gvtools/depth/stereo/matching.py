"""Matching on one level of the pyramid: the pictures, and the back ends that compare them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch

from gvtools.depth.stereo.options import StereoOptions

# Semi-global aggregation (Hirschmueller, TPAMI 2008, equation 13): the penalties of a change by
# one plane and by more, in units of the cost, and the contrast that halves the second.
SMALL, LARGE, CONTRAST = 0.06, 0.5, 0.06
DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


@dataclass(frozen=True, eq=False)
class Level:
    """One level of the pyramid of a reference view and its sources.

    Attributes:
        reference: (H, W) float32 luminance in [0, 1].
        sources: (S, H', W') float32, padded to the largest source.
        sizes: (S, 2) int32, width and height of each source, pixels.
        matrix: (S, 3, 3) float32, see gvtools.depth.stereo.warps.Warps.
        offset: (S, 3) float32.
        taps: (T, 2) int32, dx and dy of the compared pixels of a window.
        weights: (H, W, T) float32, how much each counts; they sum to 1 at each pixel.
    """

    reference: torch.Tensor
    sources: torch.Tensor
    sizes: torch.Tensor
    matrix: torch.Tensor
    offset: torch.Tensor
    taps: torch.Tensor
    weights: torch.Tensor


class Matcher(ABC):
    """A back end of the stages that cost time. Costs are 0 for a perfect match, 1 for none."""

    def __init__(self, options: StereoOptions) -> None:
        self.options = options

    def best(self, level: Level) -> int:
        """How many of the level's sources make the cost of a pixel."""
        return min(self.options.best, len(level.sources))

    @abstractmethod
    def sweep(self, level: Level, inverse_depths: torch.Tensor) -> torch.Tensor:
        """Photometric cost of planes parallel to the reference's image.

        The cost is 1 - ZNCC over a square window, mean of the best sources. Both variances are
        raised by the noise's, so that windows without texture match nothing.

        Args:
            level: the pictures.
            inverse_depths: (D,) float32.

        Returns:
            (H, W, D) float32 in [0, 1].
        """

    @abstractmethod
    def aggregate(self, volume: torch.Tensor, guide: torch.Tensor) -> torch.Tensor:
        """Semi-global aggregation along eight paths.

        Args:
            volume: (H, W, D) float32 costs.
            guide: (H, W) float32 luminance; across its edges a jump is cheaper.

        Returns:
            (H, W, D) float32, mean of the paths' costs.
        """

    @abstractmethod
    def score(self, level: Level, planes: torch.Tensor) -> torch.Tensor:
        """Photometric cost of one slanted plane for each pixel.

        Args:
            level: the pictures; the window's pixels are ``level.taps``, weighted.
            planes: (3, H, W) float32: inverse depth at the pixel, and its change per pixel in x
                and y.

        Returns:
            (H, W) float32 in [0, 1].
        """
