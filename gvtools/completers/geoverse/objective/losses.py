"""The terms of the training objective, each (B,): one value a sample, to be averaged by the caller.

Appendix "Loss Definitions and Computation". Latent terms see all views, context first; decoded
terms see target views only. What lies outside a mask may hold anything, NaN too: neither a loss nor
a gradient sees it. A sample without a valid pixel gives 0, still part of the graph. References
never receive a gradient. Half-precision inputs are compared in float32.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gvtools.completers.geoverse.objective.gradient_weights import DELTA, gradient_weights
from gvtools.completers.geoverse.objective.similarity_scale import CenterSimilarity


def view_errors(predicted: Tensor, target: Tensor) -> Tensor:
    """Squared error (B, V) of each view's velocity (B, V, C, h, w), the mean over C h w."""
    return (_wide(predicted) - _wide(target.detach())).square().flatten(2).mean(-1)


def flow_matching_loss(
    predicted: Tensor, target: Tensor, *, context: int, context_weight: float = 0.25
) -> Tensor:
    """L_FM (B,): sum_j alpha_j |u^_j - u_j|^2, of either level; with a reflow target, L_PRF.

    The paper's sum is divided by V C h w here, a constant factor: the paper names no coefficient.
    With ``context_weight`` 1 it is Geometric Latent Diffusion's loss.

    Args:
        predicted: (B, V, C, h, w) velocity.
        target: (B, V, C, h, w), see ``flow.velocity_target``.
        context: number of context views, which come first.
        context_weight: alpha of context views; target views have 1.
    """
    errors = view_errors(predicted, target)
    alpha = torch.ones_like(errors)
    alpha[:, :context] = context_weight
    return (errors * alpha).mean(1)


def rgb_mask(reference: Tensor, valid: Tensor | None) -> Tensor:
    """Omega^rgb (B, T, H, W): finite reference pixels that are ``valid``.

    Args:
        reference: (B, T, 3, H, W).
        valid: (B, T, H, W) bool; None for all.
    """
    known = reference.isfinite().all(2)
    return known if valid is None else known & valid


def rgb_loss(predicted: Tensor, reference: Tensor, *, valid: Tensor | None = None) -> Tensor:
    """L_rgb (B,): the mean of e(p) = |I^(p) - I(p)|_1 / 3 over the valid pixels of all views.

    Args:
        predicted: (B, T, 3, H, W), target views.
        reference: (B, T, 3, H, W), normalised like ``predicted``.
        valid: see ``rgb_mask``.
    """
    mask = rgb_mask(reference, valid)
    return _pixel_mean(_rgb_error(predicted, reference, mask), mask)


def high_gradient_loss(
    predicted: Tensor, reference: Tensor, *, valid: Tensor | None = None
) -> Tensor:
    """L_hf (B,): the mean of e(p) weighted by the reference's gradient; 0 where all weights are 0.

    Arguments are those of ``rgb_loss``; the weights are those of ``gradient_weights``.
    """
    mask = rgb_mask(reference, valid)
    weight = gradient_weights(reference, mask)
    error = _rgb_error(predicted, reference, mask)
    return (weight * error).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp(min=DELTA)


def depth_mask(reference: Tensor, valid: Tensor | None) -> Tensor:
    """Omega^depth (B, T, H, W): reference depth finite, above 0, ``valid``."""
    known = reference.isfinite() & (reference > 0)
    return known if valid is None else known & valid


def depth_loss(
    predicted: Tensor,
    reference: Tensor,
    *,
    similarity: CenterSimilarity,
    valid: Tensor | None = None,
) -> Tensor:
    """L_depth (B,): the mean of |s* D^(p) - D(p)| over the valid pixels of all views.

    The scale aligns, and receives no gradient: the paper leaves that open, and the gradient would
    grow as 1 / baseline.

    Args:
        predicted: (B, T, H, W) z-depth of target views, the unit of the predicted centres.
        reference: (B, T, H, W) z-depth, the unit of the reference centres.
        similarity: of all the sample's camera centres; a sample without a scale has a loss of 0.
        valid: (B, T, H, W) bool or None, see ``depth_mask``.
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
