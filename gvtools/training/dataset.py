"""Data sets of samples by number: a sample follows from seed, split and number, and nothing else.

No state is kept and no global random number is drawn, so that workers, processes and a training
that is continued see what one process would have seen.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import numpy as np

from gvtools.errors import OptionError
from gvtools.procedural.layouts import scene
from gvtools.procedural.paths import camera_path
from gvtools.procedural.render import developed, radiance
from gvtools.procedural.textures import check_split, photograph_names
from gvtools.training.context_choice import ContextChoice
from gvtools.training.corruption import CorruptionOptions, drawn
from gvtools.training.hints import Clip
from gvtools.training.view_sample import Sample, make_sample

# Streams of random numbers of one sample.
SCENE, PATH, FAULTS = range(3)
# The same streams of procedural and recorded samples do not meet.
PROCEDURAL, RECORDED, MIXED = range(3)


class Samples(Protocol):
    """A data set: samples by number, and what they follow from."""

    def sample(self, index: int) -> Sample:
        """The sample of a number, 0 or more."""
        ...

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        ...


@dataclass(frozen=True, eq=False)
class Given:
    """What a sample is made of.

    Attributes:
        clip: its true views in order.
        context: which of them are given, ascending.
        strength: of its faults.
        rng: draws the faults; used up by one sample.
    """

    clip: Clip
    context: tuple[int, ...]
    strength: CorruptionOptions
    rng: np.random.Generator


@dataclass(frozen=True, kw_only=True)
class ProceduralViews:
    """Views of procedural scenes; every number has a scene of its own.

    Attributes:
        seed: 0 or more.
        split: "train" or "held-out": other photographs, layouts and numbers.
        views: of a sample, context and targets.
        size: (H, W) of the pictures.
        context: how many views are given, and which.
        faults: see CorruptionOptions; None for clean observations.
        fill: of the model's configuration, ``hints.fill``.
    """

    seed: int = 0
    split: str = "train"
    views: int = 8
    size: tuple[int, int] = (96, 96)
    context: ContextChoice = field(default_factory=ContextChoice)
    faults: CorruptionOptions | None = field(default_factory=CorruptionOptions)
    fill: str = "none"

    def __post_init__(self) -> None:
        check_split(self.split)

    def sample(self, index: int, attempt: int = 0) -> Sample:
        """The sample of a number, 0 or more; it is drawn at the first attempt and any later one."""
        given = self.given(index)
        return make_sample(
            given.clip,
            given.clip,
            given.context,
            rng=given.rng,
            strength=given.strength,
            fill=self.fill,
        )

    def given(self, index: int) -> Given:
        """What the sample of a number is made of."""
        clip = self.clip(index)
        rng = self._rng(index, FAULTS)
        strength = drawn(rng, self.faults or CorruptionOptions(clean=1.0))
        context = self.context.chosen(rng, self.views, self.context_count(index))
        return Given(clip, context, strength, rng)

    def clip(self, index: int) -> Clip:
        """The true views of a sample in order."""
        place = scene(self._rng(index, SCENE), self.split)
        cameras = camera_path(
            self._rng(index, PATH), place.geometry, views=self.views, size=self.size
        )
        light, depth = radiance(place.geometry, place.look, cameras)
        exposure = place.key / max(float(light.mean()), 1e-6)
        return Clip(developed(light, exposure), depth, cameras)

    def context_count(self, index: int) -> int:
        """How many views of a sample are given."""
        return self.context.count(self._seed, index)

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        return {
            "source": "procedural",
            **described(self),
            "photographs": photograph_names(self.split),
        }

    @property
    def _seed(self) -> list[int]:
        return context_seed(self.seed, self.split)

    def _rng(self, index: int, stream: int) -> np.random.Generator:
        if index < 0:
            raise OptionError(f"sample {index}; expected a number of 0 or more")
        return np.random.default_rng([*self._seed, index, stream])


def context_seed(seed: int, split: str = "train") -> list[int]:
    """What numbers of context views are drawn with: one for all sources that batches mix."""
    return [seed, PROCEDURAL, check_split(split)]


def described(views: Any) -> dict[str, Any]:
    """The settings that procedural and recorded views share, as plain data."""
    plain = {name: getattr(views, name) for name in ("seed", "views", "size", "fill")}
    faults = None if views.faults is None else views.faults.to_dict()
    return {**plain, "context": asdict(views.context), "faults": faults}
