"""Which files a configuration needs, where they are published, how large they are."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache
from math import prod
from typing import Any

from gvtools.completers.geoverse import config as configs
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.video_prior.config import VideoPriorConfig
from gvtools.completers.geoverse.weights.checkpoints import (
    Shapes,
    expected_of,
    is_extension,
    shapes,
)
from gvtools.completers.geoverse.weights.folder_parts import empty_model
from gvtools.completers.geoverse.weights.published import (
    CONFIG_FILE,
    EXTENSION_FILE,
    VIDEO_FOLDER,
    VIDEO_SIZES,
    VIDEO_SOURCE,
    VIDEO_TERMS,
    WHOLE_FILE,
    Part,
    parts_of,
)

_FLOAT32 = 4
_OWN = "one's own: gvtools train, or gvtools weights create for an untrained one"


@dataclass(frozen=True)
class NeededFile:
    """One file, or the folder of the video prior.

    Attributes:
        name: of the part.
        path: where it belongs in a weights folder.
        source: who publishes it.
        licence: its terms; empty for what one makes oneself.
        needed: False for what the model can do without.
        tensors: that it has to hold.
        parameters: numbers in them.
        bytes: about as many: of the numbers as they are published or written, without headers;
            None where they are not known.
        note: what it is for.
    """

    name: str
    path: str
    source: str
    licence: str
    needed: bool
    tensors: int | None
    parameters: int | None
    bytes: int | None
    note: str


@dataclass(frozen=True)
class NeededFiles:
    """What a weights folder of a configuration holds.

    Attributes:
        config: its name.
        published: files as they are downloaded; empty where nothing of this size is published.
        own: the file that takes their place in a folder of one's own, beside ``config.json``.
        beside: what either of the two may have or has to have beside it.
    """

    config: str
    published: tuple[NeededFile, ...]
    own: NeededFile
    beside: tuple[NeededFile, ...]

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        return asdict(self)


def needed_files(config: GeoVerseConfig) -> NeededFiles:
    """What a folder of ``config`` holds; sizes by our own lists of names and shapes.

    Raises:
        CheckpointError: no network comes of the configuration.
    """
    model = empty_model(config, where="the configuration")
    whole = shapes(model.state_dict())
    own = NeededFile(
        "geoverse",
        WHOLE_FILE,
        _OWN,
        "",
        True,
        len(whole),
        _numbers(whole),
        _FLOAT32 * _numbers(whole),
        f"every tensor, beside {CONFIG_FILE}; half as large in float16 or bfloat16",
    )
    published = _published(model)
    beside = []
    added = {name: shape for name, shape in whole.items() if is_extension(name)}
    if added and published:
        beside.append(
            NeededFile(
                "extension",
                EXTENSION_FILE,
                "one's own, of a model trained on published files: save_extension",
                "",
                False,
                len(added),
                _numbers(added),
                _FLOAT32 * _numbers(added),
                "what GeoVerse adds to the published networks; untrained where it is absent",
            )
        )
    if config.video is not None:
        beside.append(_video(config.video))
    return NeededFiles(config.name, published, own, tuple(beside))


def _published(model: GeoVerse) -> tuple[NeededFile, ...]:
    """The published files, if they are of the model's sizes."""
    known = _published_shapes()
    expected = {part: expected_of(model, part) for part in parts_of(model.config)}
    if any(found != known[part.name] for part, found in expected.items()):
        return ()
    return tuple(_file(part, found) for part, found in expected.items())


@lru_cache(maxsize=1)
def _published_shapes() -> dict[str, Shapes]:
    """What the published files hold, by part: they are of the base configuration."""
    base = configs.named("base")
    model = empty_model(base, where="base")
    return {part.name: expected_of(model, part) for part in parts_of(base)}


def _file(part: Part, expected: Shapes) -> NeededFile:
    twice = {name for names in part.tied for name in names[1:]}
    stored = {name: shape for name, shape in expected.items() if name not in twice}
    numbers = _numbers(stored)
    return NeededFile(
        part.name,
        part.files[0],
        part.source,
        part.licence,
        not part.optional,
        len(stored),
        numbers,
        part.stated_bytes or _FLOAT32 * numbers,
        part.note,
    )


def _video(config: VideoPriorConfig) -> NeededFile:
    usual = VideoPriorConfig()
    known = (config.taps, config.channels) == (usual.taps, usual.channels)
    tensors, numbers, size = (sum(column) for column in zip(*VIDEO_SIZES.values(), strict=True))
    return NeededFile(
        "video",
        f"{VIDEO_FOLDER}/",
        VIDEO_SOURCE if known else "a Wan VACE model of the configuration's width",
        VIDEO_TERMS if known else "",
        True,
        tensors if known else None,
        numbers if known else None,
        size if known else None,
        "the video prior, made by gvtools weights truncate-wan and empty-prompt; needs diffusers "
        "(pip install 'gvtools[wan]')",
    )


def _numbers(tensors: Shapes) -> int:
    return sum(prod(shape) for shape in tensors.values())
