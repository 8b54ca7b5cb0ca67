"""Sources of samples: rooms and recorded scenes, mixed by weight; the batches of a training.

A sample's source follows from the seed and the sample's number (its index) alone: random numbers
are read from a counter-based generator at a position that the index gives. So sample 1000 is the
same on any number of processes and workers, and no earlier sample has to be drawn for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.errors import DegenerateError, GvError, OptionError
from gvtools.files import digest
from gvtools.scenes.collection import SceneCollection
from gvtools.scenes.project import open_collection
from gvtools.settings import with_file
from gvtools.training.loader import PooledViews, batches
from gvtools.training.options import SHIPPED, SceneSource, TrainingSettings
from gvtools.training.samples import TrainingBatch, TrainingSample, collate
from gvtools.training.views import (
    MIXED,
    ContextChoice,
    InvalidSampleError,
    ProceduralViews,
    Samples,
    SceneViews,
)

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


class Redrawable(Samples, Protocol):
    """Samples by index, of which another one can be drawn where one is invalid."""

    def sample(self, index: int, attempt: int = 0) -> TrainingSample:
        """The sample of an index; each attempt gives another one."""
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

    @cached_property
    def shares(self) -> Float64:
        """(S,) expected share of each source."""
        weights = np.array([source.weight for source in self.sources], np.float64)
        return weights / weights.sum()

    def choose_sources(
        self, start: int, count: int, *, without: Collection[int] = ()
    ) -> NDArray[np.int64]:
        """(count,) index of the source of each of the samples from ``start`` on.

        Of the sources that are not ``without``, one with a weight above 0 has to remain.
        """
        numbers = stratified_at(start, count, stream=[self.seed, MIXED, SOURCES, len(without)])
        shares = np.where(np.isin(np.arange(len(self.sources)), list(without)), 0, self.shares)
        ends = np.cumsum(shares) / shares.sum()
        # If rounding leaves the last end below 1, the last source of weight above 0 gets the rest.
        last = int(np.flatnonzero(shares)[-1])
        return np.minimum(np.searchsorted(ends, numbers, side="right"), last)

    def sample(self, index: int) -> TrainingSample:
        """The sample of an index, with notes of its source and of invalid draws."""
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
                parts = [note.partition("/") for note in sample.notes]
                own = [f"{kind}/{source.name}/{text}" for kind, _, text in parts]
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
                if error.reason != "depth" or self.estimated is None:
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

    ``stream``: integers of 0 or more that name the stream, the seed among them.
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


# Of the log's keys that count what drawing met: logged, and printed at the end.
NOTE_PREFIXES = tuple(f"{kind}/" for kind in (DRAWN, RESAMPLED, GEOMETRY_OF))


def sampling_report(counts: Mapping[str, int]) -> Iterator[str]:
    """One line for each source: how many samples, whose geometry, what was invalid and why.

    >>> counts = {"drawn/rooms": 30, "drawn/kitchen": 10, "geometry/kitchen/own": 10}
    >>> counts["resampled/attic/overlap"] = 2
    >>> for line in sampling_report(counts):
    ...     print(line)
    0 samples (0 %) of attic; drawn again: 2 overlap
    10 samples (25 %) of kitchen; geometry: 10 own
    30 samples (75 %) of rooms
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


def recorded_sources(
    entries: Sequence[str | SceneSource],
    draw: Callable[[SceneCollection], Redrawable],
    *,
    share: float,  # of all samples, for these together
    seed: int,
) -> tuple[SampleSource, ...]:
    """The sources of recorded scenes."""
    whole = [SceneSource(project=entry) if isinstance(entry, str) else entry for entry in entries]
    opened = [open_source(entry) for entry in whole]
    total = sum(weight for _, weight, _ in opened)
    if not total:
        raise OptionError("data.scenes: every weight is 0; give one of them a weight above 0")
    sources: list[SampleSource] = []
    for entry, (collection, weight, own_share) in zip(whole, opened, strict=True):
        name = _unique(collection.title, [source.name for source in sources])
        estimated = None if entry.estimated is None else draw(open_collection(entry.estimated))
        own = draw(collection) if estimated is None or own_share > 0 else estimated
        samples = own
        if own_share < 1 or estimated is not None:
            samples = OwnOrEstimated(own, estimated, own_share, seed)
        sources.append(SampleSource(name, share * weight / total, samples))
    return tuple(sources)


def open_source(entry: SceneSource) -> tuple[SceneCollection, float, float]:
    """A source's scenes, their weight, and the share of samples with the data set's geometry."""
    root = None if entry.root is None else Path(entry.root)
    collection = open_collection(entry.project, root)
    weight, own_share = 0.0, 1.0
    if collection.data_set:
        from gvtools.scenes.data_sets.catalogue import load_spec

        spec = load_spec(collection.data_set)
        # One scene of a data set has no claim to the weight of all.
        weight = spec.weight if len(collection) > 1 else 0.0
        own_share = 1.0 if spec.geometry is None else spec.geometry.own_share
        if spec.depth is None:
            own_share = 0.0
        if own_share == 0 and entry.estimated is None:
            fallback = "" if spec.geometry is None else f" ({spec.geometry.fallback})"
            raise OptionError(
                f"{entry.project}: {spec.name} gives samples no geometry of its own{fallback}; "
                "name a project or shards with estimates as 'estimated', or leave it out"
            )
    if not weight and collection.counts is not None:
        weight = math.sqrt(sum(collection.counts))
    if entry.weight is not None:
        weight = entry.weight
    elif not weight:
        raise OptionError(
            f"{entry.project}: how many images {collection.title} has is not known; give its "
            "'weight'"
        )
    return collection, weight, own_share


# The paper's fifteen data sets with the square roots of their numbers of frames. As far as a folder
# of downloads holds them, a data set lies in ROOT/NAME, estimates of its poses and depth (Pi3's, in
# the paper) in ROOT/NAME_estimated; how often these stand for its own geometry, and when they have
# to, its spec says.
MIXTURE = SHIPPED / "base_mixture.json"


@dataclass(frozen=True)
class MixedDataSet:
    """A data set of the mixture, and what of it is there."""

    name: str
    share: float  # of samples; 0 where it cannot be used
    note: str  # its scenes and whose geometry they have, or why it is left out


def with_data(
    config: TrainingSettings, root: Path
) -> tuple[TrainingSettings, tuple[MixedDataSet, ...]]:
    """The training on what of the mixture lies in ``root``, all of its samples, and what does."""
    if not root.is_dir():
        raise OptionError(f"--data {root}: not a folder; expected downloads, as {root}/hypersim")
    whole = with_file(TrainingSettings(), MIXTURE).data
    used: list[SceneSource] = []
    notes = {}
    for entry in whole.scenes:
        assert isinstance(entry, SceneSource) and entry.root and entry.estimated
        folder, estimates = root / entry.root, root / entry.estimated
        here = entry.replaced(
            root=str(folder), estimated=str(estimates) if estimates.is_dir() else None
        )
        if not folder.is_dir():
            notes[entry.root] = f"no folder {folder}"
            continue
        try:
            collection, _, own = open_source(here)
            if here.estimated:
                open_collection(here.estimated)
        except GvError as error:
            notes[entry.root] = str(error)
            continue
        used.append(here)
        geometry = f"{own:.0%} own geometry" if here.estimated else "own geometry alone"
        notes[entry.root] = f"{len(collection)} scene(s), {geometry}"
    total = sum(entry.weight or 0 for entry in used)
    shares = {Path(str(e.root)).name: (e.weight or 0) / total for e in used}
    found = tuple(MixedDataSet(name, shares.get(name, 0.0), note) for name, note in notes.items())
    if not used:
        raise OptionError(
            f"--data {root}: none of the {len(notes)} data sets can be used, first "
            f"{found[0].name}: {found[0].note}; expected downloads in folders of these names "
            "(docs/training_data.md)"
        )
    data = config.data.replaced(scenes=tuple(used), scene_share=whole.scene_share)
    return config.replaced(data=data), found


def _unique(name: str, others: Sequence[str]) -> str:
    """A name that no other source has; "/" divides the parts of notes."""
    name = name.replace("/", " ")
    number, found = 1, name
    while found in (*others, ROOMS):
        number += 1
        found = f"{name} ({number})"
    return found


# Numbers of samples that no training step sees: for statistics.
ASIDE = 10**9


class TrainingSamples:
    """Batches of a training by the numbers of their samples."""

    def __init__(self, config: TrainingSettings, model: GeoVerseConfig) -> None:
        self.config = config
        most = min(model.context, config.data.views - 1)
        self._context = ContextChoice(most=most)
        self._fill = model.hints.fill
        self._train = self._data = self._data_set("train")
        if pool := config.data.pool:
            cache = config.data.cache
            self._data = PooledViews(self._train, pool, None if cache is None else Path(cache))

    @property
    def group(self) -> int:
        """So many samples in a row, from a multiple of it, have context views of one number."""
        return self._context.group

    @property
    def sources(self) -> dict[str, Any] | None:
        """What a mixture draws from, by source, to be compared when a training is continued.

        None where rooms are the only source, which follow from the settings.
        """
        if not isinstance(self._train, Mixture):
            return None
        return {
            source.name: {"share": float(share), "digest": digest(source.samples.describe())}
            for source, share in zip(self._train.sources, self._train.shares, strict=True)
        }

    def batches(self, parts: Iterable[range]) -> Generator[TrainingBatch, None, None]:
        """The batches of the samples with these numbers, made ahead."""
        with closing(batches(self._data, parts, workers=self.config.data.workers)) as stream:
            yield from map(self._projected, stream)

    def batch(self, samples: range) -> TrainingBatch:
        """The samples with these numbers."""
        return self._projected(collate([self._data.sample(index) for index in samples]))

    def aside(self, index: int, count: int) -> TrainingBatch:
        """Training scenes that no step sees."""
        group = self._context.group
        first = ASIDE // group * group + index * group
        data = self._train
        return collate([data.sample(first + n) for n in range(min(count, group))])

    def held_out(self, count: int) -> TrainingBatch:
        """Scenes of other photographs and layouts."""
        data, most = self._data_set("held-out"), min(count, self._context.group)
        return self._projected(collate([data.sample(index) for index in range(most)]))

    def _projected(self, batch: TrainingBatch) -> TrainingBatch:
        return batch if self.config.data.projections else batch.unprojected

    def _data_set(self, split: str) -> Samples:
        data, seed, share = self.config.data, self.config.seed, self.config.data.scene_share
        common: dict[str, Any] = {
            "seed": seed,
            "views": data.views,
            "size": data.size,
            "context": self._context,
            "fill": self._fill,
        }
        rooms = ProceduralViews(split=split, faults=data.faults, **common)
        if not data.scenes or split != "train":
            return rooms

        def windows(scenes: SceneCollection) -> SceneViews:
            return SceneViews(
                scenes=scenes,
                select=data.scene_select,
                overlap=data.scene_overlap,
                faults=data.scene_faults,
                **common,
            )

        recorded = recorded_sources(data.scenes, windows, share=share, seed=seed)
        return Mixture((SampleSource(ROOMS, 1 - share, rooms), *recorded), seed)
