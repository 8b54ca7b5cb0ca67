"""Samples of several sources by weight: which source a number has follows from seed and number.

All draws of a mixture are fixed places of random streams, so that the sample of a number is the
same on any number of processes and workers, and a million draws are one call.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import DegenerateError, OptionError
from gvtools.training.dataset import MIXED
from gvtools.training.invalid_sample import DEPTH, InvalidSampleError
from gvtools.training.view_sample import Sample

Float64 = NDArray[np.float64]

# Of an invalid sample, the same source is asked so often, so that sources keep their shares; then
# one of the others is drawn, until none is left.
TRIES = 10
# Streams of a mixture.
SOURCES, GEOMETRY = range(2)
# Numbers that Philox makes in one step of its counter.
_BLOCK = 4
# Numbers that are spread evenly together.
_RUN = 1024
# The source of procedural rooms.
ROOMS = "rooms"
# What notes begin with: samples by source, invalid ones by source and reason, where geometry
# comes from.
DRAWN, RESAMPLED, GEOMETRY_OF = "drawn", "resampled", "geometry"


class Redrawable(Protocol):
    """Samples by number, of which another one can be drawn."""

    def sample(self, index: int, attempt: int = 0) -> Sample:
        """The sample of a number; InvalidSampleError asks for the next attempt."""
        ...

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        ...


@dataclass(frozen=True)
class Source:
    """One source of a mixture.

    Attributes:
        name: unique in a mixture; part of the notes.
        weight: its share is its part of the sum of all weights.
        samples: drawn from it.
    """

    name: str
    weight: float
    samples: Redrawable


@dataclass(frozen=True)
class Mixture:
    """Sources that samples are drawn from by weight.

    Attributes:
        sources: at least one.
        seed: 0 or more.
    """

    sources: tuple[Source, ...]
    seed: int = 0

    def __post_init__(self) -> None:
        weights = [source.weight for source in self.sources]
        if not (all(0 <= w < math.inf for w in weights) and sum(weights) > 0):
            raise OptionError(f"weights {weights} of sources; expected 0 or more, and not all 0")
        names = [source.name for source in self.sources]
        if len(set(names)) != len(names):
            raise OptionError(f"sources {', '.join(names)}; expected each name once")

    @cached_property
    def shares(self) -> Float64:
        """(S,) expected share of each source."""
        weights = np.array([source.weight for source in self.sources], np.float64)
        return weights / weights.sum()

    def drawn(self, start: int, count: int, *, without: Collection[int] = ()) -> NDArray[np.int64]:
        """(count,) which source the numbers from ``start`` on have.

        Args:
            start: 0 or more.
            count: how many.
            without: sources that had no valid sample; not all of those with a share.
        """
        numbers = stratified_at(start, count, stream=[self.seed, MIXED, SOURCES, len(without)])
        shares = np.where(np.isin(np.arange(len(self.sources)), list(without)), 0, self.shares)
        ends = np.cumsum(shares) / shares.sum()
        # Rounding must not leave a gap at the end, nor give it to a source of weight 0.
        last = int(np.flatnonzero(shares)[-1])
        return np.minimum(np.searchsorted(ends, numbers, side="right"), last)

    def sample(self, index: int) -> Sample:
        """The sample of a number, 0 or more, with notes of what its drawing met.

        Raises:
            OptionError: a number below 0.
            DegenerateError: nothing valid was found.
        """
        if index < 0:
            raise OptionError(f"sample {index}; expected a number of 0 or more")
        notes: list[str] = []
        failed: list[int] = []
        problem = ""
        while len(failed) < np.count_nonzero(self.shares):
            number = int(self.drawn(index, 1, without=failed)[0])
            source = self.sources[number]
            for attempt in range(TRIES):
                try:
                    sample = source.samples.sample(index, attempt)
                except InvalidSampleError as error:
                    notes.append(f"{RESAMPLED}/{source.name}/{error.reason}")
                    problem = f"{source.name}: {error}"
                    continue
                own = [f"{kind}/{source.name}/{text}" for kind, text in map(_split, sample.notes)]
                return replace(sample, notes=(*notes, f"{DRAWN}/{source.name}", *own))
            failed.append(number)
        raise DegenerateError(
            f"sample {index}: {len(notes)} draws and none is valid, the last of {problem}"
        )

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        return {
            "seed": self.seed,
            "sources": {
                source.name: {"weight": source.weight, **source.samples.describe()}
                for source in self.sources
            },
        }


@dataclass(frozen=True)
class OwnOrEstimated:
    """Samples with a data set's own geometry or with estimated geometry, as the paper mixes them.

    Where an estimate is drawn and none is at hand, the own geometry stands in; where own depth is
    missing or incomplete, the estimate does. Both are noted.

    Attributes:
        own: with recorded poses and depth.
        estimated: with estimated poses and depth; None where there are none.
        own_share: of samples that are to have the own geometry; 2/3 for the paper's 2:1.
        seed: 0 or more.
    """

    own: Redrawable
    estimated: Redrawable | None = None
    own_share: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.own_share <= 1:
            raise OptionError(f"own share {self.own_share}; expected 0 to 1")
        if self.own_share == 0 and self.estimated is None:
            raise OptionError("own share 0 without estimated geometry; expected some geometry")

    def wants_own(self, start: int, count: int, attempt: int = 0) -> NDArray[np.bool_]:
        """(count,) whether the numbers from ``start`` on are to have the own geometry."""
        stream = [self.seed, MIXED, GEOMETRY, attempt]
        return stratified_at(start, count, stream=stream) < self.own_share

    def sample(self, index: int, attempt: int = 0) -> Sample:
        """The sample of a number, 0 or more; of each attempt another one.

        Raises:
            InvalidSampleError: as of the geometry that was taken.
        """
        if self.wants_own(index, 1, attempt)[0]:
            try:
                return _noted(self.own.sample(index, attempt), "own")
            except InvalidSampleError as error:
                if error.reason != DEPTH or self.estimated is None:
                    raise
            return _noted(self.estimated.sample(index, attempt), "estimated (own depth incomplete)")
        if self.estimated is None:
            return _noted(self.own.sample(index, attempt), "own (no estimate)")
        return _noted(self.estimated.sample(index, attempt), "estimated")

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        estimated = None if self.estimated is None else self.estimated.describe()
        own = {"own_share": self.own_share, "own": self.own.describe()}
        return {**own, "estimated": estimated, "seed": self.seed}


def stratified_at(start: int, count: int, *, stream: Sequence[int]) -> Float64:
    """(count,) numbers in [0, 1) from a place of a random stream on, found without those before.

    Each is uniform by itself. Every run of 1024, from a multiple of it, has one number in each
    1/1024 in random order, so that what is drawn by them keeps closer to its shares than by
    independent numbers: of fifteen sources, those miss three standard deviations with one seed in
    thirty.

    >>> whole = stratified_at(0, 10, stream=[1, 2])
    >>> bool((stratified_at(7, 2, stream=[1, 2]) == whole[7:9]).all())
    True
    >>> sorted(int(1024 * number) for number in stratified_at(2048, 1024, stream=[3])) == [
    ...     *range(1024)
    ... ]
    True

    Args:
        start: 0 or more.
        count: how many.
        stream: names it; numbers of 0 or more.
    """
    first, last = start // _RUN, -(-(start + count) // _RUN)
    key = np.random.SeedSequence(list(stream)).generate_state(2, np.uint64)
    bits = np.random.Philox(key=key)
    bits.advance(first * 2 * _RUN // _BLOCK)
    order, place = np.moveaxis(np.random.Generator(bits).random((last - first, 2, _RUN)), 1, 0)
    numbers = (order.argsort(1).argsort(1) + place) / _RUN
    return numbers.ravel()[start - first * _RUN :][:count]


def _noted(sample: Sample, text: str) -> Sample:
    return replace(sample, notes=(*sample.notes, f"{GEOMETRY_OF}/{text}"))


def _split(note: str) -> tuple[str, str]:
    kind, _, text = note.partition("/")
    return kind, text
