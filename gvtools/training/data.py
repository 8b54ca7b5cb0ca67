"""The samples of a training: procedural scenes, and recorded ones where the settings name some."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.errors import OptionError
from gvtools.files import digest
from gvtools.scenes.collection import SceneCollection
from gvtools.scenes.project import open_collection
from gvtools.training.batch import TrainingBatch
from gvtools.training.dataset import ContextChoice, ProceduralViews
from gvtools.training.dataset import Samples as DataSet
from gvtools.training.loader import PooledViews, batches
from gvtools.training.mixture import ROOMS, Mixture, OwnOrEstimated, Redrawable, SampleSource
from gvtools.training.options import SceneSource, TrainingSettings
from gvtools.training.sample import collate

if TYPE_CHECKING:
    from gvtools.training.scene_views import SceneViews


Draw = Callable[[SceneCollection], Redrawable]


@dataclass(frozen=True)
class _Opened:
    """A source with what its spec says of it."""

    collection: SceneCollection
    weight: float
    own_share: float


def recorded_sources(
    entries: Sequence[str | SceneSource], draw: Draw, *, share: float, seed: int
) -> tuple[SampleSource, ...]:
    """The sources of recorded scenes.

    ``seed``: 0 or more.
    """
    whole = [SceneSource(project=entry) if isinstance(entry, str) else entry for entry in entries]
    opened = [_opened(entry) for entry in whole]
    total = sum(each.weight for each in opened)
    sources: list[SampleSource] = []
    for entry, each in zip(whole, opened, strict=True):
        name = _unique(each.collection.title, [source.name for source in sources])
        samples = _samples(entry, each, draw, seed=seed)
        sources.append(SampleSource(name, share * each.weight / total, samples))
    return tuple(sources)


def _samples(entry: SceneSource, opened: _Opened, draw: Draw, *, seed: int) -> Redrawable:
    if entry.estimated is None:
        own = draw(opened.collection)
        return own if opened.own_share == 1 else OwnOrEstimated(own, None, opened.own_share, seed)
    estimated = draw(open_collection(entry.estimated))
    if opened.own_share == 0:
        return estimated
    return OwnOrEstimated(draw(opened.collection), estimated, opened.own_share, seed)


def _opened(entry: SceneSource) -> _Opened:
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
    return _Opened(collection, weight, own_share)


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
        self._train = self._data_set("train")
        self._data = self._pooled(self._train)

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
        made = batches(self._data, parts, workers=self.config.data.workers)
        with closing(made):
            yield from map(self._shown, made)

    def batch(self, samples: range) -> TrainingBatch:
        """The samples with these numbers."""
        return self._shown(collate([self._data.sample(index) for index in samples]))

    def aside(self, index: int, count: int) -> TrainingBatch:
        """Training scenes that no step sees."""
        group = self._context.group
        first = ASIDE // group * group + index * group
        data = self._train
        return collate([data.sample(first + n) for n in range(min(count, group))])

    def held_out(self, count: int) -> TrainingBatch:
        """Scenes of other photographs and layouts."""
        data = self._data_set("held-out")
        return self._shown(
            collate([data.sample(index) for index in range(min(count, self._context.group))])
        )

    def _pooled(self, data: DataSet) -> DataSet:
        options = self.config.data
        if not options.pool:
            return data
        return PooledViews(
            data, options.pool, None if options.cache is None else Path(options.cache)
        )

    def _shown(self, batch: TrainingBatch) -> TrainingBatch:
        return batch if self.config.data.projections else batch.unprojected

    def _data_set(self, split: str) -> DataSet:
        data = self.config.data
        rooms = ProceduralViews(
            seed=self.config.seed,
            split=split,
            views=data.views,
            size=data.size,
            context=self._context,
            faults=data.faults,
            fill=self._fill,
        )
        if not data.scenes or split != "train":
            return rooms
        seed, share = self.config.seed, data.scene_share
        recorded = recorded_sources(data.scenes, self._recorded, share=share, seed=seed)
        return Mixture((SampleSource(ROOMS, 1 - share, rooms), *recorded), seed)

    def _recorded(self, scenes: SceneCollection) -> SceneViews:
        from gvtools.training.scene_views import SceneViews

        data = self.config.data
        return SceneViews(
            scenes=scenes,
            select=data.scene_select,
            overlap=data.scene_overlap,
            seed=self.config.seed,
            views=data.views,
            size=data.size,
            context=self._context,
            faults=data.scene_faults,
            fill=self._fill,
        )
