"""Gaussians that blocks fitted, joined: each block's where its cell is, equally exposed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.blending import Blend
from gvtools.appearance.exposures import Exposures
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import HARMONICS, LOG_SCALE, SH
from gvtools.appearance.turning import turned
from gvtools.memory.store.local_frame import LocalFrame
from pipelines.blocks.block import SceneBlock

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BlockAppearance:
    """What a block's run fitted.

    Attributes:
        block: the block.
        context: its run's context, in the order of the exposures.
        appearance: its Gaussians.
    """

    block: SceneBlock
    context: tuple[str, ...]
    appearance: Appearance


def join_appearances(parts: Sequence[BlockAppearance], frame: LocalFrame) -> Appearance:
    """One appearance of all blocks'.

    Of each block the Gaussians whose centres lie in its cell. Each block's brightness is relative
    to its own photographs; those that several blocks share tell how their scales differ.

    Args:
        parts: at least one.
        frame: that the Gaussians are to be in.
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

    Args:
        parts: of each block the logarithmic gains (3,) of its photographs, by name.

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
    out = turned(gaussians.values[inside], frame.axes.T @ gaussians.frame.axes)
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
