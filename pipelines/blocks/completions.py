"""Completions that blocks made, taken over where the merged memory knows nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gvtools.completers.base import Completer, Completion, ContextView, ScaleAlignment, ScaleStatus
from gvtools.errors import ProjectError
from gvtools.guidance import Guidance
from gvtools.runs.run import RunTarget

# Confidence of what a block generated, where its run did not keep it.
UNKNOWN = np.float32(0.5)


class BlockCompletions(Completer):
    """Fills holes with what the runs of blocks put there; what the memory shows stays.

    Args:
        targets: of the blocks' runs, by their name in the merged run.
    """

    name = "blocks"

    def __init__(self, targets: Mapping[str, RunTarget]) -> None:
        super().__init__()
        self.targets = targets

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """The completion of one target; see ``Completer.complete``."""
        name = guidance.cameras.names[0]
        target = self.targets[name]
        files = target.read()
        valid = guidance.valid[0]
        if files.depth.shape != valid.shape:
            raise ProjectError(
                f"{target.folder}: the target {target.name} has {files.depth.shape} pixels; "
                f"expected {valid.shape}; reconstruct the block again"
            )
        scale = target.report["scale"]
        alignment = ScaleAlignment(ScaleStatus(scale["status"]), overlap_px=scale["overlap_px"])
        made = ~valid & (files.depth > 0) & alignment.accepted
        confidence = np.full(valid.shape, UNKNOWN) if files.confidence is None else files.confidence
        known = np.where(valid, guidance.confidence[0], np.float32(0))
        picture = files.picture.astype(np.float32) / np.float32(255)
        rgb = np.where(valid[..., None], guidance.rgb[0], picture)
        depth = np.where(made, files.depth, np.where(valid, guidance.depth[0], np.float32(0)))
        return Completion(
            rgb[None],
            depth[None].astype(np.float32),
            np.where(made, confidence, known)[None].astype(np.float32),
            scale_alignment=(alignment,),
        )
