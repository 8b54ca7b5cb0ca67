"""Projections with their holes filled along surfaces, for the encoder to see.

The classical completer's planes and photographs where the memory supports them, averages elsewhere:
what a denoiser then has to add is what these do not know. A departure from the paper, whose holes
are black (``hints.fill``).

Targets that are completed together may share their fills: what one view is much surer of, because
it lies at the rim of a hole there, is carried to the views for which it lies deep inside one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.completers.base import Completion, ContextView
from gvtools.completers.inpaint import InpaintCompleter
from gvtools.completers.push_pull import Filled, push_pull, push_pull_depth
from gvtools.guidance import Guidance
from gvtools.memory.spatial_memory import SpatialMemory

# Confidence of what is averaged: below that of any plane worth fusing.
AVERAGED = 0.005
# Fills less confident than this are not carried to other views.
CARRIED = 0.02
# What is carried replaces a view's own fill where it is so many times as confident. A fill that is
# carried wrongly spoils planes that were continued rightly, so it must be far better.
SURER = 10.0


def surface_fill(
    context: Sequence[ContextView], guidance: Guidance, *, shared: bool = False
) -> Filled:
    """Colour, depth and confidence of all pixels, memory's pixels unchanged.

    A view without a valid pixel keeps its zeros, unless something is carried there: ``shared``
    carries fills from view to view, whatever their order.
    """
    completion, looked_up = InpaintCompleter().fill(context, guidance)
    known = guidance.valid
    if shared and len(guidance) > 1:
        known = _share_fills(context, guidance, completion, looked_up=looked_up)
    rgb, depth, confidence = completion.rgb, completion.depth, completion.confidence
    holes = ~(depth > 0) & known.any(axis=(1, 2), keepdims=True)
    for index in np.flatnonzero(holes.any(axis=(1, 2))):
        hole = holes[index]
        filled = torch.from_numpy(depth[index] > 0)[None, None]
        color = torch.from_numpy(rgb[index]).permute(2, 0, 1)[None]
        lengths = torch.from_numpy(depth[index])[None, None]
        averaged = push_pull(color, filled)[0].permute(1, 2, 0).numpy()
        rgb[index][hole] = averaged[hole]
        depth[index][hole] = push_pull_depth(lengths, filled)[0, 0].numpy()[hole]
        confidence[index][hole] = AVERAGED
    return Filled(rgb, depth, confidence, looked_up)


def _share_fills(
    context: Sequence[ContextView],
    guidance: Guidance,
    completion: Completion,
    *,
    looked_up: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """(V, H, W) where memory or another view's fill knows, the best known view being filled first.

    ``completion`` and ``looked_up`` are written into.
    """
    known = guidance.valid.copy()
    memory: SpatialMemory | None = None
    best_first = np.argsort(-known.mean(axis=(1, 2)), kind="stable")
    order = [int(index) for index in best_first if not known[index].all()]
    for index in order:
        view = guidance[index]
        if memory is not None:
            carried = memory.project(view.cameras)
            surer = ~view.valid & carried.valid
            surer &= carried.confidence > SURER * completion.confidence[index]
            if surer.any():
                # It knows what is carried there, too.
                view = replace(
                    view,
                    rgb=np.where(surer[..., None], carried.rgb, view.rgb),
                    depth=np.where(surer, carried.depth, view.depth),
                    valid=view.valid | surer,
                    confidence=np.where(surer, carried.confidence, view.confidence),
                )
                again, weight = InpaintCompleter().fill(context, view)
                completion.rgb[index], completion.depth[index] = again.rgb[0], again.depth[0]
                completion.confidence[index], looked_up[index] = again.confidence[0], weight[0]
                known[index] = view.valid[0]
        if index != order[-1]:
            memory = _lift(memory, view, completion, index=index)
    return known


def _lift(
    memory: SpatialMemory | None, view: Guidance, completion: Completion, *, index: int
) -> SpatialMemory | None:
    """The memory of the fills, with what this view filled itself."""
    confidence = completion.confidence[index]
    own = ~view.valid[0] & (confidence >= CARRIED)
    if not own.any():
        return memory
    if memory is None:
        # Voxels of a pixel's edge at the median depth.
        depth, K = completion.depth[index], view.cameras.K[0]
        focal = float(np.sqrt(K[0, 0] * K[1, 1]))
        voxel = float(np.median(depth[depth > 0])) / focal
        memory = SpatialMemory(voxel, origin=view.cameras.centers[0])
    memory.observe(
        np.rint(np.clip(completion.rgb[index], 0, 1) * 255).astype(np.uint8),
        completion.depth[index],
        view.cameras,
        round=1,
        generated=True,
        # Unused outside the mask, where it must still be positive.
        confidence=np.where(own, confidence, np.float32(1)),
        mask=own,
    )
    return memory
