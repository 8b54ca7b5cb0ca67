"""Pictures reduced to the levels on which they are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from kornia.color import rgb_to_grayscale
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate
from gvtools.depth.stereo.matching import Level
from gvtools.depth.stereo.warps import relative_warps

# Weights of a window's pixels: how fast they fall with the difference in luminance and with the
# distance, the latter in halves of the window.
LUMINANCE, DISTANCE = 0.12, 1.0


@dataclass(frozen=True, eq=False)
class Pyramid:
    """One view's picture on every level, finest first.

    Attributes:
        images: (H, W) float32 luminance in [0, 1], one for each level.
        cameras: the view's camera for each level, batches of one.
    """

    images: tuple[torch.Tensor, ...]
    cameras: tuple[Cameras, ...]


def working_size(width: int, height: int, max_side: int) -> tuple[int, int]:
    """Width and height of the finest level: the picture's, or reduced to ``max_side``."""
    scale = min(1.0, max_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def build_pyramid(
    rgb: NDArray[np.uint8], camera: Cameras, *, max_side: int, levels: int
) -> Pyramid:
    """The levels of one picture, each half the size of the one before.

    Args:
        rgb: (H, W, 3).
        camera: a batch of one.
        max_side: see StereoOptions.
        levels: see StereoOptions; fewer where the picture would fall below 16 pixels.
    """
    colors = torch.from_numpy(rgb).permute(2, 0, 1).float() / 255
    luminance = rgb_to_grayscale(colors)[0]  # (H, W), BT.601
    width, height = working_size(rgb.shape[1], rgb.shape[0], max_side)
    images: list[torch.Tensor] = []
    cameras: list[Cameras] = []
    for _ in range(levels):
        if images and min(width, height) < 16:
            break
        luminance = resampled(luminance, width, height)
        images.append(luminance)
        cameras.append(camera.resized(width, height))
        width, height = max(1, round(width / 2)), max(1, round(height / 2))
    return Pyramid(tuple(images), tuple(cameras))


def resampled(image: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """(..., H, W) image resampled without aliasing; the picture's outline stays where it is."""
    if image.shape[-2:] == (height, width):
        return image
    flat = image.reshape(1, -1, *image.shape[-2:])
    small = F.interpolate(
        flat, (height, width), mode="bilinear", align_corners=False, antialias=True
    )
    return small.reshape(*image.shape[:-2], height, width).contiguous()


def resampled_colors(rgb: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 of an (H, W, 3) uint8 picture; see ``resampled``."""
    if rgb.shape[:2] == (height, width):
        return np.ascontiguousarray(rgb)
    colors = resampled(torch.from_numpy(rgb).permute(2, 0, 1).float(), width, height)
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
    reference: Pyramid,
    sources: Sequence[Pyramid],
    index: int,
    *,
    window: int,
    device: torch.device,
) -> Level:
    """One level of a reference view and its sources, ready to be matched.

    Args:
        reference: the view that gets depth.
        sources: at least one.
        index: 0 is the finest.
        window: side of the compared window, pixels.
        device: where it is matched.
    """
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
