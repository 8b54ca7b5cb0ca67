"""Cameras from predicted ray maps.

A ray map holds, for every cell of a grid over the image, the direction of its ray (channels 0 to 2,
not of unit length: R K⁻¹ p up to one scale a view) and its origin (channels 3 to 5: the camera
centre), in the frame of the first view. ``camera_centres`` needs no fit and is differentiable;
``poses_least_squares`` is exact on exact rays, with one K for all views and no protection against
outliers, as in published GLD figures.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gvtools.errors import DegenerateError

# Share of the largest singular value below which the rays of a view do not span three directions.
RANK = 1e-9


@dataclass(frozen=True, eq=False)
class RayCameras:
    """Cameras read from ray maps, float64 on the CPU."""

    world_from_cam: Tensor  # (..., V, 4, 4) rigid, in the rays' frame and units
    K: Tensor  # (..., V, 3, 3), pixels


def camera_centres(ray: Tensor, confidence: Tensor | None = None) -> Tensor:
    """(..., 3) mean of the origins of each view's rays (..., h, w, 6), weighted; differentiable."""
    origin = ray[..., 3:]
    if confidence is None:
        return origin.mean(dim=(-3, -2))
    total = confidence.sum(dim=(-2, -1))
    if not bool((total > 0).all() & (confidence >= 0).all() & torch.isfinite(total).all()):
        raise DegenerateError(
            "ray confidences are negative, not finite, or 0 all over a view; expected weights"
        )
    return (origin * confidence[..., None]).sum(dim=(-3, -2)) / total[..., None]


@torch.no_grad()
def poses_least_squares(
    ray: Tensor,  # (..., V, h, w, 6); the first view is the reference
    confidence: Tensor | None = None,  # (..., V, h, w) > 0, the weights w; None for equal ones
    *,
    size: tuple[int, int],  # (H, W) of the images that K is for, pixels
    subsample: int = 4,  # step between cells
    # Where in a cell its ray passes: 0 is published, 0.5 gives K in this project's convention (the
    # first pixel's centre at 0.5). Poses are the same.
    cell_offset: float = 0.0,
) -> RayCameras:
    """Poses by a linear fit of each view's directions, as Geometric Latent Diffusion takes them.

    H of every view minimises Σ (w |H (x, y, 1)ᵀ - direction|)² over every ``subsample``-th cell;
    K is H⁻¹ of the first view, R the rotation nearest to H_v K, the centre the weighted mean of all
    origins. Rays with noise leave small numbers in K's lower triangle; they stay.
    """
    height, width = ray.shape[-3:-1]
    ray, weight = _precise(ray, confidence)
    centre = camera_centres(ray, weight)
    y, x = torch.meshgrid(
        torch.arange(0, height, subsample, dtype=ray.dtype) + cell_offset,
        torch.arange(0, width, subsample, dtype=ray.dtype) + cell_offset,
        indexing="ij",
    )
    cell = torch.stack((x, y, torch.ones_like(x)), dim=-1).flatten(0, 1)
    weight = weight[..., ::subsample, ::subsample].flatten(-2)[..., None]
    direction = ray[..., ::subsample, ::subsample, :3].flatten(-3, -2)
    left, right = weight * cell, weight * direction
    _check_rank(left, "cells with weight")
    H = torch.linalg.lstsq(left, right).solution.mT
    _check_rank(H, "directions")
    K = torch.linalg.inv(H[..., :1, :, :])
    rotation = nearest_rotation(H @ K)
    K = K / K[..., 2:, 2:]
    K = torch.tensor([size[1] / width, size[0] / height, 1], dtype=K.dtype)[:, None] * K
    return RayCameras(rigid(rotation, centre), K.expand_as(H))


def nearest_rotation(matrix: Tensor) -> Tensor:
    """The rotation nearest to each (..., 3, 3) matrix in the Frobenius norm."""
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vh).sign()
    return torch.cat((u[..., :2], u[..., 2:] * sign[..., None, None]), dim=-1) @ vh


def _check_rank(rows: Tensor, what: str) -> None:
    spread = torch.linalg.svdvals(rows)
    if not bool((spread[..., 2] > RANK * spread[..., 0]).all()):
        raise DegenerateError(f"{what} of a view do not span three dimensions; no pose follows")


def _precise(ray: Tensor, confidence: Tensor | None) -> tuple[Tensor, Tensor]:
    """Rays and weights, float64 on the CPU: the fits are small and want the digits."""
    ray = ray.detach().to("cpu", torch.float64)
    if not bool(torch.isfinite(ray).all()):
        raise DegenerateError("the ray map holds NaN or infinity; no pose follows")
    if confidence is None:
        return ray, torch.ones_like(ray[..., 0])
    return ray, confidence.detach().to("cpu", torch.float64)


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """(..., 4, 4) of (..., 3, 3) and (..., 3)."""
    top = torch.cat((rotation, translation[..., None]), dim=-1)
    last = torch.eye(4, dtype=top.dtype, device=top.device)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, last), dim=-2)
