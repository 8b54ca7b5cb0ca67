"""A target with its picture, its true picture and its regions: what every figure is taken of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.evaluation.posed_picture import PosedPicture

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.runs.run import Run
    from gvtools.scenes.scene import Frame


@dataclass(frozen=True, eq=False)
class MeasuredTarget:
    """One target with all that its figures need.

    Attributes:
        number: of its round, from 1.
        picture: what is measured, seen from where it is meant to be.
        observed: (H, W) bool, pixels that the context observed, by the memory.
        generated: (H, W) bool, pixels that the run's completer made.
        truth: the true picture; None where there is none.
        coverage: share of the pixels that the memory supported before the round; None where no
            run completed the target.
        coverage_after: after the round, likewise.
        surface: (H, W) float32 z-depth of the memory, scene units, 0 = none, by which features are
            carried between pictures without depth of their own; None where none are.
    """

    number: int
    picture: PosedPicture
    observed: NDArray[np.bool_]
    generated: NDArray[np.bool_]
    truth: Frame | None
    coverage: float | None = None
    coverage_after: float | None = None
    surface: NDArray[np.float32] | None = None


def run_targets(run: Run) -> list[MeasuredTarget]:
    """The completed targets of a run with the pictures that it made, in the order of its rounds."""
    return [
        MeasuredTarget(
            view.round,
            PosedPicture(files.name, files.camera, files.picture, files.depth),
            files.observed,
            files.generated,
            None if truth is None else truth.load(),
            coverage=view.report["coverage"],
            coverage_after=view.report["coverage_after"],
        )
        for view, files, truth in run.targets()
    ]


def true_pictures(targets: Sequence[MeasuredTarget]) -> list[PosedPicture]:
    """The true pictures of the targets that have one, from the same cameras."""
    return [
        PosedPicture(
            target.picture.name,
            target.picture.camera,
            target.truth.rgb,
            target.truth.depth,
            target.truth.mask,
        )
        for target in targets
        if target.truth is not None
    ]


def context_pictures(run: Run, memory: SpatialMemory) -> list[PosedPicture]:
    """The context views, with the depth of the memory's observed points as each sees them.

    Args:
        run: whose context it is.
        memory: after round 0, which holds the context alone.
    """
    pictures = []
    for name in run.context:
        view = run.scenes[0][name]
        frame = view.load()
        depth = memory.project(view.camera).depth[0]
        pictures.append(PosedPicture(name, view.camera, frame.rgb, depth, frame.mask))
    return pictures
