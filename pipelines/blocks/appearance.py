"""Gaussians that blocks fitted, joined: each block's where its cell is, equally exposed.

A block's Gaussians were fitted together with those behind its faces, which a merge leaves out and
replaces by another block's. The views that help other blocks see across faces: a short fit to them
brings both sides together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance, Blend
from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.fit_options import FitOptions
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.harmonics import turn_gaussians
from gvtools.appearance.splat.project_kernels import HARMONICS, LOG_SCALE, SH
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.view_selection import evenly_spread
from pipelines.blocks.block import SceneBlock
from pipelines.reconstruction.fitting import Fitted, fit_appearance

if TYPE_CHECKING:
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan


Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BlockAppearance:
    """What a block's run fitted."""

    block: SceneBlock
    context: tuple[str, ...]  # its run's context, in the order of the exposures
    appearance: Appearance  # its Gaussians


def join_appearances(parts: Sequence[BlockAppearance], frame: LocalFrame) -> Appearance:
    """One appearance of all blocks'.

    Of each block the Gaussians whose centres lie in its cell. Each block's brightness is relative
    to its own photographs; those that several blocks share tell how their scales differ.
    """
    gains = _centred(brightness([_log_gains(part) for part in parts]), parts)
    first = parts[0].appearance
    count = min(len(part.appearance.fits) for part in parts)
    fits = [
        Gaussians(
            np.concatenate([
                _in_cell(part.appearance.fits[number], part.block, frame, gain=gain)
                for part, gain in zip(parts, gains, strict=True)
            ]),
            frame=frame,
        )
        for number in range(count)
    ]  # fmt: skip
    weights = [len(part.block.owners) for part in parts]
    blends = [part.appearance.blend for part in parts]
    blend = Blend(
        float(np.average([blend.share for blend in blends], weights=weights)),
        float(np.average([blend.tolerance for blend in blends], weights=weights)),
    )
    near = min(part.appearance.near for part in parts)
    surfaces = [
        frame.from_world(part.appearance.gaussians.frame.to_world(part.appearance.surface))
        for part in parts if part.appearance.surface is not None
    ]  # fmt: skip
    # Surfaces of one block say nothing of what is before them in another.
    all_known = len(surfaces) == len(parts)
    surface = np.concatenate(surfaces).astype(np.float32) if all_known else None
    return Appearance(
        fits[0], near, blend, first.splatter, tuple(fits[1:]), _exposures(parts, gains, frame),
        surface,
    )  # fmt: skip


def brightness(parts: Sequence[dict[str, Float64]]) -> Float64:
    """(B, 3) logarithms that each block's exposures lack to one scale, with mean zero.

    ``parts`` are of each block the logarithmic gains (3,) of its photographs, by name.

    >>> one, two = {"a": np.zeros(3), "b": np.ones(3)}, {"b": np.full(3, 0.5), "c": np.zeros(3)}
    >>> brightness([one, two]).round(2)[:, 0].tolist()
    [-0.25, 0.25]
    """
    equations, wanted = [np.ones(len(parts))], [np.zeros(3)]
    for i, one in enumerate(parts):
        for j in range(i + 1, len(parts)):
            shared = sorted(one.keys() & parts[j].keys())
            if shared:
                apart = np.mean([one[name] - parts[j][name] for name in shared], axis=0)
                row = np.zeros(len(parts))
                row[i], row[j] = -1, 1
                # One photograph more, one voice more.
                equations.append(row * np.sqrt(len(shared)))
                wanted.append(apart * np.sqrt(len(shared)))
    found = np.linalg.lstsq(np.array(equations), np.array(wanted), rcond=None)[0]
    return np.asarray(found, np.float64)


def _centred(gains: Float64, parts: Sequence[BlockAppearance]) -> Float64:
    """The blocks' gains, such that the mean of all blocks' own photographs' gains is zero."""
    own = [
        log_gain + gain
        for part, gain in zip(parts, gains, strict=True)
        for name, log_gain in _log_gains(part).items()
        if name in part.block.owners
    ]
    return gains - np.mean(own, axis=0) if own else gains


def _log_gains(part: BlockAppearance) -> dict[str, Float64]:
    exposures = part.appearance.exposures
    if exposures is None or len(exposures.log_gains) != len(part.context):
        return {}
    return dict(zip(part.context, exposures.log_gains, strict=True))


def _in_cell(
    gaussians: Gaussians, block: SceneBlock, frame: LocalFrame, *, gain: Float64
) -> NDArray[np.float32]:
    """The Gaussians in a block's cell, in a frame, dimmed by what their photographs' gains rise."""
    world = gaussians.frame.to_world(gaussians.values[:, :LOG_SCALE])
    inside = block.cell.holds(world)
    if not inside.any():
        return gaussians.values[:0]
    out = turn_gaussians(gaussians.values[inside], frame.axes.T @ gaussians.frame.axes)
    out[:, :LOG_SCALE] = frame.from_world(world[inside])
    return scale_colors(out, -gain)


def scale_colors(values: NDArray[np.float32], log_gain: Float64) -> NDArray[np.float32]:
    """(N, VALUES) Gaussians whose colours are multiplied by the exponential of (3,) logarithms."""
    out, scale = values.copy(), np.exp(log_gain)
    sh = out[:, SH:].reshape(len(out), -1, 3) * scale
    # Colours are 0.5 + their harmonics; it is the whole that changes.
    sh[:, 0] += 0.5 * (scale - 1) / HARMONICS[0]
    out[:, SH:] = sh.reshape(len(out), -1)
    return out


def _exposures(
    parts: Sequence[BlockAppearance], gains: Float64, frame: LocalFrame
) -> Exposures | None:
    """Exposures of all blocks' own photographs in order of their names, as a run has its context.

    None where a block has none.
    """
    names, poses, logs, depths = [], [], [], []
    for part, gain in zip(parts, gains, strict=True):
        own, exposures = set(part.block.owners), part.appearance.exposures
        if exposures is None or len(exposures.poses) != len(part.context):
            return None
        mine = np.array([name in own for name in part.context])
        world = part.appearance.gaussians.frame.cam_from_world(exposures.poses[mine])
        names += [name for name in part.context if name in own]
        poses.append(frame.cam_from_local(world))
        logs.append(exposures.log_gains[mine] + gain)
        depths.append(exposures.depth)
    order = np.argsort(names)
    log_gains = np.concatenate(logs)[order]
    return Exposures(np.concatenate(poses)[order], log_gains, float(np.median(depths)))


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
    exposures = replace(whole.exposures, log_gains=log_gains)
    appearance = replace(whole, gaussians=fits[0], others=tuple(fits[1:]), exposures=exposures)
    return replace(joined, appearance=appearance, steps=joined.steps + ended[0].steps)


def _options(refine: FitOptions, *, fits: int) -> FitOptions:
    """Options of each of some fits that share the time, or the steps, there is."""
    share = SHARE / fits
    if refine.limit is not None:
        return refine.replaced(poses=False, seconds=share * refine.limit, steps=None)
    return refine.replaced(poses=False, steps=max(1, round(share * (refine.steps or 0))))


def _brighter(gaussians: Gaussians, log_gain: NDArray[np.float64]) -> Gaussians:
    return Gaussians(scale_colors(gaussians.values, log_gain), frame=gaussians.frame)
