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
from gvtools.procedural.render import radiance, to_srgb
from gvtools.procedural.textures import check_split, photograph_names
from gvtools.training.corruption import CorruptionOptions, draw_strengths
from gvtools.training.sample import Clip, TrainingSample, make_sample

COUNTS = 101  # the stream of random numbers that counts are drawn from
EXTRAPOLATION = 0.5  # chance that the first views are given, and not views all along the path
ENDS = 0.4  # chance, of the other cases, that both ends are given and not every k-th view


@dataclass(frozen=True)
class ContextChoice:
    """How many views are given, and which."""

    most: int = 4  # context views; at least one is given
    # so many samples in a row have the same number, so that a batch of them is possible
    group: int = 8

    def count(self, seed: list[int], index: int) -> int:
        """The number of context views of a sample; ``seed`` is the data set's."""
        rng = np.random.default_rng([*seed, index // self.group, COUNTS])
        return int(rng.integers(1, self.most + 1))

    def chosen(self, rng: np.random.Generator, views: int, count: int) -> tuple[int, ...]:
        """Which of a path's views are given, ascending."""
        rule = "first"
        if rng.random() >= EXTRAPOLATION:
            rule = "ends" if rng.random() < ENDS else "every"
        return chosen_context(rng, views, count, rule=rule)


def chosen_context(
    rng: np.random.Generator, views: int, count: int, *, rule: str
) -> tuple[int, ...]:
    """Which views of a path are given, ascending.

    ``rng``: places the views of "every". ``rule``: "every" k-th view; evenly spaced with both
    "ends"; or the "first" ones.
    """
    if not 1 <= count < views:
        raise OptionError(f"{count} context views of {views}; expected 1 to {views - 1}")
    if rule == "first":
        return tuple(range(count))
    if rule == "ends":
        last = views - 1
        return tuple(round(i * last / max(count - 1, 1)) for i in range(count))
    step = views // count
    start = int(rng.integers(0, views - step * (count - 1)))
    return tuple(start + step * i for i in range(count))


# Streams of random numbers of one sample.
SCENE, PATH, FAULTS = range(3)
# The same streams of procedural and recorded samples do not meet.
PROCEDURAL, RECORDED, MIXED = range(3)


class Samples(Protocol):
    """A data set: samples by number, and what they follow from."""

    def sample(self, index: int) -> TrainingSample:
        """The sample of a number, 0 or more."""
        ...

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        ...


@dataclass(frozen=True, eq=False)
class SampleInputs:
    """What a sample is made of."""

    clip: Clip  # its true views in order
    context: tuple[int, ...]  # which of them are given, ascending
    strength: CorruptionOptions  # of its faults
    rng: np.random.Generator  # draws the faults; used up by one sample


@dataclass(frozen=True, kw_only=True)
class ProceduralViews:
    """Views of procedural scenes; every number has a scene of its own."""

    seed: int = 0  # 0 or more
    split: str = "train"  # "train" or "held-out": other photographs, layouts and numbers
    views: int = 8  # of a sample, context and targets
    size: tuple[int, int] = (96, 96)  # (H, W) of the pictures
    # how many views are given, and which
    context: ContextChoice = field(default_factory=ContextChoice)
    # see CorruptionOptions; None for clean observations
    faults: CorruptionOptions | None = field(default_factory=CorruptionOptions)
    fill: str = "none"  # of the model's configuration, ``hints.fill``

    def __post_init__(self) -> None:
        check_split(self.split)

    def sample(self, index: int, attempt: int = 0) -> TrainingSample:
        """The sample of a number, 0 or more; it is drawn at the first attempt and any later one."""
        given = self.inputs(index)
        return make_sample(
            given.clip,
            given.clip,
            given.context,
            rng=given.rng,
            strength=given.strength,
            fill=self.fill,
        )

    def inputs(self, index: int) -> SampleInputs:
        """What the sample of a number is made of."""
        clip = self.clip(index)
        rng = self._rng(index, FAULTS)
        strength = draw_strengths(rng, self.faults or CorruptionOptions(clean=1.0))
        context = self.context.chosen(rng, self.views, self.context_count(index))
        return SampleInputs(clip, context, strength, rng)

    def clip(self, index: int) -> Clip:
        """The true views of a sample in order."""
        place = scene(self._rng(index, SCENE), self.split)
        cameras = camera_path(
            self._rng(index, PATH), place.geometry, views=self.views, size=self.size
        )
        light, depth = radiance(place.geometry, place.look, cameras)
        exposure = place.key / max(float(light.mean()), 1e-6)
        return Clip(to_srgb(light, exposure), depth, cameras)

    def context_count(self, index: int) -> int:
        """How many views of a sample are given."""
        return self.context.count(self._seed, index)

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        return {
            "source": "procedural",
            **shared_settings(self),
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


def shared_settings(views: Any) -> dict[str, Any]:
    """The settings that procedural and recorded views share, as plain data."""
    plain = {name: getattr(views, name) for name in ("seed", "views", "size", "fill")}
    faults = None if views.faults is None else views.faults.to_dict()
    return {**plain, "context": asdict(views.context), "faults": faults}
