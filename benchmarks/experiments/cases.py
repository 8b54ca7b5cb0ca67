"""What completers are judged on: context views, projected memory, and the truth of the targets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.completers.base import ContextView
from gvtools.guidance import Guidance

if TYPE_CHECKING:
    from gvtools.training.views import SampleInputs

Float32 = NDArray[np.float32]
# Of the pictures, px: the shipped model's own.
SIZE = 96


@dataclass(frozen=True, eq=False)
class Case:
    """One scene's targets.

    Attributes:
        name: of the scene.
        context: observed views.
        guidance: the memory of them, projected into the targets.
        rgb: (T, H, W, 3) true pictures in [0, 1].
        depth: (T, H, W) true z-depth, scene units; 0 = unknown.
        judged: (T, H, W) pixels that count; None for those that nothing observed supports.
    """

    name: str
    context: tuple[ContextView, ...]
    guidance: Guidance
    rgb: Float32
    depth: Float32
    judged: NDArray[np.bool_] | None = None

    @property
    def generated(self) -> NDArray[np.bool_]:
        """(T, H, W) pixels that count."""
        if self.judged is not None:
            return self.judged
        return ~self.guidance.valid | self.guidance.generated


def held_out_cases(
    count: int, *, seed: int = 0, size: int = SIZE, views: int = 8
) -> Iterator[Case]:
    """Procedural scenes with photographs and layouts that no training sees.

    The context has the faults of real observations, drawn as in training.

    Args:
        count: of scenes.
        seed: of the scenes.
        size: of the square pictures, px.
        views: of a scene, context and targets.
    """
    from gvtools.training.views import ProceduralViews

    data = ProceduralViews(seed=seed, split="held-out", views=views, size=(size, size))
    for index in range(count):
        yield case_of(data.inputs(index)[0], f"held-out {index}")


def case_of(given: SampleInputs, name: str) -> Case:
    """Views that are not given are the targets; the context gets its faults.

    Args:
        given: true views, and which of them are given; its generator is used up.
        name: of the case.
    """
    from gvtools.training.samples import observe_context, project_observation

    truth = given.clip
    targets = [view for view in range(len(truth)) if view not in given.context]
    observation = observe_context(truth, given.context, given.strength, rng=given.rng)
    return Case(
        name,
        observation.views,
        project_observation(observation, truth.cameras[targets]),
        (truth.rgb[targets] / np.float32(255)).astype(np.float32),
        truth.depth[targets],
    )
