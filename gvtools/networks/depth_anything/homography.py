"""Robust homographies from ray directions, and their factors: rotation and intrinsics."""

from __future__ import annotations

import torch
from torch import Tensor

from gvtools.errors import DegenerateError, ShapeError

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
    """(ITERATIONS, SAMPLE) places among the candidates of ``count`` rays.

    The same as Depth Anything 3 draws on a CPU after ``torch.manual_seed(seed)``.
    """
    if count < SAMPLE:
        raise DegenerateError(f"{count} rays; a homography is sampled from at least {SAMPLE}")
    generator = torch.Generator().manual_seed(seed)
    pool = candidates(count)
    draws = [torch.randperm(pool, generator=generator)[:SAMPLE] for _ in range(ITERATIONS)]
    return torch.stack(draws)


def fit(source: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Homographies that minimise the weighted algebraic error.

    The null direction of the 9x9 normal matrix, which in float64 is as good as the singular vector
    of the (2N, 9) system and needs no memory that grows with N.

    Args:
        source: (..., N, 2) float64.
        target: (..., N, 2).
        weight: (..., N) >= 0, of the squared errors.

    Returns:
        (..., 3, 3), up to scale, and (...), the share of the second smallest eigenvalue in the
        largest: 0 where the points do not determine a homography.
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
) -> Tensor:
    """The homography of the sample whose inliers weigh most, fitted again to these.

    Depth Anything 3 fits again to at most 8000 inliers drawn at random; here it is all of them.

    Args:
        source: (N, 2) float64.
        target: (N, 2).
        weight: (N,) >= 0.
        samples: (iterations, S) places among the candidates, by falling weight.
        threshold: an inlier's error is below it, in units of ``target``.

    Returns:
        (3, 3), up to scale, determinant above 0.
    """
    pool = min(candidates(len(source)), len(source))
    if samples.ndim != 2 or int(samples.min()) < 0 or int(samples.max()) >= pool:
        raise ShapeError(
            f"samples {tuple(samples.shape)} up to {int(samples.max())}; expected "
            f"(iterations, {SAMPLE}) below {pool}"
        )
    chosen = weight.argsort(descending=True, stable=True)[samples]
    tried, _ = fit(source[chosen], target[chosen], weight[chosen])
    point = torch.cat((source, torch.ones_like(source[:, :1])), dim=-1)
    projected = point @ tried.mT
    error = (projected[..., :2] / projected[..., 2:] - target).square().sum(-1)
    inlier = error < threshold**2
    best = inlier[(inlier * weight).sum(-1).argmax()] & (weight > 0)
    H, share = fit(source[best], target[best], weight[best])
    if int(best.sum()) < 4 or not float(share) > UNIQUE:
        raise DegenerateError(
            f"{int(best.sum())} of {len(source)} agree within {threshold:g} and determine no "
            "homography; are these ray directions?"
        )
    return H if float(torch.linalg.det(H)) > 0 else -H


def factor(H: Tensor, *, upper: bool) -> tuple[Tensor, Tensor]:
    """A (3, 3) matrix R K⁻¹ of determinant above 0, to R and K, both (3, 3), K[2, 2] = 1.

    Args:
        H: up to scale.
        upper: K⁻¹ is upper triangular, as intrinsics are. Else H is R times a *lower* triangular
            L, as published, whose diagonal gives 1 / focal lengths and whose last row the
            principal point, which holds for a principal point of 0 alone.
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
