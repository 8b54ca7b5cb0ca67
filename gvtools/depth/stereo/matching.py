"""Matching on one level of the pyramid: its pictures, their texture, and the reference in torch.

Shading that varies slowly has contrast, and once its mean and its gain are taken away one piece of
it is like any other: it matches at every depth. What tells depths apart is what remains when the
local trend is taken away too, as far as it stands out from the noise.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from kornia.color import rgb_to_grayscale
from kornia.filters import box_blur
from kornia.geometry.transform import remap
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate, reduced_size
from gvtools.depth.options import StereoOptions
from gvtools.depth.stereo.geometry import relative_warps

# Semi-global aggregation (Hirschmueller, TPAMI 2008, equation 13): the penalties of a change by
# one plane and by more, in units of the cost, and the contrast that halves the second.
SMALL, LARGE, CONTRAST = 0.06, 0.5, 0.06
DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
# Weights of a window's pixels: how fast they fall with the difference in luminance and with the
# distance, the latter in halves of the window.
LUMINANCE, DISTANCE = 0.12, 1.0
# The least textured windows of a picture tell its noise, up to that much of it: the smallest of
# these shares, or larger ones while their detail is within a factor of it. Where much is blank,
# detail spreads no further than that; where little is, texture begins beyond.
BLANK_SHARES, BLANK_SPREAD, MOST_NOISE = (0.02, 0.05, 0.1, 0.2), 1.2, 0.008
# Detail has to be this many times the noise that is found, and this share of the noise expected: on
# 7-Scenes and the sample room, more of either costs pixels that are right.
CLEAR, EXPECTED = 1.25, 2 / 3
# Luminance this close to black or white is clipped and tells nothing about noise.
CLIPPED = 0.02
UNSEEN = 1.0  # the cost of a pixel that a source does not show, and of one without any likeness
# Residual motion: side of the windows, rounds, and the length beyond which a motion is none [px].
WINDOW, ITERATIONS, LARGEST = 11, 3, 4.0


@dataclass(frozen=True, eq=False)
class Level:
    """One level of the pyramid of a reference view and its sources."""

    reference: torch.Tensor  # (H, W) float32 luminance in [0, 1]
    sources: torch.Tensor  # (S, H', W') float32, padded to the largest source
    sizes: torch.Tensor  # (S, 2) int32, width and height of each source, pixels
    matrix: torch.Tensor  # (S, 3, 3) float32, see gvtools.depth.stereo.geometry.Warps
    offset: torch.Tensor  # (S, 3) float32
    taps: torch.Tensor  # (T, 2) int32, dx and dy of the compared pixels of a window
    weights: torch.Tensor  # (H, W, T) float32, how much each counts; they sum to 1 at each pixel


class Matcher(ABC):
    """A back end of the stages that cost time. Costs are 0 for a perfect match, 1 for none."""

    def __init__(self, options: StereoOptions) -> None:
        self.options = options

    def best(self, level: Level) -> int:
        """How many of the level's sources make the cost of a pixel."""
        return min(self.options.best, len(level.sources))

    @abstractmethod
    def sweep(self, level: Level, inverse_depths: torch.Tensor) -> torch.Tensor:
        """(H, W, D) photometric cost of planes at depths (D,) parallel to the reference's image.

        The cost is 1 - ZNCC over a square window, mean of the best sources. Both variances are
        raised by the noise's, so that windows without texture match nothing.
        """

    @abstractmethod
    def aggregate(self, volume: torch.Tensor, guide: torch.Tensor) -> torch.Tensor:
        """(H, W, D) costs after semi-global aggregation, the mean of eight paths.

        Across the edges of ``guide`` (H, W), luminance, a jump is cheaper.
        """

    @abstractmethod
    def score(self, level: Level, planes: torch.Tensor) -> torch.Tensor:
        """(H, W) photometric cost of one slanted plane a pixel, over the window's weighted taps.

        ``planes`` (3, H, W): inverse depth at the pixel, and its change per pixel in x and y.
        """


@dataclass(frozen=True, eq=False)
class Pyramid:
    """One view's picture on every level, finest first."""

    images: tuple[torch.Tensor, ...]  # (H, W) float32 luminance in [0, 1], one for each level
    cameras: tuple[Cameras, ...]  # the view's camera for each level, batches of one


def build_pyramid(
    rgb: NDArray[np.uint8], camera: Cameras, *, max_side: int, levels: int
) -> Pyramid:
    """The levels of one picture, each half the size of the one before, at least 16 pixels."""
    colors = torch.from_numpy(rgb).permute(2, 0, 1).float() / 255
    luminance = rgb_to_grayscale(colors)[0]  # (H, W), BT.601
    width, height = reduced_size(rgb.shape[1], rgb.shape[0], max_side)
    images: list[torch.Tensor] = []
    cameras: list[Cameras] = []
    for _ in range(levels):
        if images and min(width, height) < 16:
            break
        luminance = resample(luminance, width, height)
        images.append(luminance)
        cameras.append(camera.resized(width, height))
        width, height = max(1, round(width / 2)), max(1, round(height / 2))
    return Pyramid(tuple(images), tuple(cameras))


def resample(image: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """(..., H, W) image resampled without aliasing; the picture's outline stays where it is."""
    if image.shape[-2:] == (height, width):
        return image
    flat = image.reshape(1, -1, *image.shape[-2:])
    small = F.interpolate(
        flat, (height, width), mode="bilinear", align_corners=False, antialias=True
    )
    return small.reshape(*image.shape[:-2], height, width).contiguous()


def resample_colors(rgb: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 of an (H, W, 3) uint8 picture; see ``resample``."""
    if rgb.shape[:2] == (height, width):
        return np.ascontiguousarray(rgb)
    colors = resample(torch.from_numpy(rgb).permute(2, 0, 1).float(), width, height)
    return colors.permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8).contiguous().numpy()


def window_taps(window: int) -> torch.Tensor:
    """(T, 2) int32 dx, dy: every other pixel of a square window, without its centre."""
    radius = window // 2
    side = range(-radius, radius + 1)
    taps = [(x, y) for y in side for x in side if (x + y) % 2 == 0 and (x or y)]
    return torch.tensor(taps, dtype=torch.int32)


def window_weights(image: torch.Tensor, taps: torch.Tensor) -> torch.Tensor:
    """(H, W, T) float32: the window's pixels that look like its centre count most; sum 1."""
    height, width = image.shape
    rows, columns = torch.arange(height), torch.arange(width)
    rows, columns = rows.to(image.device), columns.to(image.device)
    reach = DISTANCE * float(taps.abs().max())
    weights = torch.empty((len(taps), height, width), device=image.device)
    for t, (dx, dy) in enumerate(taps.tolist()):
        shifted = image[(rows + dy).clamp(0, height - 1)][:, (columns + dx).clamp(0, width - 1)]
        difference = (shifted - image).abs_().mul_(-1 / LUMINANCE)
        torch.exp(difference.sub_((dx * dx + dy * dy) / (2 * reach * reach)), out=weights[t])
    weights /= weights.sum(0)
    return weights.permute(1, 2, 0).contiguous()


def level_of(
    reference: Pyramid, sources: Sequence[Pyramid], index: int, *, window: int, device: torch.device
) -> Level:
    """Level ``index``, 0 the finest, of a reference view and its sources, ready to be matched."""
    chosen = [min(index, len(source.images) - 1) for source in sources]
    images = [source.images[i] for source, i in zip(sources, chosen, strict=True)]
    cameras = concatenate([source.cameras[i] for source, i in zip(sources, chosen, strict=True)])
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    padded = torch.zeros((len(images), height, width))
    for i, image in enumerate(images):
        padded[i, : image.shape[0], : image.shape[1]] = image
    warps = relative_warps(reference.cameras[index], cameras)
    sizes = torch.tensor([(image.shape[1], image.shape[0]) for image in images], dtype=torch.int32)
    taps = window_taps(window)
    image = reference.images[index].to(device)
    return Level(
        reference=image,
        sources=padded.to(device),
        sizes=sizes,
        matrix=torch.from_numpy(warps.matrix.astype(np.float32)).to(device),
        offset=torch.from_numpy(warps.offset.astype(np.float32)).to(device),
        taps=taps,
        weights=window_weights(image, taps),
    )


def textured(image: torch.Tensor, *, window: int, noise: float) -> torch.Tensor:
    """(H, W) where a window's detail stands out from the picture's noise, found or expected."""
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
    """The detail (H, W) of a picture's blankest windows; 0 where all of it is clipped."""
    exposed = (image > CLIPPED) & (image < 1 - CLIPPED)
    if not exposed.any():
        return 0.0
    values = detail[exposed].sort().values
    least, *more = (float(values[int(share * len(values))]) for share in BLANK_SHARES)
    blank = max([least, *(value for value in more if value <= BLANK_SPREAD * least)])
    return min(blank, MOST_NOISE)


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

    dx: torch.Tensor  # (S, H, W) float32 motion by which the source's picture is off, pixels
    dy: torch.Tensor  # (S, H, W)
    weight: torch.Tensor  # (S, H, W) float32 in [0, 1], 0 where the motion is not determined


def residual_flow(level: Level, inverse_depth: torch.Tensor, *, noise: float) -> ResidualFlow:
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
        inside = _inside(x, y, z, size)
        flows.append(_motion(level.reference, source, size, (x, y), inside=inside, noise=noise))
    return ResidualFlow(*(torch.stack(part) for part in zip(*flows, strict=True)))


def _motion(
    reference: torch.Tensor, source: torch.Tensor, size: list[int],
    places: tuple[torch.Tensor, torch.Tensor], *, inside: torch.Tensor, noise: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
    x, y = places
    across = F.pad((source[:, 2:] - source[:, :-2]) / 2, (1, 1))
    down = F.pad((source[2:] - source[:-2]) / 2, (0, 0, 1, 1))
    mask = inside.float()
    share = window_mean(mask, WINDOW).clamp(min=1e-3)

    def centred(image: torch.Tensor) -> torch.Tensor:
        return (image - window_mean(image * mask, WINDOW) / share) * mask

    target = centred(reference)
    dx, dy = torch.zeros_like(x), torch.zeros_like(y)
    for _ in range(ITERATIONS):
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
    return dx, dy, clear * ((likeness - 0.6) / 0.4).clamp(0, 1)
