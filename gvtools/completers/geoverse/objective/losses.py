"""The terms of the training objective, each (B,): one value a sample, to be averaged by the caller.

Appendix "Loss Definitions and Computation". Latent terms see all views, context first; decoded
terms see target views only. What lies outside a mask may hold anything, NaN too: neither a loss nor
a gradient sees it. A sample without a valid pixel gives 0, still part of the graph. References
never receive a gradient. Half-precision inputs are compared in float32.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from gvtools.completers.geoverse.objective.gradient_weights import DELTA, gradient_weights
from gvtools.completers.geoverse.objective.similarity_scale import CenterSimilarity
from gvtools.errors import OptionError, ShapeError
from gvtools.networks.config_json import check_range

Reduction = Literal["mean", "sum"]
WithoutScale = Literal["drop", "one"]


def view_errors(
    predicted: Tensor,
    target: Tensor,
    *,
    reduction: Reduction = "mean",
    views: Tensor | None = None,
) -> Tensor:
    """Squared error (B, V) of each view's velocity, over its grid and channels.

    Args:
        predicted: (B, V, C, h, w).
        target: (B, V, C, h, w).
        reduction: "sum", the squared norm of the paper; "mean", that over C h w, of Geometric
            Latent Diffusion.
        views: (B, V) bool; the others give 0.
    """
    _same_shape("velocity", predicted, target, dims=5)
    if reduction not in ("mean", "sum"):
        raise OptionError(f"reduction {reduction!r}; expected 'mean' or 'sum'")
    error = _wide(predicted) - _wide(target.detach())
    if views is not None:
        _check_mask("views", views, predicted.shape[:2])
        error = torch.where(views[:, :, None, None, None], error, 0.0)
    squared = error.square().flatten(2)
    return squared.sum(-1) if reduction == "sum" else squared.mean(-1)


def flow_matching_loss(
    predicted: Tensor,
    target: Tensor,
    *,
    context: int,
    context_weight: float = 0.25,
    reduction: Reduction = "mean",
    views: Tensor | None = None,
) -> Tensor:
    """L_FM (B,): sum_j alpha_j |u^_j - u_j|^2, of either level; with a reflow target, L_PRF.

    "sum" is the paper's formula. "mean" divides it by C h w and by the number of views: with
    ``context_weight`` 1 it is Geometric Latent Diffusion's loss. The paper names no coefficient, so
    the constant factor between them belongs to the coefficient.

    Args:
        predicted: (B, V, C, h, w) velocity.
        target: (B, V, C, h, w), see ``flow.velocity_target``.
        context: number of context views, which come first.
        context_weight: alpha of context views; target views have 1.
        reduction: see above.
        views: (B, V) bool; the others do not count.
    """
    check_range("context weight", context_weight, ge=0)
    errors = view_errors(predicted, target, reduction=reduction, views=views)
    count = errors.shape[1]
    if not 0 <= context <= count:
        raise OptionError(f"context {context}; expected 0 to {count}, the number of views")
    alpha = torch.ones(count, dtype=errors.dtype, device=errors.device)
    alpha[:context] = context_weight
    loss = (errors * alpha).sum(1)
    if reduction == "sum":
        return loss
    return loss / (count if views is None else views.sum(1).clamp(min=1))


def rgb_mask(reference: Tensor, valid: Tensor | None, views: Tensor | None) -> Tensor:
    """Omega^rgb (B, T, H, W): finite reference pixels that are ``valid``, in ``views``.

    Args:
        reference: (B, T, 3, H, W).
        valid: (B, T, H, W) bool or None. Not the visibility in the memory's projection: pixels
            that the projection misses are supervised too.
        views: (B, T) bool or None.
    """
    return _pixels(reference.isfinite().all(2), valid, views)


def rgb_loss(
    predicted: Tensor,
    reference: Tensor,
    *,
    valid: Tensor | None = None,
    views: Tensor | None = None,
) -> Tensor:
    """L_rgb (B,): the mean of e(p) = |I^(p) - I(p)|_1 / 3 over the valid pixels of all views.

    Args:
        predicted: (B, T, 3, H, W), target views.
        reference: (B, T, 3, H, W), normalised like ``predicted``.
        valid: see ``rgb_mask``.
        views: see ``rgb_mask``.
    """
    _same_shape("picture", predicted, reference, dims=5)
    mask = rgb_mask(reference, valid, views)
    return _pixel_mean(_rgb_error(predicted, reference, mask), mask)


def high_gradient_loss(
    predicted: Tensor,
    reference: Tensor,
    *,
    valid: Tensor | None = None,
    views: Tensor | None = None,
) -> Tensor:
    """L_hf (B,): the mean of e(p) weighted by the reference's gradient; 0 where all weights are 0.

    Arguments are those of ``rgb_loss``; the weights are those of ``gradient_weights``.
    """
    _same_shape("picture", predicted, reference, dims=5)
    mask = rgb_mask(reference, valid, views)
    weight = gradient_weights(reference, mask)
    error = _rgb_error(predicted, reference, mask)
    return (weight * error).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp(min=DELTA)


def depth_mask(reference: Tensor, valid: Tensor | None, views: Tensor | None) -> Tensor:
    """Omega^depth (B, T, H, W): reference depth finite, above 0, ``valid``, in ``views``."""
    return _pixels(reference.isfinite() & (reference > 0), valid, views)


def depth_loss(
    predicted: Tensor,
    reference: Tensor,
    *,
    similarity: CenterSimilarity,
    valid: Tensor | None = None,
    views: Tensor | None = None,
    scale_gradient: bool = False,
    without_scale: WithoutScale = "drop",
) -> Tensor:
    """L_depth (B,): the mean of |s* D^(p) - D(p)| over the valid pixels of all views.

    Args:
        predicted: (B, T, H, W) z-depth of target views, the unit of the predicted centres.
        reference: (B, T, H, W) z-depth, the unit of the reference centres.
        similarity: of all the sample's camera centres, see ``center_similarity``.
        valid: (B, T, H, W) bool or None, see ``depth_mask``.
        views: (B, T) bool or None.
        scale_gradient: whether the loss moves the predicted centres through s*. The paper leaves it
            open. Off, because it calls s* a scale recovered to align the depth, constructed beside
            the gradient weights, and because the gradient grows as 1 / baseline; on, it is the
            objective's only pull upon the predicted rays.
        without_scale: of samples whose centres give no scale: "drop" them (loss 0), or "one", take
            the depth as it is.
    """
    _same_shape("depth", predicted, reference, dims=4)
    if without_scale not in ("drop", "one"):
        raise OptionError(f"without_scale {without_scale!r}; expected 'drop' or 'one'")
    if similarity.scale.shape != predicted.shape[:1]:
        raise ShapeError(
            f"similarity of {tuple(similarity.scale.shape)} sample(s); expected {len(predicted)}"
        )
    mask = depth_mask(reference, valid, views)
    if without_scale == "drop":
        mask = mask & similarity.ok[:, None, None, None]
    scale = similarity.scale if scale_gradient else similarity.scale.detach()
    scale = torch.where(similarity.ok, scale, 1.0)[:, None, None, None]
    # Masked before the product: the scale's gradient sums over the predicted depth.
    found = torch.where(mask, _wide(predicted), 0.0)
    wanted = torch.where(mask, _wide(reference.detach()), 0.0)
    return _pixel_mean((scale * found - wanted).abs(), mask)


def _rgb_error(predicted: Tensor, reference: Tensor, mask: Tensor) -> Tensor:
    difference = _wide(predicted) - _wide(reference.detach())
    return torch.where(mask[:, :, None], difference, 0.0).abs().mean(2)


def _pixel_mean(error: Tensor, mask: Tensor) -> Tensor:
    """Sum of an error that is 0 outside the mask, over the mask's pixels, at least one."""
    return error.sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp(min=1)


def _pixels(known: Tensor, valid: Tensor | None, views: Tensor | None) -> Tensor:
    if valid is not None:
        _check_mask("valid", valid, known.shape)
        known = known & valid
    if views is not None:
        _check_mask("views", views, known.shape[:2])
        known = known & views[:, :, None, None]
    return known


def _check_mask(name: str, mask: Tensor, shape: torch.Size) -> None:
    if mask.dtype != torch.bool or mask.shape != shape:
        raise ShapeError(f"{name}: {mask.dtype} {tuple(mask.shape)}; expected bool {tuple(shape)}")


def _same_shape(name: str, predicted: Tensor, reference: Tensor, *, dims: int) -> None:
    if predicted.ndim != dims or predicted.shape != reference.shape:
        raise ShapeError(
            f"{name}: predicted {tuple(predicted.shape)}, reference {tuple(reference.shape)}; "
            f"expected one shape of {dims} dimensions"
        )


def _wide(x: Tensor) -> Tensor:
    return x.to(torch.promote_types(x.dtype, torch.float32))
