"""The model's colours in the memory's exposure: a smooth offset, exact where the memory knows.

The counterpart for colour of the depth's ``field`` alignment (``depth_scale.py``): what a small
network decodes is off by a little all over, and a hole's fill then shows its rim. The difference
to the memory's own pixels is continued through the holes and added.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gvtools.completers.geoverse.fill import push_pull

COLOR_ALIGNMENTS = ("none", "field")


def aligned_color(rgb: Tensor, hint: Tensor, valid: Tensor) -> Tensor:
    """Pictures with the push-pull of ``hint - rgb`` over valid pixels added, in [0, 1].

    Args:
        rgb: (T, 3, H, W) of the model; a pixel that is not finite stays so.
        hint: (T, 3, H, W) the memory's colour.
        valid: (T, 1, H, W) where it is known.
    """
    known = valid & torch.isfinite(rgb).all(1, keepdim=True)
    offset = push_pull(torch.where(known, hint - rgb, 0.0), known)
    return (rgb + offset).clamp(0, 1)
