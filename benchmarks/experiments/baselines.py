"""Baselines that a learned completer has to beat: a shrunk fill, and a fitted blend of fills.

Both take depth from ``inpaint``. Far from what is known a fill is a guess, and the mean of the
known colours errs less. The shrink says so with one number; the blend learns from some scenes how
far each of several fills is to be trusted at each distance.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from benchmarks.experiments.cases import Case
from benchmarks.experiments.classical import push_pulled
from gvtools.completers.base import Completer, Completion, ContextView, create
from gvtools.completers.hole_depth import rim_distance
from gvtools.errors import OptionError
from gvtools.guidance import Guidance

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
# Lengths are shares of the picture's diagonal. Distance at which 37 % of a colour's difference from
# the mean is left: the best of 0.02 to 0.8 for the view means of procedural rooms of other seeds.
SHRINK_LENGTH = 0.4
# Between these distances the blend's weights are interpolated, in the logarithm of the distance.
DISTANCES = (0.005, 0.015, 0.04, 0.1, 0.2, 0.4, 0.8)
FILLS = ("inpaint", "push-pull", "blurred inpaint")
BLUR = 0.03
# Ridge penalty, in shares of the fitted pixels, towards plain inpaint.
RIDGE = 1e-3
# A view with fewer known pixels has no mean colour of its own.
FEWEST = 64
# Squared error below which a view's errors are no longer counted up.
LEAST_ERROR = 1e-4


class ChangedInpaint(Completer, ABC):
    """``inpaint``, the colours of its holes changed view by view; its depth stays."""

    def __init__(self) -> None:
        super().__init__()
        self._inpaint = create("inpaint")

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Fill all views; see ``Completer.complete``. Nothing here is random."""
        made = self._inpaint.complete(context, guidance, seed=seed)
        rgb = made.rgb.copy()
        for index, valid in enumerate(guidance.valid):
            if not valid.all():
                mean = _mean_color(guidance.rgb[index], valid, context)
                rgb[index][~valid] = self.changed(rgb[index], valid, mean)
        return replace(made, rgb=rgb)

    @abstractmethod
    def changed(self, rgb: Float32, valid: NDArray[np.bool_], mean: Float32) -> Float32:
        """(holes, 3) colours of a view's holes.

        Args:
            rgb: (H, W, 3) what ``inpaint`` made, 0 to 1.
            valid: (H, W) what is known.
            mean: (3,) mean of the known colours.
        """


class ShrunkInpaint(ChangedInpaint):
    """``inpaint``, its colours drawn towards the mean known colour with distance from the rim."""

    name = "shrunk inpaint"

    def changed(self, rgb: Float32, valid: NDArray[np.bool_], mean: Float32) -> Float32:
        """See ``ChangedInpaint``."""
        kept = np.exp(-_rim_share(valid)[~valid] / SHRINK_LENGTH)[:, None]
        return mean + kept * (rgb[~valid] - mean)


class BlendCompleter(ChangedInpaint):
    """A sum of fills' differences from the mean known colour, weighted by distance.

    Attributes:
        shares: (fills, distances), see ``fit_blend``.
    """

    name = "blend of fills"

    def __init__(self, shares: Float64) -> None:
        super().__init__()
        self.shares = shares

    def changed(self, rgb: Float32, valid: NDArray[np.bool_], mean: Float32) -> Float32:
        """See ``ChangedInpaint``."""
        if not valid.any():
            return np.broadcast_to(mean, rgb.shape)[~valid]
        terms = _terms(rgb, valid, mean)
        return np.clip(mean + np.tensordot(self.shares.ravel(), terms, 1), 0, 1)


def fit_blend(cases: Iterable[Case]) -> Float64:
    """Ridge regression of the true colours of the cases' hole pixels.

    A view's pixels count by the inverse of their number and of the error of ``inpaint`` there, so
    that to first order the mean over views of PSNR is what is maximised.

    Args:
        cases: other scenes than those to be judged.

    Returns:
        (fills, distances) weights of ``BlendCompleter``.

    Raises:
        OptionError: nothing to fit to.
    """
    inpaint = create("inpaint")
    size = len(FILLS) * len(DISTANCES)
    prior = np.zeros((len(FILLS), len(DISTANCES)))
    prior[0] = 1
    normal, right, views = np.zeros((size, size)), np.zeros(size), 0
    for case in cases:
        made = inpaint.complete(case.context, case.guidance)
        for index, valid in enumerate(case.guidance.valid):
            holes = ~valid
            if holes.sum() < FEWEST or valid.sum() < FEWEST:
                continue
            mean = _mean_color(case.guidance.rgb[index], valid, case.context)
            terms = _terms(made.rgb[index], valid, mean).reshape(size, -1)
            # What plain inpaint leaves is fitted, so that the penalty draws towards it.
            left = (case.rgb[index][holes] - made.rgb[index][holes]).astype(np.float64).ravel()
            weight = 1 / (left.size * max(float(np.square(left).mean()), LEAST_ERROR))
            normal += weight * terms @ terms.T
            right += weight * terms @ left
            views += 1
    if not views:
        raise OptionError("blend of fills: no view with a hole to fit to; give more scenes")
    normal += RIDGE * np.trace(normal) / size * np.eye(size)
    return prior + np.linalg.solve(normal, right).reshape(prior.shape)


def _terms(filled: Float32, valid: NDArray[np.bool_], mean: Float32) -> Float64:
    """(fills * distances, holes, 3): differences from the mean, by fill and distance."""
    holes = ~valid
    blurred = np.stack(
        [gaussian_filter(filled[..., c], BLUR * np.hypot(*valid.shape)) for c in range(3)], -1
    )
    pulled = push_pulled(np.where(valid[..., None], filled, np.float32(0)), valid)
    apart = np.stack([fill[holes] - mean for fill in (filled, pulled, blurred)])
    near = _hats(_rim_share(valid)[holes])
    return (apart[:, None].astype(np.float64) * near[None, :, :, None]).reshape(
        -1, int(holes.sum()), 3
    )


def _hats(distance: Float64) -> Float64:
    """(distances, N) shares of the neighbouring ``DISTANCES``, which add up to 1."""
    nodes = np.log(DISTANCES)
    place = np.interp(np.log(np.maximum(distance, 1e-9)), nodes, np.arange(len(nodes)))
    return np.maximum(0, 1 - np.abs(place[None] - np.arange(len(nodes))[:, None]))


def _rim_share(valid: NDArray[np.bool_]) -> Float64:
    """(H, W) distances to the nearest known pixel, in shares of the diagonal."""
    return rim_distance(valid) / float(np.hypot(*valid.shape))


def _mean_color(rgb: Float32, valid: NDArray[np.bool_], context: Sequence[ContextView]) -> Float32:
    """(3,) of what is known of a view; of the photographs where that is next to nothing."""
    if valid.sum() >= FEWEST or not context:
        return rgb[valid].mean(0) if valid.any() else np.full(3, 0.5, np.float32)
    return np.mean([view.rgb.mean((0, 1)) for view in context], axis=0).astype(np.float32)
