"""How much effort a view's completion is worth, by the size of its holes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gvtools.completers.base import (
    Completer,
    Completion,
    ContextView,
    create,
)
from gvtools.completers.holes import hole_radius
from gvtools.completers.scale_alignment import ScaleAlignment
from gvtools.guidance import Guidance
from gvtools.settings import Settings


class EffortPolicy(Settings):
    """Less effort for small holes: what stands around them says nearly everything about them."""

    section = "effort"

    inpaint_below: float = Field(0.02, ge=0)
    """Views whose holes have at most this radius, as a share of the image diagonal (see
    ``hole_radius``), are left to ``inpaint`` by a costly completer (geoverse); 0 leaves it none."""

    def applied(self, completer: Completer) -> Completer:
        """``completer`` under this policy."""
        if self.inpaint_below > 0 and completer.costly:
            return SmallHolesInpainted(completer, self.inpaint_below)
        return completer


class SmallHolesInpainted(Completer):
    """Leaves views with small holes to a cheap completer and the others to a costly one.

    Attributes:
        costly_one: completes the other views; its name, files and notes stand for both.
        below: greatest ``hole_radius`` of a view that the cheap one completes.
        cheap_one: ``inpaint``, unless another is given.
    """

    def __init__(self, costly_one: Completer, below: float, *, cheap_one: Completer | None = None):
        super().__init__()
        self.costly_one, self.below = costly_one, below
        self.cheap_one = cheap_one or create("inpaint")
        self.name = costly_one.name
        self.batches_targets = costly_one.batches_targets

    @property
    def files(self) -> tuple[Path, ...]:
        """The costly one's."""
        return self.costly_one.files

    @property
    def notes(self) -> tuple[str, ...]:
        """The costly one's."""
        return self.costly_one.notes

    @property
    def weights(self) -> Path | None:
        """The costly one's."""
        return self.costly_one.weights

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Complete all views, each by one of the two; see ``Completer.complete``."""
        small = [hole_radius(valid) <= self.below for valid in guidance.valid]
        parts = []
        for completer, cheap in ((self.cheap_one, True), (self.costly_one, False)):
            rows = [row for row, is_small in enumerate(small) if is_small == cheap]
            if rows:
                completion = completer.complete(context, guidance.select(rows), seed=seed)
                parts.append((rows, completion))
        return _merged(guidance, parts)


def _merged(guidance: Guidance, parts: Sequence[tuple[Sequence[int], Completion]]) -> Completion:
    """The completions of some rows each, as one of all rows."""
    shape = guidance.valid.shape
    rgb, depth = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    confidence = np.zeros(shape, np.float32)
    rays: NDArray[np.float32] | None = None
    if any(part.rays is not None for _, part in parts):
        every = [guidance.cameras.plucker(row) for row in range(len(guidance))]
        rays = np.stack(every).astype(np.float32)
    alignments: list[ScaleAlignment | None] = [None] * len(guidance)
    for rows, part in parts:
        at = list(rows)
        rgb[at], depth[at], confidence[at] = part.rgb, part.depth, part.confidence
        if rays is not None and part.rays is not None:
            rays[at] = part.rays
        for row, alignment in zip(at, part.scale_alignment or [None] * len(at), strict=True):
            alignments[row] = alignment
    unaligned = all(alignment is None for alignment in alignments)
    # A view that kept what the memory shows is not whole, so the others may not be taken so either.
    whole = all(part.whole for _, part in parts)
    return Completion(rgb, depth, confidence, rays, None if unaligned else tuple(alignments), whole)
