"""By how much the sources, warped with a depth estimate, miss the reference: small 2-D motion."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from gvtools.depth.stereo.matching import Level
from gvtools.depth.stereo.matching_torch import bilinear, pixel_centers, window_mean

WINDOW = 11
LARGEST = 4.0  # pixels; a longer motion is no residual


@dataclass(frozen=True, eq=False)
class ResidualFlow:
    """Residual motion in the S sources of a level.

    Attributes:
        x: (S, H, W) float32, where the warp puts each reference pixel, pixels of the source.
        y: (S, H, W).
        dx: (S, H, W) float32 motion by which the source's picture is off, pixels.
        dy: (S, H, W).
        weight: (S, H, W) float32 in [0, 1], 0 where the motion is not determined.
    """

    x: torch.Tensor
    y: torch.Tensor
    dx: torch.Tensor
    dy: torch.Tensor
    weight: torch.Tensor


def residual_flow(
    level: Level, inverse_depth: torch.Tensor, *, noise: float, iterations: int = 3
) -> ResidualFlow:
    """Lucas and Kanade's motion between the reference and each warped source.

    Both windows are freed of their mean, so a difference in exposure does no harm. A pixel's motion
    counts by how alike the windows are once moved, and not at all where the picture does not vary
    in both directions, where the window leaves the source, or where the motion is long.

    Args:
        level: the pictures.
        inverse_depth: (H, W).
        noise: standard deviation of the pictures' noise.
        iterations: of Gauss and Newton.
    """
    height, width = level.reference.shape
    v, u = pixel_centers(height, width, level.reference.device)
    flows = []
    for source, size, A, o in zip(
        level.sources, level.sizes.tolist(), level.matrix, level.offset, strict=True
    ):
        x, y, z = (A[i, 0] * u + A[i, 1] * v + A[i, 2] + inverse_depth * o[i] for i in range(3))
        x, y = x / z.clamp(min=1e-6), y / z.clamp(min=1e-6)
        inside = (z > 1e-6) & (x > 0) & (y > 0) & (x < size[0]) & (y < size[1])
        flows.append(
            _motion(
                level.reference,
                source,
                size,
                x=x,
                y=y,
                inside=inside,
                noise=noise,
                iterations=iterations,
            )
        )
    return ResidualFlow(*(torch.stack(part) for part in zip(*flows, strict=True)))


def _motion(
    reference: torch.Tensor,
    source: torch.Tensor,
    size: list[int],
    *,
    x: torch.Tensor,
    y: torch.Tensor,
    inside: torch.Tensor,
    noise: float,
    iterations: int,
) -> tuple[torch.Tensor, ...]:
    across = F.pad((source[:, 2:] - source[:, :-2]) / 2, (1, 1))
    down = F.pad((source[2:] - source[:-2]) / 2, (0, 0, 1, 1))
    mask = inside.float()
    share = window_mean(mask, WINDOW).clamp(min=1e-3)

    def centred(image: torch.Tensor) -> torch.Tensor:
        return (image - window_mean(image * mask, WINDOW) / share) * mask

    target = centred(reference)
    dx, dy = torch.zeros_like(x), torch.zeros_like(y)
    for _ in range(iterations):
        image = centred(bilinear(source, size, x + dx, y + dy))
        gx = centred(bilinear(across, size, x + dx, y + dy))
        gy = centred(bilinear(down, size, x + dx, y + dy))
        r = target - image
        a, b, c, p, q = window_mean(
            torch.stack([gx * gx, gx * gy, gy * gy, gx * r, gy * r]), WINDOW
        )
        a, c = a + noise**2 / 10, c + noise**2 / 10
        determinant = a * c - b * b
        dx = (dx + ((c * p - b * q) / determinant).clamp(-1, 1)).clamp(-LARGEST, LARGEST)
        dy = (dy + ((a * q - b * p) / determinant).clamp(-1, 1)).clamp(-LARGEST, LARGEST)
    image = centred(bilinear(source, size, x + dx, y + dy))
    rr, ss, rs = window_mean(torch.stack([target**2, image**2, target * image]), WINDOW)
    likeness = rs / ((rr + noise**2) * (ss + noise**2)).sqrt()
    weakest = (a + c) / 2 - (((a - c) / 2) ** 2 + b * b).sqrt()
    clear = (weakest > noise**2) & (share > 0.95) & inside
    clear &= (dx.abs() < 0.9 * LARGEST) & (dy.abs() < 0.9 * LARGEST)
    return x, y, dx, dy, clear * ((likeness - 0.6) / 0.4).clamp(0, 1)
