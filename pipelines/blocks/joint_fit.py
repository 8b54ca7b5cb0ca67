"""Joined Gaussians, fitted further where blocks meet.

A block's Gaussians were fitted together with those behind its faces, which a merge leaves out and
replaces by another block's. The views that help other blocks see across faces: a short fit to them
brings both sides together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from gvtools.appearance.fit_options import FitOptions
from gvtools.appearance.gaussians import Gaussians
from gvtools.view_selection import evenly_spread
from pipelines.blocks.appearance import scale_colors
from pipelines.blocks.block import SceneBlock
from pipelines.reconstruction.fitting import Fitted, fit_appearance

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan

# Of the time, or the steps, that a run would fit to these views for.
SHARE = 0.5
# Photographs that are read at once where no steps are given.
MOST_VIEWS = 1200


def rows_across(context: Sequence[str], blocks: Sequence[SceneBlock]) -> list[int]:
    """Rows of the context views that help another block than their own."""
    helping = {name for block in blocks for name in block.helpers}
    return [row for row, name in enumerate(context) if name in helping]


def fit_across(
    plan: Plan, joined: Fitted, blocks: Sequence[SceneBlock], *, console: Console
) -> Fitted:
    """Joined Gaussians, fitted further to the views that see across faces; poses stay.

    Only these views are read, no more than there are steps: all of a large project's may not fit
    into memory.

    Args:
        plan: of the merged run, at the blocks' poses.
        joined: the blocks' Gaussians; its exposures are of the plan's context, in this order.
        blocks: all of the split.
        console: where progress goes.
    """
    rows, whole = rows_across(plan.context, blocks), joined.appearance
    if not rows or whole.exposures is None:
        return joined
    options = _options(plan.config.refine, fits=len(whole.fits))
    rows = list(evenly_spread(rows, options.steps or MOST_VIEWS))
    console.line(f"fitting: {len(rows)} of {len(plan.context)} views see across blocks")
    some = replace(
        plan,
        context=tuple(plan.context[row] for row in rows),
        config=plan.config.replaced(refine=options),
    )
    # The gains of a fit's photographs have mean zero: what these lack, the Gaussians take on.
    given = whole.exposures.log_gains
    level = given[rows].mean(axis=0)
    exposures = replace(
        whole.exposures, poses=whole.exposures.poses[rows], log_gains=given[rows] - level
    )
    ended = []
    for fit in whole.fits:
        start = replace(whole, gaussians=_brighter(fit, level), others=(), exposures=exposures)
        # The plan has the poses. As if there were no steps, it goes on however far blocks' fits had
        # converged.
        earlier = replace(joined, appearance=start, poses=None, steps=0)
        further = fit_appearance(some, console, earlier=earlier)
        assert further is not None
        ended.append(further)
    fits = [_brighter(further.appearance.gaussians, -level) for further in ended]
    log_gains, found = given.copy(), ended[0].appearance.exposures
    assert found is not None
    log_gains[rows] = found.log_gains + level
    return replace(
        joined,
        appearance=replace(
            whole,
            gaussians=fits[0],
            others=tuple(fits[1:]),
            exposures=replace(whole.exposures, log_gains=log_gains),
        ),
        steps=joined.steps + ended[0].steps,
    )


def _options(refine: FitOptions, *, fits: int) -> FitOptions:
    """Options of each of some fits that share the time, or the steps, there is."""
    share = SHARE / fits
    if refine.limit is not None:
        return refine.replaced(poses=False, seconds=share * refine.limit, steps=None)
    return refine.replaced(poses=False, steps=max(1, round(share * (refine.steps or 0))))


def _brighter(gaussians: Gaussians, log_gain: NDArray[np.float64]) -> Gaussians:
    return Gaussians(scale_colors(gaussians.values, log_gain), frame=gaussians.frame)
