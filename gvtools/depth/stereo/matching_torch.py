"""The stages of matching that cost time, plainly in torch: the reference for every back end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from kornia.filters import box_blur
from kornia.geometry.transform import remap

from gvtools.depth.stereo.matching import CONTRAST, DIRECTIONS, LARGE, SMALL, Level, Matcher

UNSEEN = 1.0  # the cost of a pixel that a source does not show, and of one without any likeness
WINDOW = 11
LARGEST = 4.0  # pixels; a longer motion is no residual


class TorchMatcher(Matcher):
    """Matching by torch, on any device."""

    def score(self, level: Level, planes: torch.Tensor) -> torch.Tensor:
        """See Matcher.score."""
        reference, taps, noise2 = level.reference, level.taps.tolist(), self.options.noise**2
        height, width = reference.shape
        v, u = pixel_centers(height, width, reference.device)
        w, a, b = planes
        rows = torch.arange(height, device=reference.device)
        columns = torch.arange(width, device=reference.device)
        r = torch.stack(
            [
                reference[(rows + dy).clamp(0, height - 1)][:, (columns + dx).clamp(0, width - 1)]
                for dx, dy in taps
            ]
        )  # (T, H, W)
        r = r - reference  # sums of differences lose less to rounding
        g = level.weights.permute(2, 0, 1)
        sum_r = (g * r).sum(0)
        variance_r = ((g * r * r).sum(0) - sum_r**2).clamp(min=0) + noise2
        costs = []
        for source, size, A, o in zip(
            level.sources, level.sizes.tolist(), level.matrix, level.offset, strict=True
        ):
            z = A[2, 0] * u + A[2, 1] * v + A[2, 2] + w * o[2]
            inverse = 1 / z.clamp(min=1e-6)
            px = (A[0, 0] * u + A[0, 1] * v + A[0, 2] + w * o[0]) * inverse
            py = (A[1, 0] * u + A[1, 1] * v + A[1, 2] + w * o[1]) * inverse
            zu, zv = A[2, 0] + a * o[2], A[2, 1] + b * o[2]
            xu, xv = (
                (A[0, 0] + a * o[0] - px * zu) * inverse,
                (A[0, 1] + b * o[0] - px * zv) * inverse,
            )
            yu, yv = (
                (A[1, 0] + a * o[1] - py * zu) * inverse,
                (A[1, 1] + b * o[1] - py * zv) * inverse,
            )
            sum_s, sum_ss, sum_rs = torch.zeros_like(u), torch.zeros_like(u), torch.zeros_like(u)
            for t, (dx, dy) in enumerate(taps):
                value = bilinear(source, size, px + xu * dx + xv * dy, py + yu * dx + yv * dy)
                value = value - reference
                gs = g[t] * value
                sum_s += gs
                sum_ss += gs * value
                sum_rs += gs * r[t]
            variance_s = (sum_ss - sum_s**2).clamp(min=0) + noise2
            likeness = (sum_rs - sum_r * sum_s) / (variance_r * variance_s).sqrt()
            costs.append(torch.where(_inside(px, py, z, size), 1 - likeness.clamp(min=0), UNSEEN))
        return torch.stack(costs).sort(dim=0).values[: self.best(level)].mean(0)

    def sweep(self, level: Level, inverse_depths: torch.Tensor) -> torch.Tensor:
        """See Matcher.sweep."""
        reference, window, noise2 = level.reference, self.options.window, self.options.noise**2
        height, width = reference.shape
        v, u = pixel_centers(height, width, reference.device)
        mean = window_mean(reference, window)
        variance = (window_mean(reference**2, window) - mean**2).clamp(min=0) + noise2
        planes = []
        for w in inverse_depths:
            costs = []
            for source, size, A, o in zip(
                level.sources, level.sizes.tolist(), level.matrix, level.offset, strict=True
            ):
                x, y, z = (A[i, 0] * u + A[i, 1] * v + A[i, 2] + w * o[i] for i in range(3))
                inverse = 1 / z.clamp(min=1e-6)
                inside = _inside(x * inverse, y * inverse, z, size)
                image = bilinear(source, size, x * inverse, y * inverse) * inside
                first = window_mean(image, window)
                spread = (window_mean(image**2, window) - first**2).clamp(min=0) + noise2
                likeness = window_mean(image * reference, window) - first * mean
                likeness = likeness / (spread * variance).sqrt()
                costs.append(torch.where(inside, 1 - likeness.clamp(min=0), UNSEEN))
            planes.append(torch.stack(costs).sort(dim=0).values[: self.best(level)].mean(0))
        return torch.stack(planes, dim=-1)

    def aggregate(self, volume: torch.Tensor, guide: torch.Tensor) -> torch.Tensor:
        """See Matcher.aggregate."""
        total = torch.zeros_like(volume)
        for dy, dx in DIRECTIONS:
            if dy:
                total += _path(volume, guide, dy, dx)
            else:
                total += _path(volume.transpose(0, 1), guide.T, dx, 0).transpose(0, 1)
        return total / len(DIRECTIONS)


def _path(volume: torch.Tensor, guide: torch.Tensor, dy: int, dx: int) -> torch.Tensor:
    """Costs along one path that crosses the rows, all pixels of a row at once."""
    height, width, _ = volume.shape
    out = volume.clone()
    order = range(1, height) if dy > 0 else range(height - 2, -1, -1)
    here, there = slice(max(dx, 0), width + min(dx, 0)), slice(max(-dx, 0), width + min(-dx, 0))
    for y in order:
        before = out[y - dy, there]
        edge = (guide[y, here] - guide[y - dy, there]).abs() / CONTRAST
        penalty = (LARGE / (1 + edge)).clamp(min=SMALL)[:, None]
        least = before.min(dim=1, keepdim=True).values
        wide = F.pad(before, (1, 1), value=float("inf"))
        near = torch.minimum(wide[:, :-2], wide[:, 2:]) + SMALL
        cheapest = torch.minimum(torch.minimum(before, near), least + penalty) - least
        out[y, here] = volume[y, here] + cheapest
    return out


def pixel_centers(
    height: int, width: int, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W) y and x of the pixels' centres; the first lies at 0.5."""
    y = torch.arange(height, device=device, dtype=torch.float32) + 0.5
    x = torch.arange(width, device=device, dtype=torch.float32) + 0.5
    return y[:, None].expand(height, width), x[None].expand(height, width)


def bilinear(
    image: torch.Tensor, size: Sequence[int], x: torch.Tensor, y: torch.Tensor
) -> torch.Tensor:
    """The values of a picture, the first ``size`` pixels of an image, at places x and y (H, W).

    The first pixel's centre is 0.5, unlike kornia's 0; values are held at the border.
    """
    picture = image[None, None, : size[1], : size[0]]
    places = ((x - 0.5)[None], (y - 0.5)[None])
    return remap(picture, *places, padding_mode="border", align_corners=True)[0, 0]


def _inside(x: torch.Tensor, y: torch.Tensor, z: torch.Tensor, size: list[int]) -> torch.Tensor:
    return (z > 1e-6) & (x > 0) & (y > 0) & (x < size[0]) & (y < size[1])


def window_mean(images: torch.Tensor, window: int) -> torch.Tensor:
    """Mean over a square window of (..., H, W) images, the border repeated."""
    planes = images.reshape(1, -1, *images.shape[-2:])
    return box_blur(planes, window, "replicate", separable=True).view_as(images)


@dataclass(frozen=True, eq=False)
class ResidualFlow:
    """Residual motion in the S sources of a level."""

    # (S, H, W) float32, where the warp puts each reference pixel, pixels of the source.
    x: torch.Tensor
    y: torch.Tensor  # (S, H, W)
    dx: torch.Tensor  # (S, H, W) float32 motion by which the source's picture is off, pixels
    dy: torch.Tensor  # (S, H, W)
    weight: torch.Tensor  # (S, H, W) float32 in [0, 1], 0 where the motion is not determined


def residual_flow(
    level: Level, inverse_depth: torch.Tensor, *, noise: float, iterations: int = 3
) -> ResidualFlow:
    """Lucas and Kanade's motion between the reference and each source, warped by inverse depth.

    Both windows are freed of their mean, so a difference in exposure does no harm. A pixel's motion
    counts by how alike the windows are once moved, and not at all where the picture does not vary
    in both directions, where the window leaves the source, or where the motion is long.
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
