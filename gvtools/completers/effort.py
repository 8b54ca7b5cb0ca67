"""A costly completer for views with large holes, a cheap one for those whose holes are small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.completers.base import Completer, Completion, ContextView, create
from gvtools.completers.holes import hole_reach
from gvtools.guidance import Guidance


@dataclass
class SparingCompleter:
    """Gives views whose holes all reach no farther than ``minor`` to ``cheap``.

    Where a hole is narrow, what stands around it says nearly everything about it, and a generative
    model adds little but time.

    Attributes:
        costly: completes the other views.
        minor: the greatest ``hole_reach`` of a view that is spared.
        cheap: completes the views that are spared.
        name: the costly one's.
        joint: the costly one's.
    """

    costly: Completer
    minor: float
    cheap: Completer = field(default_factory=lambda: create("inpaint"))

    def __post_init__(self) -> None:
        self.name = self.costly.name
        self.joint = bool(getattr(self.costly, "joint", False))

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Complete all views, each by one of the two; see ``Completer.complete``.

        ``spent["spared_views"]`` counts the cheap one's.
        """
        spared = [
            row for row in range(len(guidance)) if hole_reach(guidance.valid[row]) <= self.minor
        ]
        others = [row for row in range(len(guidance)) if row not in spared]
        parts = []
        for completer, rows in ((self.cheap, spared), (self.costly, others)):
            if rows:
                made = completer.complete(context, guidance.select(rows), seed=seed)
                parts.append((rows, made))
        return _merged(guidance, parts, len(spared))


def sparing(
    completer: Completer,
    minor: float,
    *,
    one_step: float = 0.0,
    half_size: float = 0.0,
    no_prior: float = 0.0,
    near_holes: bool = False,
) -> Completer:
    """``completer``, spared what small holes do not need, where it is costly.

    Args:
        completer: any.
        minor: views whose holes reach no farther are left to ``inpaint``; 0 leaves it none.
        one_step: passes whose holes reach no farther take one step, where the completer makes
            several; 0 leaves them all.
        half_size: passes whose holes reach no farther are made in pictures of half the size, where
            the completer has a size of its own; 0 leaves them all.
        no_prior: passes whose holes reach no farther are made without the video prior, where the
            completer has one; 0 leaves it to all.
        near_holes: steps after the first look at what lies near holes alone, where the completer
            can.
    """
    wanted = {
        "one_step_holes": one_step,
        "half_size_holes": half_size,
        "no_prior_holes": no_prior,
        "near_holes": near_holes,
    }
    for name, value in wanted.items():
        # What the completer was told itself stands, a 0 as well.
        if value and is_dataclass(completer) and getattr(completer, name, 0) is None:
            completer = replace(completer, **{name: value})
    if minor > 0 and getattr(completer, "costly", False):
        return SparingCompleter(completer, minor)
    return completer


def _merged(
    guidance: Guidance, parts: Sequence[tuple[Sequence[int], Completion]], spared: int
) -> Completion:
    """The completions of some rows each, as one of all rows."""
    shape = guidance.valid.shape
    rgb, depth = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    confidence = np.zeros(shape, np.float32)
    rays: NDArray[np.float32] | None = None
    if any(made.rays is not None for _, made in parts):
        every = [guidance.cameras.plucker(row) for row in range(len(guidance))]
        rays = np.stack(every).astype(np.float32)
    support: list[str | None] = [None] * len(guidance)
    spent: dict[str, Any] = {"spared_views": float(spared)}
    for rows, made in parts:
        at = list(rows)
        rgb[at], depth[at], confidence[at] = made.rgb, made.depth, made.confidence
        if rays is not None and made.rays is not None:
            rays[at] = made.rays
        for place, row in enumerate(at):
            support[row] = None if made.support is None else made.support[place]
        for key, value in made.spent.items():
            spent[key] = spent.get(key, 0.0) + value
    told = None if all(said is None for said in support) else tuple(support)
    return Completion(rgb, depth, confidence, rays, spent, told)
