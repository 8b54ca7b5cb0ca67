"""Scenes converted to shards: each under its final name only when it is complete.

What a shard holds follows from where it begins, so that a conversion that was killed goes on with
the first shard that is absent or does not fit its checksum, and ends with the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gvtools.errors import OptionError, ProjectError
from gvtools.files import make_folder, write_text
from gvtools.scenes.collection import SceneCollection
from gvtools.scenes.reduced import check_max_side
from gvtools.scenes.shards.index import (
    INDEX,
    ListedScene,
    ListedShard,
    Position,
    ShardRecord,
    ShardsIndex,
    read_index,
    read_record,
    sha256_of,
    shard_name,
)
from gvtools.scenes.shards.walk import Walk, write_shard
from gvtools.untrusted import read_json

CONVERSION = "conversion.json"
MEGABYTE = 10**6


@dataclass(frozen=True)
class ShardOptions:
    """How scenes become shards.

    Attributes:
        megabytes: a shard is closed by the view that reaches this size.
        max_side: pictures are reduced to it, pixels; None keeps every size.
    """

    megabytes: float = 256
    max_side: int | None = None

    def __post_init__(self) -> None:
        if not self.megabytes > 0:
            raise OptionError(f"shards of {self.megabytes} MB; expected more than 0")
        check_max_side(self.max_side)


@dataclass(frozen=True)
class Progress:
    """What a conversion tells after each shard.

    Attributes:
        shard: its record.
        kept: whether it was complete before.
        scenes: all that are to be converted.
    """

    shard: ShardRecord
    kept: bool
    scenes: int


def write_shards(
    collection: SceneCollection,
    out: Path,
    *,
    options: ShardOptions | None = None,
    progress: Callable[[Progress], None] = lambda done: None,
) -> ShardsIndex:
    """Convert scenes, or go on with a conversion; what cannot be read is left out and listed.

    Args:
        collection: the scenes.
        out: the folder of the shards.
        options: see ShardOptions.
        progress: is called after each shard.
    """
    options = options or ShardOptions()
    make_folder(out)
    _settle_description(collection, out, options)
    before = _listed_before(out)
    shards: list[ShardRecord] = []
    walk = Walk(collection, max_side=options.max_side)
    while True:
        tar = out / shard_name(len(shards))
        kept = _kept(tar, walk.position, before.get(tar.name))
        if kept is not None:
            walk.go_to(kept.next)
        shard = kept or write_shard(walk, tar, limit=options.megabytes * MEGABYTE)
        if shard is None:
            break
        shards.append(shard)
        progress(Progress(shard, kept is not None, len(collection)))
    skipped = (*(item for shard in shards for item in shard.skipped), *walk.skipped)
    if not shards:
        why = f"; first: {skipped[0].reason}" if skipped else ""
        raise ProjectError(f"{collection.title}: no view could be converted{why}")
    _remove_others(out, len(shards))
    index = ShardsIndex(
        title=collection.title,
        data_set=collection.data_set,
        max_side=options.max_side,
        scenes=_listed_scenes(shards),
        shards=tuple(_listed(out, shard) for shard in shards),
        skipped=skipped,
    )
    write_text(out / INDEX, index.model_dump_json(indent=1) + "\n")
    return index


def _settle_description(collection: SceneCollection, out: Path, options: ShardOptions) -> None:
    """Write what is converted, or compare it with what was."""
    description = {
        "title": collection.title,
        "data_set": collection.data_set,
        "scenes": list(collection.names),
        "digest": collection.digest,
        "megabytes": options.megabytes,
        "max_side": options.max_side,
    }
    path = out / CONVERSION
    if not path.is_file():
        others = [entry.name for entry in out.iterdir() if not entry.name.endswith(".part")]
        if others:
            raise ProjectError(
                f"{out}: holds {sorted(others)[0]} and no {CONVERSION}; expected an empty folder, "
                "or a conversion to go on with; choose another"
            )
        write_text(path, json.dumps(description, indent=1) + "\n")
        return
    try:
        before = read_json(path)
    except ValueError:
        before = {}
    for name, value in description.items():
        if before.get(name) != value:
            shown = (f": {before.get(name)!r} then, {value!r} now", "")[name == "scenes"]
            raise OptionError(
                f"{out}: a conversion with other {name} lies there{shown}; give the same, or "
                "choose another --out"
            )


def _listed_before(out: Path) -> dict[str, ListedShard]:
    """The shards that a complete conversion listed, by file."""
    try:
        return {listed.file: listed for listed in read_index(out).shards}
    except ProjectError:
        return {}


def _kept(tar: Path, start: Position, listed: ListedShard | None) -> ShardRecord | None:
    """A shard that is complete, undamaged, and begins where it should."""
    path = tar.with_suffix(".json")
    try:
        shard = read_record(path, ShardRecord)
        fits = shard.first == start and tar.stat().st_size == shard.bytes
        fits = fits and (listed is None or sha256_of(path) == listed.index_sha256)
        return shard if fits and sha256_of(tar) == shard.sha256 else None
    except (ProjectError, OSError):
        return None


def _listed(out: Path, shard: ShardRecord) -> ListedShard:
    return ListedShard(
        file=shard.file,
        samples=len(shard.views),
        bytes=shard.bytes,
        sha256=shard.sha256,
        index_sha256=sha256_of((out / shard.file).with_suffix(".json")),
    )


def _listed_scenes(shards: Sequence[ShardRecord]) -> tuple[ListedScene, ...]:
    """The scenes of which there is at least one view, in order."""
    names = {scene.number: scene.name for shard in shards for scene in shard.scenes}
    views = dict.fromkeys(names, 0)
    with_depth = dict.fromkeys(names, 0)
    held: dict[int, list[int]] = {number: [] for number in names}
    for number, shard in enumerate(shards):
        for scene in shard.scenes:
            held[scene.number].append(number)
        for view in shard.views:
            views[view.scene] += 1
            with_depth[view.scene] += view.has_depth
    return tuple(
        ListedScene(name=names[n], views=views[n], with_depth=with_depth[n], shards=tuple(held[n]))
        for n in sorted(names)
    )


def _remove_others(out: Path, count: int) -> None:
    """Shards that an earlier, damaged state left behind the last one."""
    for path in out.glob("shard-*"):
        number = path.stem.removeprefix("shard-")
        if number.isdecimal() and int(number) >= count:
            path.unlink()
