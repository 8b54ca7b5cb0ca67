"""Cameras from predicted ray maps.

A ray map holds, for every cell of a grid over the image, the direction of its ray (channels 0 to 2,
not of unit length: R K⁻¹ p up to one scale a view) and its origin (channels 3 to 5: the camera
centre), in the frame of the first view. ``camera_centres`` needs no fit and is differentiable;
``poses_least_squares`` is exact on exact rays, with one K for all views and no protection against
outliers, as in published GLD figures; ``poses_ransac`` leaves outliers out and gives every view's
K.

``poses_ransac`` repeats a flaw of the published method unless told otherwise: the direction matrix
is R K⁻¹ with K⁻¹ *upper* triangular, and is factored into a rotation and a *lower* triangular
matrix. The two agree for a principal point in the middle of the image alone; away from it, rotation
entries are wrong by 0.03 to 0.05 on rays without noise. ``factorisation="qr"`` is the right one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gvtools.errors import DegenerateError

# Depth Anything 3's settings.
ITERATIONS = 100
SAMPLE = 8
MOST_CONFIDENT = 0.3
LEAST_Z = 1e-4
# A homography has eight unknowns: the second smallest eigenvalue must stand above rounding.
UNIQUE = 1e-13


def cells(height: int, width: int, *, dtype: torch.dtype) -> Tensor:
    """(height * width, 2) centres (x, y) of a grid over [-1, 1]², row-major."""
    y = (2 * torch.arange(height, dtype=dtype) + 1) / height - 1
    x = (2 * torch.arange(width, dtype=dtype) + 1) / width - 1
    return torch.stack((x.repeat(height), y.repeat_interleave(width)), dim=-1)


def candidates(count: int) -> int:
    """How many of ``count`` rays are sampled from: the most confident ones."""
    return max(SAMPLE, int(count * MOST_CONFIDENT))


def draw_samples(count: int, *, seed: int) -> Tensor:
    """(ITERATIONS, SAMPLE) candidates of ``count`` rays, as Depth Anything 3 draws them."""
    generator = torch.Generator().manual_seed(seed)
    pool = candidates(count)
    draws = [torch.randperm(pool, generator=generator)[:SAMPLE] for _ in range(ITERATIONS)]
    return torch.stack(draws)


def fit_homography(source: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Homographies (..., 3, 3) of least weighted algebraic error, of points (..., N, 2) in float64.

    The null direction of the 9x9 normal matrix, which in float64 is as good as the singular vector
    of the (2N, 9) system and needs no memory that grows with N. With it (...), the share of the
    second smallest eigenvalue in the largest: 0 where the points determine no homography.
    """
    point = torch.cat((source, torch.ones_like(source[..., :1])), dim=-1)
    weighted = point * weight[..., None]
    u, v = target[..., :1], target[..., 1:]
    plain = point.mT @ weighted
    by_u, by_v = point.mT @ (weighted * u), point.mT @ (weighted * v)
    squares = point.mT @ (weighted * (u**2 + v**2))
    zero = torch.zeros_like(plain)
    normal = torch.cat(
        (
            torch.cat((plain, zero, -by_u), dim=-1),
            torch.cat((zero, plain, -by_v), dim=-1),
            torch.cat((-by_u, -by_v, squares), dim=-1),
        ),
        dim=-2,
    )
    values, vectors = torch.linalg.eigh(normal)
    share = values[..., 1] / values[..., -1].clamp_min(torch.finfo(values.dtype).tiny)
    return vectors[..., 0].unflatten(-1, (3, 3)), share


def ransac(
    source: Tensor, target: Tensor, weight: Tensor, *, samples: Tensor, threshold: float
) -> Tensor:  # (3, 3), up to scale, determinant above 0
    """The homography (3, 3), determinant above 0, of the sample whose inliers weigh most.

    ``samples`` (iterations, S) are places among the candidates, by falling weight; the inliers'
    error is below ``threshold``. The best is fitted again to all inliers (Depth Anything 3: at most
    8000).
    """
    chosen = weight.argsort(descending=True, stable=True)[samples]
    tried, _ = fit_homography(source[chosen], target[chosen], weight[chosen])
    point = torch.cat((source, torch.ones_like(source[:, :1])), dim=-1)
    projected = point @ tried.mT
    error = (projected[..., :2] / projected[..., 2:] - target).square().sum(-1)
    inlier = error < threshold**2
    best = inlier[(inlier * weight).sum(-1).argmax()] & (weight > 0)
    H, share = fit_homography(source[best], target[best], weight[best])
    if int(best.sum()) < 4 or not float(share) > UNIQUE:
        raise DegenerateError(
            f"{int(best.sum())} of {len(source)} agree within {threshold:g} and determine no "
            "homography; are these ray directions?"
        )
    return H if float(torch.linalg.det(H)) > 0 else -H


def factor(H: Tensor, *, upper: bool) -> tuple[Tensor, Tensor]:
    """A (3, 3) matrix R K⁻¹ of determinant above 0, to R and K, both (3, 3), K[2, 2] = 1.

    ``upper``: K⁻¹ is upper triangular, as intrinsics are. Else H is R times a *lower* triangular L,
    as published, whose diagonal gives 1 / focal lengths and whose last row the principal point,
    which holds for a principal point of 0 alone.
    """
    # A lower triangular factor is the upper one of the columns in reverse order.
    order = [0, 1, 2] if upper else [2, 1, 0]
    Q, T = torch.linalg.qr(H[:, order])
    sign = T.diagonal().sign()
    R, T = (Q * sign)[:, order], (T * sign[:, None])[order][:, order]
    T = T / T[2, 2]
    K = torch.diag(1 / T.diagonal())
    if upper:
        K = torch.linalg.solve_triangular(T, torch.eye(3, dtype=T.dtype), upper=True)
    else:
        K[:2, 2] = T[2, :2]
    if not bool(torch.isfinite(K).all() & torch.isfinite(R).all()):
        raise DegenerateError("the directions span a plane; no intrinsics follow")
    return R, K


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


@torch.no_grad()
def poses_ransac(
    ray: Tensor,  # (..., V, h, w, 6)
    confidence: Tensor | None = None,  # (..., V, h, w) >= 0; None for equal weights
    *,
    size: tuple[int, int],  # (H, W) of the images that K is for, pixels
    threshold: float = 0.2,  # largest error of an inlier, in (dx/dz, dy/dz)
    seed: int = 0,  # of the samples
    # (iterations, 8), places among the most confident rays, instead of the seed's.
    samples: Tensor | None = None,
    factorisation: Literal[
        "ql", "qr"
    ] = "ql",  # "ql" as published, "qr" as it should be: see the module
) -> RayCameras:
    """Poses by a robust homography from each view's directions, as Depth Anything 3 takes them.

    The homography leads from an image of [-1, 1]² to the directions' (dx/dz, dy/dz). It is fitted
    to 8 rays of the 30 % most confident, 100 times; the fit whose inliers have the most
    confidence is fitted again to all of these, and factored into a rotation and intrinsics.
    """
    batch, (height, width) = ray.shape[:-3], ray.shape[-3:-1]
    ray, weight = _precise(ray, confidence)
    ray = ray.reshape(-1, height * width, 6)
    weight = weight.reshape(ray.shape[:-1])
    if samples is None:
        samples = draw_samples(height * width, seed=seed)
    cell = cells(height, width, dtype=ray.dtype)
    poses, intrinsics = [], []
    for view, (rays, weights) in enumerate(zip(ray, weight, strict=True)):
        try:
            usable = rays[:, 2].abs() > LEAST_Z
            weights = weights * usable
            centre = camera_centres(rays[None], weights[None])
            image = rays[:, :2] / torch.where(usable, rays[:, 2], 1.0)[:, None]
            H = ransac(cell, image, weights, samples=samples.to("cpu").long(), threshold=threshold)
            R, K = factor(H, upper=factorisation == "qr")
        except DegenerateError as error:
            raise DegenerateError(f"rays of view {view}: {error}") from None
        poses.append(rigid(R, centre))
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
