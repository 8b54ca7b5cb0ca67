"""The training objective, its five terms, and the scale from camera centres.

L = l_1 L_FM^1 + l_0 L_FM^0 + l_rgb L_rgb + l_hf L_hf + l_depth L_depth
(Eq. "complete_training_loss" of the paper, appendix "Loss Definitions and Computation").

Each term is (B,): one value a sample, to be averaged by the caller. Latent terms see all views,
context first; decoded terms see target views only. What lies outside a mask may hold anything, NaN
too: neither a loss nor a gradient sees it. A sample without a valid pixel gives 0, still part of
the graph. References never receive a gradient. Half-precision inputs are compared in float32.

The scale: (s*, Q*, b*) minimises sum_j |s Q o^_j + b - o_j|^2 over s > 0, Q in SO(3), b (appendix
"Scale-aligned depth supervision"). The scale, unlike the rotation, is determined by two centres or
by centres on a line, so these are solved; where it stays open the status says so, and its numbers
are NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

DELTA = 1e-6
# ITU-R BT.601; the paper says "grayscale" only.
LUMA = (0.299, 0.587, 0.114)
QUANTILES = (0.50, 0.98)


@torch.no_grad()
def gradient_weights(reference: Tensor, valid: Tensor) -> Tensor:
    """Weights (B, T, H, W) in [0, 1] of a picture's edges and texture, without a gradient.

    w(p) = clip((g(p) - q_0.50) / (q_0.98 - q_0.50 + delta)), g the Sobel magnitude of the grayscale
    picture, the quantiles taken over all valid pixels of a sample's views (appendix "RGB
    supervision"). Pixels that are not ``valid`` (B, T, H, W) have weight 0.
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


DEFECTS = (
    "aligned",
    "fewer than 2 valid centres",
    "coincident predicted centres",
    "coincident reference centres",
    "unrelated centres",
)
# Spreads below this many roundings of the coordinates' magnitude are no geometry.
ROUNDINGS = 4


@dataclass(frozen=True, eq=False)
class CenterSimilarity:
    """The scale of reference ≈ scale · rotation · predicted + translation, for each sample."""

    scale: Tensor  # (B,) reference units per predicted unit; NaN where not ``ok``
    ok: Tensor  # (B,) bool, whether the scale holds
    defect: Tensor  # (B,) int64, index into ``DEFECTS``
    used: Tensor  # (B,) int64, centres the fit stands on
    # (B,) in [0, 1], 1 where the similarity maps the centres exactly; NaN where not ``ok``. The
    # share of the reference's spread left over is 1 - correlation^2.
    correlation: Tensor

    @property
    def status(self) -> tuple[str, ...]:
        """What ``DEFECTS`` says of each sample."""
        return tuple(DEFECTS[index] for index in self.defect.tolist())


@torch.no_grad()
def center_similarity(predicted: Tensor, reference: Tensor) -> CenterSimilarity:
    """One similarity a sample of camera centres (B, V, 3), by SVD of their cross-covariance.

    Solved in float64 on the CPU, so that every device gives the same scale. Centres that are not
    finite are left out.
    """
    x, y = (z.to("cpu").to(torch.float64) for z in (predicted, reference))
    use = (x.isfinite() & y.isfinite()).all(-1)
    count = use.sum(1)
    x, x_flat = _centered(x, use, torch.finfo(predicted.dtype).eps)
    y, y_flat = _centered(y, use, torch.finfo(reference.dtype).eps)
    x_spread, y_spread = (x**2).sum((1, 2)), (y**2).sum((1, 2))

    covariance = y.mT @ x
    u, _, vt = torch.linalg.svd(covariance)
    sign = torch.ones_like(u[..., 0])
    sign[:, 2] = torch.where(torch.linalg.det(u) * torch.linalg.det(vt) < 0, -1.0, 1.0)
    # Of the rotation and the covariance: d_0 + d_1 ± d_2 >= 0.
    matched = (((u * sign[:, None, :]) @ vt) * covariance).sum((1, 2))
    size = (x_spread * y_spread).sqrt()
    coarsest = max(torch.finfo(z.dtype).eps for z in (predicted, reference))
    unrelated = matched <= ROUNDINGS * coarsest * size

    defect = torch.zeros_like(count)
    for index, holds in ((4, unrelated), (3, y_flat), (2, x_flat), (1, count < 2)):
        defect = torch.where(holds, index, defect)
    ok = defect == 0
    wide = torch.promote_types(predicted.dtype, torch.float32)
    scale, correlation = (
        torch.where(ok, value, torch.nan).to(wide).to(predicted.device)
        for value in (matched / x_spread, (matched / size).clamp(max=1))
    )
    return CenterSimilarity(scale, ok.to(predicted.device), defect, count, correlation)


def _centered(points: Tensor, use: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Points about their centroid (0 where unused), and whether they coincide."""
    points = torch.where(use[..., None], points, 0.0)
    count = use.sum(1).clamp(min=1)
    center = points.sum(1) / count[:, None]
    moved = torch.where(use[..., None], points - center[:, None], 0.0)
    rms = (moved.square().sum((1, 2)) / count).sqrt()
    return moved, rms <= ROUNDINGS * eps * points.abs().amax((1, 2))


def flow_matching_loss(
    predicted: Tensor, target: Tensor, *, context: int, context_weight: float = 0.25
) -> Tensor:
    """L_FM (B,): sum_j alpha_j |u^_j - u_j|^2, of either level; with a reflow target, L_PRF.

    Velocities are (B, V, C, h, w), alpha is ``context_weight`` for context views and 1 for targets.
    The paper's sum is divided by V C h w here, a constant factor: the paper names no coefficient.
    With ``context_weight`` 1 it is Geometric Latent Diffusion's loss.
    """
    errors = (_wide(predicted) - _wide(target.detach())).square().flatten(2).mean(-1)
    alpha = torch.ones_like(errors)
    alpha[:, :context] = context_weight
    return (errors * alpha).mean(1)


def rgb_mask(reference: Tensor, valid: Tensor | None) -> Tensor:
    """Omega^rgb (B, T, H, W): finite pixels of the reference (B, T, 3, H, W) that are ``valid``."""
    known = reference.isfinite().all(2)
    return known if valid is None else known & valid


def rgb_loss(predicted: Tensor, reference: Tensor, *, valid: Tensor | None = None) -> Tensor:
    """L_rgb (B,): the mean of e(p) = |I^(p) - I(p)|_1 / 3 over the ``rgb_mask`` of all views."""
    mask = rgb_mask(reference, valid)
    return _pixel_mean(_rgb_error(predicted, reference, mask), mask)


def high_gradient_loss(
    predicted: Tensor, reference: Tensor, *, valid: Tensor | None = None
) -> Tensor:
    """L_hf (B,): the mean of e(p) weighted by ``gradient_weights``; 0 where all weights are 0."""
    mask = rgb_mask(reference, valid)
    weight = gradient_weights(reference, mask)
    error = _rgb_error(predicted, reference, mask)
    return (weight * error).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp(min=DELTA)


def depth_mask(reference: Tensor, valid: Tensor | None) -> Tensor:
    """Omega^depth (B, T, H, W): reference depth finite, above 0, ``valid``."""
    known = reference.isfinite() & (reference > 0)
    return known if valid is None else known & valid


def depth_loss(
    predicted: Tensor,  # (B, T, H, W) z-depth of target views, the unit of the predicted centres
    reference: Tensor,  # (B, T, H, W) z-depth, the unit of the reference centres
    *,
    # Of all the sample's camera centres; a sample without a scale has a loss of 0.
    similarity: CenterSimilarity,
    valid: Tensor | None = None,  # (B, T, H, W) bool or None, see ``depth_mask``
) -> Tensor:
    """L_depth (B,): the mean of |s* D^(p) - D(p)| over the valid pixels of all views.

    The scale aligns, and receives no gradient: the paper leaves that open, and the gradient would
    grow as 1 / baseline.
    """
    mask = depth_mask(reference, valid) & similarity.ok[:, None, None, None]
    scale = torch.where(similarity.ok, similarity.scale, 1.0)[:, None, None, None]
    found = torch.where(mask, _wide(predicted), 0.0)
    wanted = torch.where(mask, _wide(reference.detach()), 0.0)
    return _pixel_mean((scale * found - wanted).abs(), mask)


def _rgb_error(predicted: Tensor, reference: Tensor, mask: Tensor) -> Tensor:
    difference = _wide(predicted) - _wide(reference.detach())
    return torch.where(mask[:, :, None], difference, 0.0).abs().mean(2)


def _pixel_mean(error: Tensor, mask: Tensor) -> Tensor:
    """Sum of an error that is 0 outside the mask, over the mask's pixels, at least one."""
    return error.sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp(min=1)


def _wide(x: Tensor) -> Tensor:
    return x.to(torch.promote_types(x.dtype, torch.float32))


@dataclass(frozen=True, eq=False)
class Objective:
    """The objective of one mini-batch."""

    total: Tensor  # (), the weighted sum
    # (), each term before its coefficient, averaged over the mini-batch; a term of coefficient 0 is
    # there to be logged and has no gradient.
    terms: dict[str, Tensor]
    # (), what the terms stood on: ``rgb_pixels``, ``depth_pixels``; ``rgb_empty`` and
    # ``depth_empty``, samples without a valid pixel; ``depth_without_scale``, samples whose camera
    # centres gave no scale.
    counts: dict[str, Tensor]


def objective(
    # What the model gave, of V views, context first, and T target views: velocities "level1" and
    # "level0" (B, V, C, h, w); "image" (B, T, 3, H, W); z-depth "depth" (B, T, H, W) with the
    # camera "centers" (B, V, 3), in the model's units. What is absent has no term.
    predicted: Mapping[str, Tensor],
    # The truth of each, lengths in scene units; "image_valid" and "depth_valid" (B, T, H, W) bool
    # where some pixels do not count.
    reference: Mapping[str, Tensor],
    *,
    context: int,  # number of context views
    weights: Mapping[str, float],  # coefficients of the terms by name; 1 where there is none
    context_weight: float = 0.25,  # see ``flow_matching_loss``
) -> Objective:
    """Every term that has a prediction, their weighted sum, and their counts."""
    losses: dict[str, Callable[[], Tensor]] = {}
    counts: dict[str, Tensor] = {}
    for level in ("level1", "level0"):
        if level in predicted:
            losses[level] = partial(
                flow_matching_loss,
                predicted[level],
                reference[level],
                context=context,
                context_weight=context_weight,
            )
    if "image" in predicted:
        images, valid = (predicted["image"], reference["image"]), reference.get("image_valid")
        losses["rgb"] = partial(rgb_loss, *images, valid=valid)
        losses["hf"] = partial(high_gradient_loss, *images, valid=valid)
        _count(counts, "rgb", rgb_mask(reference["image"], valid))
    if "depth" in predicted:
        depths, valid = (predicted["depth"], reference["depth"]), reference.get("depth_valid")
        similarity = center_similarity(predicted["centers"], reference["centers"])
        losses["depth"] = partial(depth_loss, *depths, similarity=similarity, valid=valid)
        _count(counts, "depth", depth_mask(reference["depth"], valid))
        counts["depth_without_scale"] = (~similarity.ok).sum()
    terms, total = {}, None
    for name, loss in losses.items():
        weight = weights.get(name, 1.0)
        with nullcontext() if weight > 0 else torch.no_grad():
            terms[name] = loss().mean()
        if weight > 0:
            total = weight * terms[name] if total is None else total + weight * terms[name]
    if total is None:
        total = torch.zeros_like(next(iter(terms.values())))
    return Objective(total, terms, counts)


def _count(counts: dict[str, Tensor], name: str, mask: Tensor) -> None:
    pixels = mask.sum((1, 2, 3))
    counts[f"{name}_pixels"] = pixels.sum()
    counts[f"{name}_empty"] = (pixels == 0).sum()
