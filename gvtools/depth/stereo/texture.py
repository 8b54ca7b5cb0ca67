"""Where a picture has texture that can be matched: detail, not shading, and more than its noise.

Shading that varies slowly has contrast, and once its mean and its gain are taken away one piece of
it is like any other: it matches at every depth. What tells depths apart is what remains when the
local trend is taken away too, as far as it stands out from the noise.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

# The least textured windows of a picture tell its noise, up to that much of it: the smallest of
# these shares, or larger ones while their detail is within a factor of it. Where much is blank,
# detail spreads no further than that; where little is, texture begins beyond.
BLANK_SHARES, BLANK_SPREAD, MOST_NOISE = (0.02, 0.05, 0.1, 0.2), 1.2, 0.008
# Detail has to be this many times the noise that is found, and this share of the noise expected: on
# 7-Scenes and the sample room, more of either costs pixels that are right.
CLEAR, EXPECTED = 1.25, 2 / 3
# Luminance this close to black or white is clipped and tells nothing about noise.
CLIPPED = 0.02


def textured(image: torch.Tensor, *, window: int, noise: float) -> torch.Tensor:
    """(H, W) bool, where a window's detail stands out from the picture's noise.

    Args:
        image: (H, W) float32 luminance in [0, 1].
        window: its side, pixels, odd.
        noise: standard deviation of the noise to expect, see StereoOptions.
    """
    detail = detail_of(image, window)
    return detail > max(EXPECTED * noise, CLEAR * noise_of(image, detail))


def detail_of(image: torch.Tensor, window: int) -> torch.Tensor:
    """(H, W) standard deviation of a window's luminance about the plane that fits it best."""
    radius = window // 2
    steps = torch.arange(-radius, radius + 1, dtype=image.dtype, device=image.device)
    even = torch.full_like(steps, 1 / window)
    ramp = steps / steps.square().sum().sqrt() / window**0.5  # of unit length over the window
    # Luminance about its overall mean: squares of small numbers lose less to rounding.
    centred = image - image.mean()
    padded = F.pad(centred[None, None], (radius,) * 4, mode="replicate")

    def filtered(picture: torch.Tensor, down: torch.Tensor, across: torch.Tensor) -> torch.Tensor:
        return F.conv2d(F.conv2d(picture, down[None, None, :, None]), across[None, None, None])[
            0, 0
        ]

    ones = torch.ones_like(steps)
    variance = filtered(padded**2, even, even) - filtered(padded, even, even) ** 2
    slopes = filtered(padded, ramp, ones) ** 2 + filtered(padded, ones, ramp) ** 2
    return (variance - slopes / window**2).clamp(min=0).sqrt()


def noise_of(image: torch.Tensor, detail: torch.Tensor) -> float:
    """The detail of a picture's blankest windows; 0 where all of it is clipped.

    Args:
        image: (H, W) float32 luminance in [0, 1].
        detail: (H, W) float32, see ``detail_of``.
    """
    exposed = (image > CLIPPED) & (image < 1 - CLIPPED)
    if not exposed.any():
        return 0.0
    values = detail[exposed].sort().values
    least, *more = (float(values[int(share * len(values))]) for share in BLANK_SHARES)
    blank = max([least, *(value for value in more if value <= BLANK_SPREAD * least)])
    return min(blank, MOST_NOISE)
