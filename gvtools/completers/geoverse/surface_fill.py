"""Projections with their holes filled along surfaces, for the encoder to see.

The classical completer's planes and photographs where the memory supports them, averages elsewhere:
what a denoiser then has to add is what these do not know. A departure from the paper, whose holes
are black (``hints.fill``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.completers.base import ContextView
from gvtools.completers.geoverse.fill import push_pull, push_pull_depth
from gvtools.completers.inpaint import InpaintCompleter
from gvtools.guidance import Guidance

Float32 = NDArray[np.float32]


def surface_fill(context: Sequence[ContextView], guidance: Guidance) -> tuple[Float32, Float32]:
    """Colour (V, H, W, 3) and depth (V, H, W), memory's pixels unchanged.

    A view without a valid pixel keeps its zeros.

    Args:
        context: photographs to look hole points up in.
        guidance: the projections.
    """
    made = InpaintCompleter().complete(context, guidance)
    rgb, depth = made.rgb.copy(), made.depth.copy()
    holes = ~(depth > 0) & guidance.valid.any(axis=(1, 2), keepdims=True)
    for index in np.flatnonzero(holes.any(axis=(1, 2))):
        known = torch.from_numpy(depth[index] > 0)[None, None]
        color = torch.from_numpy(rgb[index]).permute(2, 0, 1)[None]
        lengths = torch.from_numpy(depth[index])[None, None]
        averaged = push_pull(color, known)[0].permute(1, 2, 0).numpy()
        rgb[index][holes[index]] = averaged[holes[index]]
        depth[index][holes[index]] = push_pull_depth(lengths, known)[0, 0].numpy()[holes[index]]
    return rgb, depth
