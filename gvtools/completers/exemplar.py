"""The classical completer that copies texture: coherent patches of compatible depth.

Depth is filled as ``inpaint`` fills it, and pixels that a photograph shows are taken from there.
What is left is synthesised coarse to fine from patches of the guidance and of the photographs
(``patchmatch``), starting from the diffused colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Float64
from gvtools.completers.base import Completion, ContextView
from gvtools.completers.context_color import rank_views
from gvtools.completers.hole_color import fill_color
from gvtools.completers.inpaint import EVIDENCE_WEIGHT, Hole, InpaintCompleter, complete_views
from gvtools.completers.patchmatch import RADIUS, search, vote
from gvtools.guidance import Guidance

# A source patch may span this share of inverse depth: more is a depth edge.
SOURCE_SPAN = 0.1
# Photographs that weigh at least this much fix a pixel's colour before the synthesis.
FIXED_EVIDENCE = 0.5 * EVIDENCE_WEIGHT
# Synthesised pixels count less by this factor for each pixel from the rim, down to the floor, so
# that texture grows inward from what is known.
FADE, FADE_FLOOR = 0.8, 0.02


@dataclass(frozen=True)
class ExemplarCompleter(InpaintCompleter):
    """Fills depth as ``inpaint`` does, and colour by copying coherent patches.

    Attributes:
        source_views: photographs to copy patches from, beside the view itself.
        levels: resolutions, each half the one before.
        iterations: rounds of matching and voting at each level; the finest gets one fewer.
    """

    name: ClassVar[str] = "exemplar"
    costly: ClassVar[bool] = True

    source_views: int = 1
    levels: int = 4
    iterations: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check("source_views", least=0)
        self._check("levels", least=1)
        self._check("iterations", least=1)

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Fill the holes of all views; see ``Completer.complete``."""

        def color(
            rgb: NDArray[np.float32], known: NDArray[np.bool_], hole: Hole
        ) -> NDArray[np.float32]:
            smooth = fill_color(
                rgb, known, hole.surface, evidence=hole.evidence, sweeps=self.sweeps
            )
            # A view's randomness depends on the seed and its row alone, not on the other views.
            rng = np.random.default_rng((seed, hole.index))
            return self._synthesise(smooth, known, hole, context, rng)

        return complete_views(context, guidance, self, color)

    def _synthesise(
        self,
        smooth: NDArray[np.float32],
        known: NDArray[np.bool_],
        hole: Hole,
        context: Sequence[ContextView],
        rng: np.random.Generator,
    ) -> NDArray[np.float32]:
        inverse = hole.surface.inverse
        fixed = known | (hole.evidence[1] >= FIXED_EVIDENCE)
        depth = np.zeros(inverse.shape, np.float32)
        depth[inverse > 0] = 1 / inverse[inverse > 0]
        ranked = rank_views(hole.camera, depth, hole.error, holes=~fixed, context=context)
        views = ranked[: self.source_views]
        sources = [(smooth, np.where(fixed, inverse, 0.0), fixed)]
        sources += [_as_source(context[i], hole) for i in views]
        pyramid = [_Level(smooth.astype(np.float32), inverse, fixed, sources)]
        while len(pyramid) < self.levels and min(pyramid[-1].inverse.shape) >= 16 * RADIUS:
            pyramid.append(pyramid[-1].halved())
        state = rng.integers(1, 2**63, 1).astype(np.uint64)
        field: NDArray[np.int32] | None = None
        coarser: _Level | None = None
        for index in reversed(range(len(pyramid))):
            level = pyramid[index]
            # Small holes vanish in coarse levels; a level may also have nothing to copy from.
            if not len(level.choices) or not len(level.domain):
                continue
            field = level.start(field, coarser, rng)
            turns = self.iterations - (index == 0)
            for turn in range(max(turns, 1)):
                cost = level.search(field, state, passes=2)
                # Late votes are sharp: the last one nearly copies.
                level.rgb = level.vote(field, cost, sharpness=0.004 / (1 + turn + 2 * (index == 0)))
            coarser = level
        return np.clip(pyramid[0].rgb, 0, 1)


Source = tuple[NDArray[np.float32], Float64, NDArray[np.bool_]]


def _as_source(view: ContextView, hole: Hole) -> Source:
    """A photograph resampled to the target's focal length: rgb, inverse depth, usable pixels."""
    factor = float(hole.camera.K[0, 0, 0] / view.camera.K[0, 0, 0])
    rgb = np.asarray(view.rgb, np.float32)
    depth = np.zeros(rgb.shape[:2], np.float32) if view.depth is None else view.depth
    if abs(factor - 1) > 0.02:
        rows = ((np.arange(int(rgb.shape[0] * factor)) + 0.5) / factor).astype(np.int64)
        columns = ((np.arange(int(rgb.shape[1] * factor)) + 0.5) / factor).astype(np.int64)
        rgb, depth = rgb[np.ix_(rows, columns)], depth[np.ix_(rows, columns)]
    inverse = np.zeros(depth.shape)
    known = np.isfinite(depth) & (depth > 0)
    inverse[known] = 1.0 / depth[known]
    # Without any depth, every pixel may be copied; with some, only those that have it.
    usable = known if known.any() else np.ones(depth.shape, bool)
    return rgb, inverse, usable


class _Level:
    """One resolution of the synthesis: the estimate, and the sources as one padded stack."""

    def __init__(
        self,
        rgb: NDArray[np.float32],
        inverse: Float64,
        known: NDArray[np.bool_],
        sources: Sequence[Source],
    ) -> None:
        from scipy.ndimage import (
            binary_dilation,
            binary_erosion,
            distance_transform_edt,
            maximum_filter,
            minimum_filter,
        )

        self.rgb, self.inverse, self.known, self.parts = rgb, inverse, known, list(sources)
        size = 2 * RADIUS + 1
        shape = tuple(max(part[1].shape[axis] for part in sources) for axis in (0, 1))
        self.sources = np.zeros((len(sources), *shape, 3), np.float32)
        self.depths = np.zeros((len(sources), *shape))
        self.eligible = np.zeros((len(sources), *shape), bool)
        for row, (color, far, usable) in enumerate(sources):
            window = (row, slice(0, color.shape[0]), slice(0, color.shape[1]))
            self.sources[window] = color
            self.depths[window] = far
            flat = maximum_filter(far, size) - minimum_filter(far, size) <= SOURCE_SPAN * far
            whole = binary_erosion(usable, np.ones((size, size)))
            self.eligible[window] = flat & whole
        distance = distance_transform_edt(~known) if known.any() else np.zeros(known.shape)
        self.certainty = np.maximum(FADE**distance, FADE_FLOOR)
        self.choices = np.flatnonzero(self.eligible)
        unknown = ~known & (inverse > 0)
        reach = binary_dilation(unknown, np.ones((size, size))) & (inverse > 0)
        self.domain = np.flatnonzero(reach)
        self.row_of = np.full(inverse.shape, -1, np.int32)
        self.row_of.ravel()[self.domain] = np.arange(len(self.domain), dtype=np.int32)

    def halved(self) -> _Level:
        """The level at half the resolution."""
        rgb, inverse, known = _halve(self.rgb, self.inverse, self.known)
        return _Level(rgb, inverse, known, [_halve(*part) for part in self.parts])

    def start(
        self, field: NDArray[np.int32] | None, coarser: _Level | None, rng: np.random.Generator
    ) -> NDArray[np.int32]:
        """The field of the coarser level at twice the resolution, or random."""
        picks = self.choices[rng.integers(0, len(self.choices), len(self.domain))]
        fresh = np.stack(np.unravel_index(picks, self.eligible.shape), axis=1).astype(np.int32)
        if field is None or coarser is None:
            return fresh
        y, x = np.divmod(self.domain, self.inverse.shape[1])
        tall, wide = coarser.inverse.shape
        rows = coarser.row_of[np.minimum(y // 2, tall - 1), np.minimum(x // 2, wide - 1)]
        finer = field[rows].copy()
        finer[:, 1] = 2 * finer[:, 1] + y % 2
        finer[:, 2] = 2 * finer[:, 2] + x % 2
        inside = (finer[:, 1] < self.eligible.shape[1]) & (finer[:, 2] < self.eligible.shape[2])
        take = (rows >= 0) & inside
        fresh[take] = finer[take]
        return fresh

    def search(
        self, field: NDArray[np.int32], state: NDArray[np.uint64], *, passes: int
    ) -> Float64:
        """Improve the field in place; the cost of each domain pixel."""
        return np.asarray(
            search(
                self.rgb, self.inverse, self.certainty, self.sources, self.depths, self.eligible,
                self.choices, self.domain, self.row_of, field, state, passes,
            )
        )  # fmt: skip

    def vote(
        self, field: NDArray[np.int32], cost: Float64, *, sharpness: float
    ) -> NDArray[np.float32]:
        """The unknown pixels rebuilt from the field."""
        return np.asarray(
            vote(self.rgb, self.inverse, self.certainty, self.sources, self.domain, self.row_of,
                 field, cost, sharpness)
        )  # fmt: skip


def _halve(
    rgb: NDArray[np.float32], inverse: Float64, known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], Float64, NDArray[np.bool_]]:
    """2x2 means over the pixels that count (the known ones where there are any)."""
    tall, wide = (size // 2 * 2 for size in inverse.shape)

    def blocks(image: NDArray) -> NDArray:
        shape = (tall // 2, 2, wide // 2, 2, *image.shape[2:])
        return image[:tall, :wide].reshape(shape).swapaxes(1, 2)

    keep = blocks(known)
    some = keep.any(axis=(2, 3), keepdims=True)
    filled = blocks(inverse) > 0
    weight = np.where(some, keep & filled, filled).astype(np.float64)
    total = np.maximum(weight.sum(axis=(2, 3)), 1e-12)
    color = (blocks(rgb) * weight[..., None]).sum(axis=(2, 3)) / total[..., None]
    plain = blocks(rgb).mean(axis=(2, 3))
    depth = (blocks(inverse) * weight).sum(axis=(2, 3)) / total
    empty = weight.sum(axis=(2, 3)) == 0
    color[empty] = plain[empty]
    return color.astype(np.float32), depth, keep.sum(axis=(2, 3)) >= 2
