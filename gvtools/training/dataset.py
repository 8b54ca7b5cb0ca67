"""Data sets of samples by number: a sample follows from seed, split and number, and nothing else.

No state is kept and no global random number is drawn, so that workers, processes and a training
that is continued see what one process would have seen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from pydantic_core import to_jsonable_python

from gvtools.errors import OptionError
from gvtools.options import check_range
from gvtools.training.context_choice import ContextOptions
from gvtools.training.corruption import CorruptionOptions, drawn
from gvtools.training.hints import Clip, HintOptions
from gvtools.training.layouts import scene
from gvtools.training.paths import PathOptions, camera_path
from gvtools.training.photographs import check_split, photograph_names
from gvtools.training.renderer import SUPERSAMPLE, developed, radiance
from gvtools.training.view_sample import Sample, make_sample

# Streams of random numbers of one sample.
SCENE, PATH, FAULTS, SOURCE = range(4)
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
        clip: its views in order, as they are observed.
        truth: the same views at the model's size.
        context: which of them are given, ascending.
        strength: of its faults.
        rng: draws the faults; used up by one sample.
    """

    clip: Clip
    truth: Clip
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
        detail: memory is made and projected at so many times the size, then reduced, as it is where
            photographs are larger than the model's pictures.
        context: how many views are given, and which.
        paths: see PathOptions.
        faults: see CorruptionOptions; None for clean observations.
        hints: see HintOptions.
        fill: of the model's configuration, ``hints.fill``.
        photographs: names that textures may be cut from; None for those of the split that are
            installed. They decide the samples.
    """

    seed: int = 0
    split: str = "train"
    views: int = 8
    size: tuple[int, int] = (96, 96)
    detail: int = 1
    context: ContextOptions = field(default_factory=ContextOptions)
    paths: PathOptions = field(default_factory=PathOptions)
    faults: CorruptionOptions | None = field(default_factory=CorruptionOptions)
    hints: HintOptions = field(default_factory=HintOptions)
    fill: str = "none"
    photographs: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        check_split(self.split)
        check_range("data.seed", self.seed, least=0)
        check_range("data.detail", self.detail, least=1)
        check_range("data.views", self.views, least=self.context.most + 1)
        if self.photographs is None:
            object.__setattr__(self, "photographs", photograph_names(self.split))

    def sample(self, index: int) -> Sample:
        """The sample of a number, 0 or more."""
        given = self.given(index)
        return make_sample(
            given.clip,
            given.truth,
            given.context,
            rng=given.rng,
            strength=given.strength,
            hints=self.hints,
            fill=self.fill,
        )

    def given(self, index: int) -> Given:
        """What the sample of a number is made of."""
        clip, truth = self.clips(index)
        rng = self._rng(index, FAULTS)
        strength = drawn(rng, self.faults or CorruptionOptions(clean=1.0))
        context = self.context.chosen(rng, self.views, self.context_count(index))
        return Given(clip, truth, context, strength, rng)

    def clips(self, index: int) -> tuple[Clip, Clip]:
        """The views of a sample in order: as they are observed, and at the model's size."""
        place = scene(self._rng(index, SCENE), self.split, photographs=self.photographs)
        path = camera_path(
            self._rng(index, PATH), place.geometry, views=self.views, size=self.size,
            options=self.paths,
        )  # fmt: skip
        light, depth = radiance(place.geometry, place.look, path.cameras)
        exposure = place.key / max(float(light.mean()), 1e-6)
        truth = Clip(developed(light, exposure), depth, path.cameras)
        if self.detail == 1:
            return truth, truth
        cameras = path.cameras.resized(self.size[1] * self.detail, self.size[0] * self.detail)
        light, depth = radiance(
            place.geometry, place.look, cameras, supersample=max(1, SUPERSAMPLE // self.detail)
        )
        return Clip(developed(light, exposure), depth, cameras), truth

    def context_count(self, index: int) -> int:
        """How many views of a sample are given."""
        return self.context.count(self._seed, index)

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        return {"source": "procedural", **to_jsonable_python(self)}

    @property
    def _seed(self) -> list[int]:
        return [self.seed, PROCEDURAL, check_split(self.split)]

    def _rng(self, index: int, stream: int) -> np.random.Generator:
        if index < 0:
            raise OptionError(f"sample {index}; expected a number of 0 or more")
        return np.random.default_rng([*self._seed, index, stream])


@dataclass(frozen=True)
class MixedViews:
    """Two data sets in one, group by group.

    Attributes:
        first: most samples come from it.
        second: the others.
        share: of groups that come from ``second``.
        group: samples in a row that come from the same one.
        seed: decides which.
    """

    first: Samples
    second: Samples
    share: float
    group: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        check_range("data.share", self.share, least=0, most=1)
        check_range("data.group", self.group, least=1)

    def sample(self, index: int) -> Sample:
        """The sample of a number, 0 or more."""
        rng = np.random.default_rng([self.seed, MIXED, index // self.group, SOURCE])
        return (self.second if rng.random() < self.share else self.first).sample(index)

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        parts = {"first": self.first.describe(), "second": self.second.describe()}
        return {"share": self.share, "group": self.group, "seed": self.seed, **parts}
