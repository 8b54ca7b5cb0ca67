"""Posed photographs that poses and Gaussians are fitted to, at several sizes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

# Reduced pictures are no smaller than this [px].
SMALLEST = 16


@dataclass(frozen=True, eq=False)
class FitView:
    """One photograph (H, W, 3), its intrinsics [px] and its pose in a local frame."""

    rgb: NDArray[np.uint8]
    K: NDArray[np.float64]
    cam_from_local: NDArray[np.float64]
    # (H, W), True = use; None uses all.
    mask: NDArray[np.bool_] | None = None
    # (H, W) recorded z-depth, scene units, 0 = none.
    depth: NDArray[np.float32] | None = None
    # Likewise, estimated by a network and wrong by some percent.
    estimate: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class ReducedView:
    """A photograph at one size, and the intrinsics of this size."""

    # (3, H, W) colours from 0 to 1.
    target: NDArray[np.float32]
    # (H, W) the share of each pixel that is used.
    weight: NDArray[np.float32]
    depth: NDArray[np.float32] | None
    estimate: NDArray[np.float32] | None
    K: NDArray[np.float64]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.target.shape[2], self.target.shape[1]

    @property
    def nbytes(self) -> int:
        """Of all arrays."""
        arrays = (self.target, self.weight, self.depth, self.estimate)
        return sum(array.nbytes for array in arrays if array is not None)


def reduce_view(view: FitView, factor: int) -> ReducedView:
    """A view at one over ``factor`` of its size; colours are means, depth is picked.

    Of colours only those that the mask lets through count.
    """
    height, width = view.rgb.shape[:2]
    rows, columns = max(height // factor, SMALLEST), max(width // factor, SMALLEST)
    if factor == 1:
        rows, columns = height, width
    target = torch.from_numpy(view.rgb).permute(2, 0, 1).float() / 255
    mask = np.ones((height, width), np.float32) if view.mask is None else view.mask
    weight = torch.from_numpy(np.asarray(mask, np.float32))[None]
    both = torch.cat([target * weight, weight])
    if (rows, columns) != (height, width):
        both = torch.nn.functional.interpolate(both[None], (rows, columns), mode="area")[0]
    depth, estimate = (
        None if full is None else _pick(full, rows, columns) for full in (view.depth, view.estimate)
    )
    K = view.K.copy()
    K[0] *= columns / width
    K[1] *= rows / height
    arrays = both.contiguous().numpy()
    if view.mask is not None:
        arrays[:3] /= np.maximum(arrays[3], np.float32(1e-6))
    return ReducedView(arrays[:3], arrays[3], depth, estimate, K)


def _pick(depth: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """The pixels of (H, W) depth that are nearest to those of a smaller picture."""
    height, width = depth.shape
    if (rows, columns) == (height, width):
        return depth
    y = ((np.arange(rows) + 0.5) * height / rows).astype(int)
    x = ((np.arange(columns) + 0.5) * width / columns).astype(int)
    return np.ascontiguousarray(depth[y][:, x])
