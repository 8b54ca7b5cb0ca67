"""Samples from several sources in proportion to their weights, and the report of the sampling.

A sample's source follows from the seed and the sample's number (its index) alone: random numbers
are read from a counter-based generator at a position that the index gives. So sample 1000 is the
same on any number of processes and workers, and no earlier sample has to be drawn for it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import DegenerateError, OptionError
from gvtools.training.dataset import MIXED
from gvtools.training.sample import TrainingSample

# A scene cannot be opened, a view cannot be read, views hardly share anything, depth is missing.
SCENE, UNREADABLE, OVERLAP, DEPTH = "scene", "unreadable", "overlap", "depth"


class InvalidSampleError(DegenerateError):
    """A sample that is not to be learnt from.

    Attributes:
        reason: one of the above.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason

    def __reduce__(self) -> tuple[type[InvalidSampleError], tuple[str, str]]:
        # Errors travel from workers to the training.
        return type(self), (self.reason, str(self))


Float64 = NDArray[np.float64]

# After an invalid sample, another one is drawn from the same source, so that sources keep their
# shares: this many attempts in all. Then another source is drawn, until none is left.
TRIES = 10
# Which random stream: that which chooses the source, and that which chooses the geometry.
SOURCES, GEOMETRY = range(2)
# Random numbers that Philox makes in one step of its counter.
_BLOCK = 4
# Length of the blocks that ``stratified_at`` spreads evenly.
_RUN = 1024
# Name of the source of procedural rooms.
ROOMS = "rooms"
# Kinds of notes, which are ``KIND/SOURCE/...``: a sample of the source was drawn; one was invalid,
# for the reason that follows; whose geometry it has. Training counts them.
DRAWN, RESAMPLED, GEOMETRY_OF = "drawn", "resampled", "geometry"


class Redrawable(Protocol):
    """Samples by index, of which another one can be drawn where one is invalid."""

    def sample(self, index: int, attempt: int = 0) -> TrainingSample:
        """The sample of an index; each attempt gives another one."""
        ...

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        ...


@dataclass(frozen=True)
class SampleSource:
    """One source of a mixture."""

    name: str  # unique in a mixture; part of the notes
    weight: float  # 0 or more; its share of the samples is weight / sum of all weights
    samples: Redrawable  # drawn from it


@dataclass(frozen=True)
class Mixture:
    """Sources that samples are drawn from by weight."""

    sources: tuple[SampleSource, ...]  # at least one
    seed: int = 0  # 0 or more

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

    def choose_sources(
        self, start: int, count: int, *, without: Collection[int] = ()
    ) -> NDArray[np.int64]:
        """(count,) index of the source of each of the samples from ``start`` on.

        ``start``: number of the first sample, 0 or more. ``without``: indices of sources that are
        not to be drawn; another one with a weight above 0 has to remain.
        """
        numbers = stratified_at(start, count, stream=[self.seed, MIXED, SOURCES, len(without)])
        shares = np.where(np.isin(np.arange(len(self.sources)), list(without)), 0, self.shares)
        ends = np.cumsum(shares) / shares.sum()
        # If rounding leaves the last end below 1, the last source of weight above 0 gets the rest.
        last = int(np.flatnonzero(shares)[-1])
        return np.minimum(np.searchsorted(ends, numbers, side="right"), last)

    def sample(self, index: int) -> TrainingSample:
        """The sample of an index, 0 or more, with notes of its source and of invalid draws."""
        if index < 0:
            raise OptionError(f"sample {index}; expected a number of 0 or more")
        notes: list[str] = []
        failed: list[int] = []
        problem = ""
        while len(failed) < np.count_nonzero(self.shares):
            number = int(self.choose_sources(index, 1, without=failed)[0])
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
    """Samples with a data set's own poses and depth, or with estimated ones, at a given ratio.

    The GeoVerse paper mixes both. Where the estimate is to be used and there is none, the data
    set's own is; where own depth is missing or incomplete, the estimate is. Both cases are noted.
    """

    own: Redrawable  # samples with recorded poses and depth
    # samples with estimated poses and depth; None where there are none
    estimated: Redrawable | None = None
    # share of samples that are to have recorded geometry, 0 to 1; 2/3 for the paper's 2:1
    own_share: float = 1.0
    seed: int = 0  # 0 or more

    def __post_init__(self) -> None:
        if not 0 <= self.own_share <= 1:
            raise OptionError(f"own share {self.own_share}; expected 0 to 1")
        if self.own_share == 0 and self.estimated is None:
            raise OptionError("own share 0 without estimated geometry; expected some geometry")

    def wants_own(self, start: int, count: int, attempt: int = 0) -> NDArray[np.bool_]:
        """(count,) whether the samples from ``start`` on are to have recorded geometry."""
        stream = [self.seed, MIXED, GEOMETRY, attempt]
        return stratified_at(start, count, stream=stream) < self.own_share

    def sample(self, index: int, attempt: int = 0) -> TrainingSample:
        """The sample of an index, 0 or more; each attempt gives another one."""
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
    """(count,) random numbers in [0, 1): those at ``start``, ``start`` + 1, ... of a stream.

    They do not depend on ``start`` and ``count`` otherwise, and take no time for those before.

    Each number is uniform by itself, but each block of 1024 (from a multiple of 1024 on) is
    stratified: it has one number in every interval of length 1/1024, in random order. So the
    shares of what is drawn by them are closer to those wanted than with independent numbers, of
    which one seed in thirty has one of fifteen sources more than three standard deviations off.

    >>> whole = stratified_at(0, 10, stream=[1, 2])
    >>> bool((stratified_at(7, 2, stream=[1, 2]) == whole[7:9]).all())
    True
    >>> sorted(int(1024 * number) for number in stratified_at(2048, 1024, stream=[3])) == [
    ...     *range(1024)
    ... ]
    True

    ``start``: position in the stream, 0 or more. ``stream``: integers of 0 or more that name the
    stream, the seed among them.
    """
    first, last = start // _RUN, -(-(start + count) // _RUN)
    key = np.random.SeedSequence(list(stream)).generate_state(2, np.uint64)
    bits = np.random.Philox(key=key)
    bits.advance(first * 2 * _RUN // _BLOCK)
    order, place = np.moveaxis(np.random.Generator(bits).random((last - first, 2, _RUN)), 1, 0)
    numbers = (order.argsort(1).argsort(1) + place) / _RUN
    return numbers.ravel()[start - first * _RUN :][:count]


def _noted(sample: TrainingSample, text: str) -> TrainingSample:
    return replace(sample, notes=(*sample.notes, f"{GEOMETRY_OF}/{text}"))


def _split(note: str) -> tuple[str, str]:
    kind, _, text = note.partition("/")
    return kind, text


# Of the log's keys that count what drawing met: logged, and printed at the end.
NOTE_PREFIXES = tuple(f"{kind}/" for kind in (DRAWN, RESAMPLED, GEOMETRY_OF))


def sampling_report(counts: Mapping[str, int]) -> Iterator[str]:
    """One line for each source: how many samples, whose geometry, what was invalid and why.

    Args:
        counts: by note, see ``mixture``.

    >>> counts = {"drawn/rooms": 30, "drawn/kitchen": 10, "resampled/kitchen/overlap": 2}
    >>> list(sampling_report(counts))
    ['10 samples (25 %) of kitchen; drawn again: 2 overlap', '30 samples (75 %) of rooms']
    """
    parts = [(name.split("/", 2), count) for name, count in sorted(counts.items())]
    samples = {part[1]: count for part, count in parts if part[0] == DRAWN}
    total = sum(samples.values())
    for source in sorted({part[1] for part, _ in parts}):
        count = samples.get(source, 0)
        line = f"{count} samples ({count / max(total, 1):.0%}) of {source}".replace("%", " %")
        for kind, title in ((GEOMETRY_OF, "geometry"), (RESAMPLED, "drawn again")):
            found = [f"{n} {part[2]}" for part, n in parts if part[:2] == [kind, source]]
            line += f"; {title}: {', '.join(found)}" if found else ""
        yield line
