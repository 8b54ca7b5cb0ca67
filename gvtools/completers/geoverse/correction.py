"""A completion as a correction of the filled projection.

Decoded pictures are as sharp as a small network's decoder makes them; the filled projection is as
sharp as the memory. What the model *changed* is the difference between the decoding of its
features and that of the projection's own, and this difference is added to the projection: where
the model changes nothing, nothing changes. What it would change of the memory's own pixels is
continued through the holes and taken away, so that a hole's rim does not show. A departure from
the paper, whose result is the decoding itself (``composition``).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.passes import Decoded, Generated
from gvtools.completers.push_pull import push_pull

# Depth is corrected by at most this factor.
MOST = 1.5
# A correction of depth counts by what it exceeds this log-ratio: the surfaces that memory's are
# continued along are mostly right, to less than a small network can tell; where they are wrong, it
# is by much.
CERTAIN = 0.08
# The same factor while training: out of the way.
FAR = 1e3


def without_seams(values: Tensor, patch: int) -> Tensor:
    """Decoded pictures (N, C, H, W) without the steps from patch to patch.

    A small decoder makes each patch by itself. Here the means of the patches are joined linearly,
    and what a patch shows around its mean stays. A pixel that is not finite stays so, alone.

    Args:
        values: H and W are multiples of ``patch``.
        patch: side of a patch, pixels.
    """
    finite = values.isfinite()
    share = F.avg_pool2d(finite.to(values.dtype), patch)
    mean = F.avg_pool2d(torch.where(finite, values, 0), patch) / share.clamp_min(1 / patch**2)
    size = (values.shape[-2], values.shape[-1])
    steps = F.interpolate(mean, size=size, mode="nearest")
    return values - steps + F.interpolate(mean, size=size, mode="bilinear", align_corners=False)


def seamless(made: Generated, patch: int) -> Generated:
    """A pass whose pictures are ``without_seams``."""

    def joined(found: Decoded) -> Decoded:
        shape = found.rgb.shape[:2]
        rgb = without_seams(found.rgb.float().flatten(0, 1), patch).unflatten(0, shape)
        return replace(found, rgb=rgb)

    hint = None if made.hint is None else joined(made.hint)
    return replace(made, decoded=joined(made.decoded), hint=hint)


def corrected_color(filled: Tensor, made: Tensor, hint: Tensor, *, valid: Tensor) -> Tensor:
    """The filled projection plus what the model changed; not clipped to [0, 1].

    A pixel that is not finite in either decoding stays so, alone.

    Args:
        filled: (N, 3, H, W) the filled projection.
        made: likewise, decoded from generated features.
        hint: likewise, decoded from the filled projection's features.
        valid: (N, 1, H, W) bool, where the memory knows.
    """
    change = made - hint
    known = valid & change.isfinite().all(1, keepdim=True)
    return filled + change - push_pull(change, known)


def corrected_depth(
    filled: Tensor,
    made: Tensor,
    hint: Tensor,
    *,
    valid: Tensor,
    certain: float = CERTAIN,
    most: float = MOST,
) -> Tensor:
    """The filled projection's depth by the ratio of two decodings.

    A pixel without a ratio (NaN, or 0 in both) is NaN, alone.

    Args:
        filled: (N, 1, H, W) z-depth, scene units; 0 = none, and stays so.
        made: likewise, model units, above 0.
        hint: likewise.
        valid: (N, 1, H, W) bool, where the memory knows.
        certain: log-ratio that a correction counts from.
        most: largest factor.
    """
    change = made.log() - hint.log()
    change = change - push_pull(change, valid & change.isfinite())
    if certain > 0:
        change = torch.where(change.abs() > certain, change - certain * change.sign(), 0 * change)
    limit = math.log(most)
    return filled * change.clamp(-limit, limit).exp()


def composed(batch: ViewBatch, made: Decoded, hint: Decoded | None) -> tuple[Tensor, Tensor]:
    """Pictures (B, T, 3, H, W) and depth (B, T, H, W) of the targets, as training judges them.

    At the model's size, every correction of depth counting in full.

    Args:
        batch: filled as the model saw it (``conditioning.filled``).
        made: decoded from generated features.
        hint: decoded from the filled projections' features; None for the decoding itself.
    """
    rgb, depth = made.rgb.float(), made.depth
    if hint is None:
        return rgb, depth
    shape = rgb.shape[:2]
    filled, known, valid = (
        value[:, batch.context :].flatten(0, 1)
        for value in (batch.images, batch.depth, batch.valid)
    )
    color = corrected_color(filled, rgb.flatten(0, 1), hint.rgb.float().flatten(0, 1), valid=valid)
    first, second = (found.depth.flatten(0, 1)[:, None] for found in (made, hint))
    # The smallest corrections and the worst would have no gradient.
    length = corrected_depth(known, first, second, valid=valid, certain=0.0, most=FAR)
    mask = (known > 0).unflatten(0, shape)
    color, length = color.unflatten(0, shape), length.unflatten(0, shape)
    return torch.where(mask, color, rgb), torch.where(mask[:, :, 0], length[:, :, 0], depth)
