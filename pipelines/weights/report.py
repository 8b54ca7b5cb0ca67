"""What ``gvtools weights`` prints: the files that a configuration needs, and checked folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.completers.geoverse import config as configs
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import GeoVerse, empty_model
from gvtools.completers.geoverse.video_prior.config import VideoPriorConfig
from gvtools.completers.geoverse.weights.checks import PartReport
from gvtools.completers.geoverse.weights.published import (
    CONFIG_FILE,
    EXTENSION_FILE,
    VIDEO_FOLDER,
    VIDEO_SIZES,
    VIDEO_SOURCE,
    VIDEO_TERMS,
    WHOLE_FILE,
    Part,
    expected_of,
    is_extension,
    parts_of,
)
from gvtools.networks.tensors import Shapes, shapes

if TYPE_CHECKING:
    from pipelines.console import Console

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


def print_needed(entry: NeededFiles, console: Console) -> None:
    """The files of a configuration, published ones and one's own."""
    if entry.published:
        console.line(f"{entry.config}, from published files (sizes are approximate):")
        _print_files((*entry.published, *entry.beside), console)
        console.line(f"{entry.config}, in a folder of one's own, instead of the published files:")
        _print_files((entry.own,), console)
    else:
        console.line(f"{entry.config}: nothing of its size is published; a folder of one's own:")
        _print_files((entry.own, *entry.beside), console)


def _print_files(files: Sequence[NeededFile], console: Console) -> None:
    for file in files:
        figures = [
            "" if file.needed else "optional",
            "" if file.bytes is None else size_text(file.bytes),
            "" if file.tensors is None else f"{file.tensors} tensors",
            "" if file.parameters is None else f"{file.parameters:,} numbers",
            file.licence,
        ]
        console.line(f"  {file.path}")
        console.line(f"      {', '.join(filter(None, figures))}")
        console.line(f"      {file.note}")
        console.line(f"      from {file.source}")


def print_parts(
    folder: Path, config: GeoVerseConfig, parts: Sequence[PartReport], console: Console
) -> None:
    """A line a part, and whether the folder can be loaded."""
    console.line(f"{folder}, configuration {config.name}")
    width = max(len(part.name) for part in parts)
    for part in parts:
        mark = "does not fit" if not part.ok else "ok" if part.path else "absent"
        size = f", {size_text(part.bytes)}" if part.bytes else ""
        where = f" ({part.path.relative_to(folder)}{size})" if part.path else ""
        summary = part.summary.removeprefix("absent: ").removeprefix("absent, and not needed: ")
        console.line(f"  {part.name.ljust(width)}  {mark}{where}: {summary}")
    console.line(f"ok: {'true' if all(part.ok for part in parts) else 'false'}")


def size_text(count: int) -> str:
    """Bytes to three digits, in decimal units."""
    for unit, power in (("GB", 9), ("MB", 6), ("kB", 3)):
        if count >= 10**power:
            return f"{count / 10**power:.3g} {unit}"
    return f"{count} bytes"
