"""The samples of a training: procedural scenes, and recorded ones where the settings name some."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.files import digest
from gvtools.training.batch import TrainingBatch
from gvtools.training.context_choice import ContextChoice
from gvtools.training.dataset import ProceduralViews
from gvtools.training.dataset import Samples as DataSet
from gvtools.training.loader import batches
from gvtools.training.mixture import ROOMS, Mixture, Source
from gvtools.training.options import TrainingSettings
from gvtools.training.sample_pool import PooledViews
from gvtools.training.view_sample import collated

if TYPE_CHECKING:
    from gvtools.scenes.collection import SceneCollection
    from gvtools.training.scene_views import SceneViews

# Numbers of samples that no training step sees: for statistics.
ASIDE = 10**9


class TrainingSamples:
    """Batches of a training by the numbers of their samples.

    Args:
        config: of the training.
        model: whose context views a sample may have.
    """

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
            source.name: {
                "share": float(share),
                "digest": digest(source.samples.describe()),
            }
            for source, share in zip(self._train.sources, self._train.shares, strict=True)
        }

    def batches(self, parts: Iterable[range]) -> Generator[TrainingBatch, None, None]:
        """The batches of the samples with these numbers, made ahead."""
        made = batches(self._data, parts, workers=self.config.data.workers)
        with closing(made):
            yield from map(self._shown, made)

    def batch(self, samples: range) -> TrainingBatch:
        """The samples with these numbers."""
        return self._shown(collated([self._data.sample(index) for index in samples]))

    def aside(self, index: int, count: int) -> TrainingBatch:
        """Training scenes that no step sees."""
        group = self._context.group
        first = ASIDE // group * group + index * group
        data = self._train
        return collated([data.sample(first + n) for n in range(min(count, group))])

    def held_out(self, count: int) -> TrainingBatch:
        """Scenes of other photographs and layouts."""
        data = self._data_set("held-out")
        return self._shown(
            collated([data.sample(index) for index in range(min(count, self._context.group))])
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
        from gvtools.training.sources import recorded_sources

        seed, share = self.config.seed, data.scene_share
        recorded = recorded_sources(data.scenes, self._recorded, share=share, seed=seed)
        return Mixture((Source(ROOMS, 1 - share, rooms), *recorded), seed)

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
