"""Where a reference picture has edges and texture: weights in [0, 1] from its gradient.

w(p) = clip((g(p) - q_0.50) / (q_0.98 - q_0.50 + delta)), g the Sobel magnitude of the grayscale
picture, the quantiles taken over all valid pixels of a sample's views (appendix "RGB supervision").
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

DELTA = 1e-6
# ITU-R BT.601; the paper says "grayscale" only.
LUMA = (0.299, 0.587, 0.114)
QUANTILES = (0.50, 0.98)


@torch.no_grad()
def gradient_weights(reference: Tensor, valid: Tensor) -> Tensor:
    """Weights (B, T, H, W) of the reference pictures' gradients; no gradient flows through them.

    Args:
        reference: (B, T, 3, H, W), in the normalisation that the loss compares.
        valid: (B, T, H, W) bool; other pixels have weight 0 and may hold anything.
    """
    magnitude = sobel_magnitude(grayscale(reference), valid)
    weights = torch.zeros_like(magnitude)
    for b in range(len(magnitude)):
        values = magnitude[b][valid[b]]
        if values.numel():
            bottom, top = torch.quantile(values, values.new_tensor(QUANTILES))
            share = (magnitude[b] - bottom) / (top - bottom + DELTA)
            weights[b] = torch.where(valid[b], share.clamp(0, 1), 0.0)
    return weights


def grayscale(image: Tensor) -> Tensor:
    """Luma (..., H, W) of (..., 3, H, W), float32 at least."""
    red, green, blue = image.to(torch.promote_types(image.dtype, torch.float32)).unbind(-3)
    return LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue


def sobel_magnitude(gray: Tensor, valid: Tensor) -> Tensor:
    """Length (B, T, H, W) of the 3x3 Sobel gradient, kernel sums of 4 a side; 0 where not valid.

    The picture's border is repeated outwards. A neighbour that is not valid counts as equal to the
    pixel itself, so the edge of a mask is no edge of the picture.

    Args:
        gray: (B, T, H, W).
        valid: (B, T, H, W) bool.
    """
    height, width = gray.shape[-2:]
    center = torch.where(valid, gray, 0.0)
    padded = F.pad(center, (1, 1, 1, 1), mode="replicate")
    known = F.pad(valid.to(gray.dtype), (1, 1, 1, 1), mode="replicate") > 0

    def step(dy: int, dx: int) -> Tensor:
        window = (..., slice(1 + dy, 1 + dy + height), slice(1 + dx, 1 + dx + width))
        return torch.where(known[window], padded[window] - center, 0.0)

    # Differences of opposite sides, so that a flat picture gives 0 and not a rounding.
    x = sum(k * (step(d, 1) - step(d, -1)) for d, k in ((-1, 1), (0, 2), (1, 1)))
    y = sum(k * (step(1, d) - step(-1, d)) for d, k in ((-1, 1), (0, 2), (1, 1)))
    return torch.where(valid, torch.hypot(torch.as_tensor(x), torch.as_tensor(y)), 0.0)
