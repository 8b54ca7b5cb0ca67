"""Scaled dot-product attention without the matrix of scores."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

# CUDA's fused kernels ask for heads of a multiple of this size; others would get N x M scores.
FUSED_MULTIPLE = 8


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """softmax(q kᵀ / sqrt(d)) v, in torch's fused kernels, whose memory is linear in N and M.

    On CUDA, torch takes flash attention in half precision (compute capability 8.0 and later, heads
    of up to 256 channels) and its memory-efficient kernel otherwise (float32; float16 on older
    cards), which asks for heads of a multiple of 8 channels, 4 in float32, adjacent in memory. The
    heads here are of 48 and 128 (denoisers), 64 (encoder) and 72 (RGB head), without a mask, so
    N x M scores are never built; they would be in float64, and in bfloat16 on older cards.

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
    size = q.shape[-1]
    lacking = -size % FUSED_MULTIPLE
    if not lacking or q.device.type != "cuda":
        return F.scaled_dot_product_attention(q, k, v)
    # Zeros add nothing to the scores; the scale stays that of the true head.
    q, k, v = (F.pad(tensor, (0, lacking)) for tensor in (q, k, v))
    return F.scaled_dot_product_attention(q, k, v, scale=size**-0.5)[..., :size]
