"""Three rounds along held-out paths, with the memory and without it.

With it, each round's targets are completed from the projected memory and fused back, as
``gvtools reconstruct`` does. Without it nothing is projected: the completer sees the photographs
and the pictures that it made in the round before. It is the model that was trained with
projections, so that part of the gap is that it misses what it is used to; the ablations train one
without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.experiments.options import ExperimentOptions
from benchmarks.experiments.rows import INPAINT, geoverse
from gvtools.completers.base import Completer, ContextView
from gvtools.errors import DegenerateError
from gvtools.evaluation.images import psnr
from gvtools.evaluation.pose_probe import Located, PoseProbe
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.evaluation.tables import Column, Table
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.training.samples import Clip
from pipelines.reconstruction.rounds import CachedProjection, Clock, complete_targets
from pipelines.reconstruction.settings import RunSettings

READS = ("weights", "scenes", "size", "seed")

ROUNDS, PER_ROUND, CONTEXT = 3, 4, 4
SIZE = 256
WITH, WITHOUT = "with memory", "without memory"


@dataclass
class _Arm:
    """A way to make the rounds, and what came of it; lists by round."""

    completer: Completer
    memory: bool
    psnr: list[list[float]] = field(default_factory=lambda: [[] for _ in range(ROUNDS)])
    located: list[list[Located]] = field(default_factory=lambda: [[] for _ in range(ROUNDS)])
    constant: list[list[float]] = field(default_factory=lambda: [[] for _ in range(ROUNDS)])


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Figures and a table; see ``READS``."""
    from gvtools.completers.base import create
    from gvtools.training.views import ProceduralViews

    arms = {
        f"student 3+1, {WITH}": _Arm(geoverse(options.weights), True),
        f"student 3+1, {WITHOUT}": _Arm(geoverse(options.weights), False),
        f"{INPAINT}, {WITH}": _Arm(create("inpaint"), True),
    }
    side = options.size or SIZE
    data = ProceduralViews(
        seed=options.seed, split="held-out", views=CONTEXT + ROUNDS * PER_ROUND, size=(side, side)
    )
    skipped = 0
    for index in range(options.scenes):
        truth = data.clip(index)
        context = _context(truth)
        try:
            probe = PoseProbe(
                [
                    PosedPicture(view.name, view.camera, truth.rgb[i], depth=view.depth)
                    for i, view in enumerate(context)
                ]
            )
        except DegenerateError:
            # Nothing in the photographs can be recognised.
            skipped += 1
            continue
        for arm in arms.values():
            _follow(arm, truth, context, probe, options.seed)
    if skipped == options.scenes:
        raise DegenerateError(
            f"none of {skipped} scenes has photographs with features to recognise; give more "
            "--scenes"
        )
    found = {
        "scenes": options.scenes - skipped,
        "without_features": skipped,
        "size": side,
        "seed": options.seed,
        "results": {
            name: [_figures(arm, number) for number in range(ROUNDS)] for name, arm in arms.items()
        },
    }
    return found, [_table(found)]


def _context(truth: Clip) -> list[ContextView]:
    """The first views of a path, with their depth."""
    return [
        ContextView(
            truth.cameras.names[i],
            truth.cameras[i],
            (truth.rgb[i] / np.float32(255)).astype(np.float32),
            truth.depth[i],
        )
        for i in range(CONTEXT)
    ]


def _follow(
    arm: _Arm, truth: Clip, context: Sequence[ContextView], probe: PoseProbe, seed: int
) -> None:
    """All rounds of a scene."""
    config = RunSettings(seed=seed)
    footprint = float(np.median(truth.depth[:CONTEXT])) / float(truth.cameras.K[0, 0, 0])
    memory = SpatialMemory(footprint, origin=truth.cameras.centers[0], options=config.memory)
    for i in range(CONTEXT):
        memory.observe(truth.rgb[i], truth.depth[i], truth.cameras[i], round=0)
    known = list(context)
    for number in range(ROUNDS):
        rows = list(range(CONTEXT + number * PER_ROUND, CONTEXT + (number + 1) * PER_ROUND))
        cameras = truth.cameras[rows]
        if arm.memory:
            results = complete_targets(
                [CachedProjection(memory, camera, options=config.splat) for camera in cameras],
                number + 1,
                memory=memory,
                completer=arm.completer,
                context=context,
                config=config,
                clock=Clock(),
            )
            made = [result.completion.rgb[0] for result in results]
        else:
            nothing = memory.project(cameras, options=config.splat).blank()
            completion = arm.completer.complete(known, nothing, seed=seed + number + 1)
            made = list(completion.rgb)
            known = list(context) + [
                ContextView(f"round {number} {name}", cameras[i], made[i])
                for i, name in enumerate(cameras.names)
            ]
        for row, picture in zip(rows, made, strict=True):
            shown = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
            arm.psnr[number].append(psnr(shown, truth.rgb[row]) or 0.0)
            camera = truth.cameras[row]
            arm.located[number].append(probe.locate(PosedPicture(camera.names[0], camera, shown)))
            nearest = np.linalg.norm(truth.cameras.centers[:CONTEXT] - camera.centers, axis=1)
            arm.constant[number].append(float(nearest.min()))


def _figures(arm: _Arm, number: int) -> dict[str, Any]:
    """Of a round: a picture that is not located counts as standing at the nearest photograph."""
    located, nearest = arm.located[number], arm.constant[number]
    errors = [
        constant if one.center_error is None else one.center_error
        for one, constant in zip(located, nearest, strict=True)
    ]
    inside = [one.center_error for one in located if one.center_error is not None]
    angles = [one.rotation_error_deg for one in located if one.rotation_error_deg is not None]
    return {
        "round": number + 1,
        "psnr": float(np.mean(arm.psnr[number])),
        "located_share": len(inside) / len(located),
        "ate": float(np.sqrt(np.mean(np.square(inside)))) if inside else None,
        "ate_all": float(np.sqrt(np.mean(np.square(errors)))),
        "rotation_deg_median": float(np.median(angles)) if angles else None,
        "pictures": len(located),
    }


def _table(found: dict[str, Any]) -> Table:
    columns = (
        Column("rounds"),
        Column("round"),
        Column("PSNR", "dB, whole pictures", "higher", 2),
        Column("located", "share", "higher", 2),
        Column("ATE of the located", "scene units", "lower", 4),
        Column("ATE, others at the nearest photograph", "scene units", "lower", 4),
        Column("rotation", "deg, median", "lower", 2),
    )
    keys = ("round", "psnr", "located_share", "ate", "ate_all", "rotation_deg_median")
    rows = tuple(
        (name, *(entry[key] for key in keys))
        for name, entries in found["results"].items()
        for entry in entries
    )
    caption = (
        f"{ROUNDS} rounds of {PER_ROUND} views after {CONTEXT} photographs, "
        f"{found['scenes']} held-out scenes, {found['size']}x{found['size']}"
    )
    return Table(columns, rows, caption)
