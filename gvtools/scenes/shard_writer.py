"""Scenes converted to shards: each under its final name only when it is complete.

What a shard holds follows from where it begins, so that a conversion that was killed goes on with
the first shard that is absent or does not fit its checksum, and ends with the same bytes.
"""

from __future__ import annotations

import io
import json
import tarfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.files import make_folder, replaced_when_written, write_text
from gvtools.scenes.collection import SceneCollection
from gvtools.scenes.resized import check_max_side, reduced
from gvtools.scenes.scene import Scene
from gvtools.scenes.shards import (
    INDEX,
    ListedScene,
    ListedShard,
    Position,
    SceneRecord,
    ShardRecord,
    ShardsIndex,
    Skipped,
    ViewRecord,
    encoded,
    read_index,
    read_record,
    shard_name,
)
from gvtools.untrusted import read_json, sha256_of

CONVERSION = "conversion.json"
MEGABYTE = 10**6
_BLOCK = 512  # of a tar


@dataclass(frozen=True)
class ShardOptions:
    """How scenes become shards."""

    megabytes: float = 256  # a shard is closed by the view that reaches this size
    max_side: int | None = None  # pictures are reduced to it, pixels; None keeps every size

    def __post_init__(self) -> None:
        if not self.megabytes > 0:
            raise OptionError(f"shards of {self.megabytes} MB; expected more than 0")
        check_max_side(self.max_side)


@dataclass(frozen=True)
class WrittenShard:
    """A shard of a conversion, for those who follow it."""

    shard: ShardRecord
    before: bool  # whether it was complete before
    scenes: int  # all that are to be converted


def write_shards(
    collection: SceneCollection,
    out: Path,
    *,
    options: ShardOptions | None = None,
    progress: Callable[[WrittenShard], None] = lambda done: None,
) -> ShardsIndex:
    """Convert scenes, or go on with a conversion; what cannot be read is left out and listed."""
    options = options or ShardOptions()
    make_folder(out)
    _settle_description(collection, out, options)
    before = _listed_before(out)
    shards: list[ShardRecord] = []
    views = _Views(collection, max_side=options.max_side)
    while True:
        tar = out / shard_name(len(shards))
        complete = _complete(tar, views.position, before.get(tar.name))
        if complete is not None:
            views.position = complete.next
        shard = complete or _write_shard(views, tar, limit=options.megabytes * MEGABYTE)
        if shard is None:
            break
        shards.append(shard)
        progress(WrittenShard(shard, complete is not None, len(collection)))
    skipped = (*(item for shard in shards for item in shard.skipped), *views.skipped)
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


def _complete(tar: Path, start: Position, listed: ListedShard | None) -> ShardRecord | None:
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


class _Views:
    """All views of a collection in order, from any position on."""

    def __init__(self, collection: SceneCollection, *, max_side: int | None) -> None:
        self.collection, self.max_side = collection, max_side
        self.position: Position = (0, 0)
        self.skipped: list[Skipped] = []  # what could not be read since the last shard
        self._opened: tuple[int, Scene] | None = None

    def next(self) -> tuple[SceneRecord, ViewRecord, dict[str, bytes]] | None:
        """The next view that can be read, with its files; None at the end."""
        while self.position[0] < len(self.collection):
            number, place = self.position
            name = self.collection.names[number]
            scene = self._scene(number, name)
            if scene is None or place >= len(scene):
                self.position = (number + 1, 0)
                continue
            self.position = (number, place + 1)
            view = scene.views[place]
            try:
                files, camera = encoded(view, view.load(), {"scene": name, "metric": scene.metric})
            except GvError as error:
                self.skipped.append(Skipped(scene=name, view=view.name, reason=str(error)))
                continue
            about = SceneRecord(number=number, name=name, kind=scene.kind, metric=scene.metric)
            return about, ViewRecord(scene=number, view=place, members={}, **camera), files
        return None

    def _scene(self, number: int, name: str) -> Scene | None:
        if self._opened is None or self._opened[0] != number:
            try:
                scene = reduced(self.collection.read(name), self.max_side)
            except GvError as error:
                self.skipped.append(Skipped(scene=name, reason=str(error)))
                return None
            self._opened = (number, scene)
        return self._opened[1]


def _write_shard(views: _Views, tar: Path, *, limit: float) -> ShardRecord | None:
    """Write one shard, and its index after it; None where no view is left."""
    first = views.position
    item = views.next()
    if item is None:
        return None
    records: list[ViewRecord] = []
    scenes: dict[int, SceneRecord] = {}
    with replaced_when_written(tar) as temporary:
        with tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as archive:
            while item is not None:
                scene, view, files = item
                records.append(_added(archive, view, files))
                scenes.setdefault(scene.number, scene)
                item = None if archive.offset >= limit else views.next()
        size, checksum = temporary.stat().st_size, sha256_of(temporary)
    record = ShardRecord(
        file=tar.name,
        bytes=size,
        sha256=checksum,
        first=first,
        next=views.position,
        scenes=tuple(scenes.values()),
        views=tuple(records),
        skipped=tuple(views.skipped),
    )
    views.skipped = []
    write_text(tar.with_suffix(".json"), record.model_dump_json() + "\n")
    return record


def _added(archive: tarfile.TarFile, view: ViewRecord, files: dict[str, bytes]) -> ViewRecord:
    """Add a view's files; where each of them lies is part of the record."""
    places = {}
    for ending, content in files.items():
        # No date and no owner: equal views are equal bytes. Names of scenes and views may hold
        # signs that mean something in WebDataset's keys, so that keys are numbers.
        info = tarfile.TarInfo(f"{view.scene:06d}/{view.view:06d}.{ending}")
        info.size = len(content)
        archive.addfile(info, io.BytesIO(content))
        begin = archive.offset - -(-len(content) // _BLOCK) * _BLOCK
        places[ending] = (begin, len(content), zlib.crc32(content))
    return view.model_copy(update={"members": places})
