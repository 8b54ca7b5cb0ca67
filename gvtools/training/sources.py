"""The recorded sources of a training, from the addresses that its settings name."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gvtools.errors import OptionError
from gvtools.scenes.collection import SceneCollection
from gvtools.scenes.project import open_collection
from gvtools.training.mixture import ROOMS, OwnOrEstimated, Redrawable, Source
from gvtools.training.options import SceneSource

Draw = Callable[[SceneCollection], Redrawable]


@dataclass(frozen=True)
class _Opened:
    """A source with what its spec says of it."""

    collection: SceneCollection
    weight: float
    own_share: float


def recorded_sources(
    entries: Sequence[str | SceneSource], draw: Draw, *, share: float, seed: int
) -> tuple[Source, ...]:
    """The sources of recorded scenes.

    Args:
        entries: of the settings.
        draw: makes the samples of scenes.
        share: of all samples, to be divided among them by weight.
        seed: 0 or more.
    """
    whole = [SceneSource(project=entry) if isinstance(entry, str) else entry for entry in entries]
    opened = [_opened(entry) for entry in whole]
    total = sum(each.weight for each in opened)
    sources: list[Source] = []
    for entry, each in zip(whole, opened, strict=True):
        name = _unique(each.collection.title, [source.name for source in sources])
        samples = _samples(entry, each, draw, seed=seed)
        sources.append(Source(name, share * each.weight / total, samples))
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
