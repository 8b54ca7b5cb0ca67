"""Dense gradient-orientation and colour descriptors: features of a picture without any weights.

For every 4 x 4 pixels, orientation histograms of the luminance gradient in a 3 x 3 layout of cells
(in the manner of HOG: N. Dalal and B. Triggs, "Histograms of oriented gradients for human
detection", CVPR 2005; and of the dense layout of DAISY: E. Tola, V. Lepetit and P. Fua, PAMI 32(5),
2010), beside the local colour. They tell edges, their place to a few pixels, and colours; they know
nothing of what things are, and an in-plane roll or a strong change of scale changes them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Float32 = NDArray[np.float32]

CELL = 4  # pixels
ORIENTATIONS = 8
REACH = 2  # cells between the middles of neighbouring histograms
SMOOTHING = 1.0  # pixels before the gradient, and cells after the histogram
# Descriptor length, in luminance (0 to 1) per pixel, at which structure weighs as much as noise:
# below it the gradients fade instead of being blown up to full length.
NOISE = 0.02
COLOR_WEIGHT = 1.0
# A constant component: two places without any structure are alike.
FLATNESS = 0.3


class DenseGradient:
    """The feature network that needs no weights; see the module's text."""

    name = "dense-gradient"

    def features(self, rgb: NDArray[np.uint8]) -> Float32:
        """Features of a picture.

        Args:
            rgb: (H, W, 3) uint8.

        Returns:
            (76, ceil(H / 4), ceil(W / 4)) float32: 9 x 8 gradient components whose common length is
            at most 1 and whose mean is 0; luminance about mid-grey, red-green and yellow-blue; and
            the constant.
        """
        height, width = rgb.shape[:2]
        shape = -(-height // CELL), -(-width // CELL)
        image = gaussian_filter(rgb.astype(np.float32) / 255, (SMOOTHING, SMOOTHING, 0))
        cells = _means(_oriented_gradients(image.mean(-1)), shape)
        layout = _neighbours(gaussian_filter(cells, (0, SMOOTHING, SMOOTHING)))
        layout -= layout.mean(0)
        layout /= np.sqrt((layout**2).sum(0) + NOISE**2)
        red, green, blue = gaussian_filter(
            _means(np.moveaxis(image, -1, 0), shape), (0, SMOOTHING, SMOOTHING)
        )
        color = COLOR_WEIGHT * np.stack(
            [(red + green + blue) / 3 - 0.5, red - green, (red + green) / 2 - blue]
        )
        constant = np.full((1, *shape), FLATNESS)
        return np.concatenate([layout, color, constant]).astype(np.float32)


def _oriented_gradients(luminance: Float32) -> Float32:
    """(8, H, W): gradient length, shared linearly between the two nearest signed orientations."""
    along_y, along_x = (
        np.gradient(luminance, axis=axis) if luminance.shape[axis] > 1 else np.zeros_like(luminance)
        for axis in (0, 1)
    )
    length = np.hypot(along_x, along_y)
    turn = np.arctan2(along_y, along_x) * (ORIENTATIONS / (2 * np.pi)) % ORIENTATIONS
    out = np.zeros((ORIENTATIONS, *luminance.shape), np.float32)
    for orientation in range(ORIENTATIONS):
        gap = np.abs(turn - orientation)
        out[orientation] = length * np.clip(1 - np.minimum(gap, ORIENTATIONS - gap), 0, None)
    return out


def _means(channels: Float32, shape: tuple[int, int]) -> Float32:
    """(C, H, W) averaged over a grid of h x w cells that covers it evenly."""
    height, width = channels.shape[1:]
    top = np.arange(shape[0]) * height // shape[0]
    left = np.arange(shape[1]) * width // shape[1]
    total = np.add.reduceat(np.add.reduceat(channels, top, axis=1), left, axis=2)
    area = np.diff(np.append(top, height))[:, None] * np.diff(np.append(left, width))
    return (total / area).astype(np.float32)


def _neighbours(cells: Float32) -> Float32:
    """(C, h, w) to (9 C, h, w): each cell with those ``REACH`` cells away, edges repeated."""
    height, width = cells.shape[1:]
    padded = np.pad(cells, ((0, 0), (REACH, REACH), (REACH, REACH)), mode="edge")
    steps = (0, REACH, 2 * REACH)
    return np.concatenate(
        [padded[:, dy : dy + height, dx : dx + width] for dy in steps for dx in steps]
    )
