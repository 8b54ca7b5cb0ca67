"""Scaled dot-product attention without the matrix of scores."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from gvtools.networks.precision import has_bfloat16
from gvtools.networks.recompute import recomputed

# CUDA's fused kernels ask for heads of a multiple of this size; others would get N x M scores.
FUSED_MULTIPLE = 8
# Scores that may exist at once where no fused kernel applies: 256 MB in float32.
MOST_SCORES = 2**26


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """softmax(q kᵀ / sqrt(d)) v, in torch's fused kernels, whose memory is linear in N and M.

    On CUDA, torch takes flash attention in half precision (compute capability 8.0 and later, heads
    of up to 256 channels) and its memory-efficient kernel otherwise (float32; float16 on older
    cards), which asks for heads of a multiple of 8 channels, 4 in float32, adjacent in memory. The
    heads here are of 48 and 128 (denoisers), 64 (encoder) and 72 (RGB head), without a mask. No
    fused kernel takes float64, or bfloat16 on older cards: these go by chunks of queries, each
    computed again in the backward pass.

    On a CPU the fused kernel is also the faster one: in float32 it takes a third to four fifths of
    the time of the two products around a softmax from about 100 tokens on, and never longer by
    more than a fraction of a millisecond; in bfloat16 the products may win, but round the scores.

    Args:
        q: (B, heads, N, d).
        k: (B, heads, M, d).
        v: (B, heads, M, d), the dtype of ``q`` and ``k``.

    Returns:
        (B, heads, N, d).
    """
    if not _is_fused(q):
        return _in_chunks(q, k, v)
    size = q.shape[-1]
    lacking = -size % FUSED_MULTIPLE
    if not lacking or q.device.type != "cuda":
        return F.scaled_dot_product_attention(q, k, v)
    # Zeros add nothing to the scores; the scale stays that of the true head.
    q, k, v = (F.pad(tensor, (0, lacking)) for tensor in (q, k, v))
    return F.scaled_dot_product_attention(q, k, v, scale=size**-0.5)[..., :size]


def _is_fused(q: Tensor) -> bool:
    """Whether torch has a fused kernel for queries of this type on their device."""
    if q.device.type == "cpu":
        return True
    # Autocast leaves float64 as it is.
    if q.device.type != "cuda" or q.dtype == torch.float64:
        return False
    dtype = q.dtype
    if torch.is_autocast_enabled(q.device.type):
        dtype = torch.get_autocast_dtype(q.device.type)
    return dtype != torch.bfloat16 or has_bfloat16(q.device)


def _in_chunks(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """The same, for as many queries at a time as ``MOST_SCORES`` allows."""
    rows = max(1, MOST_SCORES // (q.shape[0] * q.shape[1] * k.shape[2]))
    parts = [
        recomputed(F.scaled_dot_product_attention, part, k, v) for part in q.split(rows, dim=2)
    ]
    return torch.cat(parts, dim=2)
