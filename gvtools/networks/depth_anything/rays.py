"""Cameras from predicted ray maps.

A ray map holds, for every cell of a grid over the image, the direction of its ray (channels 0 to 2,
not of unit length: R K⁻¹ p up to one scale a view) and its origin (channels 3 to 5: the camera
centre), in the frame of the first view.

=====================  ==========================================================================
function               use it for
=====================  ==========================================================================
camera_centres         the scale of generated depth, losses: differentiable, no fit at all
poses_least_squares    poses of generated views beside published GLD figures: exact on exact rays,
                       one K for all views, no protection against outliers
poses_ransac           poses of Depth Anything 3's rays: K of every view, outliers are left out
=====================  ==========================================================================

``poses_ransac`` repeats a flaw of the published method unless told otherwise: the direction matrix
is R K⁻¹ with K⁻¹ *upper* triangular, and is factored into a rotation and a *lower* triangular
matrix. The two agree for a principal point in the middle of the image alone; away from it, rotation
entries are wrong by 0.03 to 0.05 on rays without noise. ``factorisation="qr"`` is the right one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gvtools.errors import DegenerateError, OptionError, ShapeError
from gvtools.networks.depth_anything import homography

# Share of the largest singular value below which the rays of a view do not span three directions.
RANK = 1e-9


@dataclass(frozen=True, eq=False)
class RayCameras:
    """Cameras read from ray maps, float64 on the CPU.

    Attributes:
        world_from_cam: (..., V, 4, 4) rigid, in the rays' frame and units.
        K: (..., V, 3, 3), pixels.
    """

    world_from_cam: Tensor
    K: Tensor


def camera_centres(ray: Tensor, confidence: Tensor | None = None) -> Tensor:
    """Confidence-weighted mean of the origins of each view's rays; differentiable.

    Args:
        ray: (..., h, w, 6).
        confidence: (..., h, w) >= 0; None for equal weights.

    Returns:
        (..., 3), the rays' units and dtype.
    """
    _check(ray, confidence)
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
    ray: Tensor,
    confidence: Tensor | None = None,
    *,
    size: tuple[int, int],
    subsample: int = 4,
    cell_offset: float = 0.0,
) -> RayCameras:
    """Poses by a linear fit of each view's directions, as Geometric Latent Diffusion takes them.

    H of every view minimises Σ (w |H (x, y, 1)ᵀ - direction|)² over every ``subsample``-th cell;
    K is H⁻¹ of the first view, R the rotation nearest to H_v K, the centre the weighted mean of all
    origins. Rays with noise leave small numbers in K's lower triangle; they stay.

    Args:
        ray: (..., V, h, w, 6); the first view is the reference.
        confidence: (..., V, h, w) > 0, the weights w; None for equal ones.
        size: (H, W) of the images that K is for, pixels.
        subsample: step between cells.
        cell_offset: where in a cell its ray passes: 0 is published, 0.5 gives K in this project's
            convention (the first pixel's centre at 0.5). Poses are the same.
    """
    _check(ray, confidence, views=True)
    if subsample < 1:
        raise OptionError(f"subsample {subsample}; expected at least 1")
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
    return RayCameras(_pose(rotation, centre), K.expand_as(H))


@torch.no_grad()
def poses_ransac(
    ray: Tensor,
    confidence: Tensor | None = None,
    *,
    size: tuple[int, int],
    threshold: float = 0.2,
    seed: int = 0,
    samples: Tensor | None = None,
    factorisation: str = "ql",
) -> RayCameras:
    """Poses by a robust homography from each view's directions, as Depth Anything 3 takes them.

    The homography leads from an image of [-1, 1]² to the directions' (dx/dz, dy/dz). It is fitted
    to 8 rays of the 30 % most confident, 100 times; the fit whose inliers have the most
    confidence is fitted again to all of these, and factored into a rotation and intrinsics.

    Args:
        ray: (..., V, h, w, 6).
        confidence: (..., V, h, w) >= 0; None for equal weights.
        size: (H, W) of the images that K is for, pixels.
        threshold: largest error of an inlier, in (dx/dz, dy/dz).
        seed: of the samples.
        samples: (iterations, 8), places among the most confident rays, instead of the seed's.
        factorisation: "ql" as published, "qr" as it should be: see the module.
    """
    _check(ray, confidence, views=True)
    if factorisation not in ("ql", "qr"):
        raise OptionError(f"factorisation {factorisation!r}; expected 'ql' or 'qr'")
    batch, (height, width) = ray.shape[:-3], ray.shape[-3:-1]
    ray, weight = _precise(ray, confidence)
    ray = ray.reshape(-1, height * width, 6)
    weight = weight.reshape(ray.shape[:-1])
    if samples is None:
        samples = homography.draw_samples(height * width, seed=seed)
    cell = homography.cells(height, width, dtype=ray.dtype)
    poses, intrinsics = [], []
    for view, (rays, weights) in enumerate(zip(ray, weight, strict=True)):
        try:
            usable = rays[:, 2].abs() > homography.LEAST_Z
            weights = weights * usable
            centre = camera_centres(rays[None], weights[None])
            image = rays[:, :2] / torch.where(usable, rays[:, 2], 1.0)[:, None]
            H = homography.ransac(
                cell, image, weights, samples=samples.to("cpu").long(), threshold=threshold
            )
            R, K = homography.factor(H, upper=factorisation == "qr")
        except DegenerateError as error:
            raise DegenerateError(f"rays of view {view}: {error}") from None
        poses.append(_pose(R, centre))
        intrinsics.append(K)
    scale = torch.tensor([size[1] / 2, size[0] / 2, 1], dtype=ray.dtype)[:, None]
    K = torch.stack(intrinsics)
    K[:, :2, 2] += 1
    return RayCameras(torch.stack(poses).reshape(*batch, 4, 4), (scale * K).reshape(*batch, 3, 3))


def nearest_rotation(matrix: Tensor) -> Tensor:
    """The rotation nearest to each (..., 3, 3) matrix in the Frobenius norm."""
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vh).sign()
    return torch.cat((u[..., :2], u[..., 2:] * sign[..., None, None]), dim=-1) @ vh


def _check(ray: Tensor, confidence: Tensor | None, *, views: bool = False) -> None:
    least = 4 if views else 3
    shape = "(..., V, h, w, 6)" if views else "(..., h, w, 6)"
    if ray.ndim < least or ray.shape[-1] != 6 or 0 in ray.shape:
        raise ShapeError(f"ray map {tuple(ray.shape)}; expected {shape}")
    if confidence is not None and confidence.shape != ray.shape[:-1]:
        raise ShapeError(
            f"ray confidence {tuple(confidence.shape)} for a ray map {tuple(ray.shape)}; expected "
            f"{tuple(ray.shape[:-1])}"
        )


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


def _pose(rotation: Tensor, translation: Tensor) -> Tensor:
    top = torch.cat((rotation, translation[..., None]), dim=-1)
    last = torch.eye(4, dtype=top.dtype)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, last), dim=-2)
