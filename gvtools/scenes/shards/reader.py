"""Shards read as scenes.

A view's files are read at their byte offsets in the tar, which the index beside it lists. Nothing
is extracted, and any number of processes may read the same folder in any order.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.scenes.collection import SceneCollection
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.scenes.shards.index import (
    INDEX,
    ListedShard,
    ShardsIndex,
    ViewRecord,
    read_index,
    read_shard_index,
    sha256_of,
)
from gvtools.scenes.shards.members import decoded
from gvtools.untrusted import is_file, named_file, read_bytes, regular

AGAIN = "copy it again, or run gvtools data shards again"


def open_shards(folder: Path) -> SceneCollection:
    """The scenes of a folder of shards."""
    index = read_index(folder)
    names = tuple(scene.name for scene in index.scenes)
    counts = tuple(scene.with_depth for scene in index.scenes)
    digest = hashlib.sha256(read_bytes(folder / INDEX)).hexdigest()[:16]
    read = ShardScenes(folder, index)
    return SceneCollection(index.title, names, read, counts, digest, index.data_set)


class ShardScenes:
    """Called with a scene's name, opens that scene of a folder of shards."""

    def __init__(self, folder: Path, index: ShardsIndex) -> None:
        self.folder, self.index = folder, index
        self._numbers = {scene.name: number for number, scene in enumerate(index.scenes)}

    def __call__(self, name: str) -> Scene:
        """The scene of a name."""
        if name not in self._numbers:
            raise ProjectError(
                f"{self.folder}: no scene {name!r}; first of {len(self._numbers)}: "
                f"{next(iter(self._numbers))!r}"
            )
        views: list[View] = []
        found = None
        for number in self.index.scenes[self._numbers[name]].shards:
            if not 0 <= number < len(self.index.shards):
                raise ProjectError(f"{self.folder / INDEX}: names shard {number}; {AGAIN}")
            listed = self.index.shards[number]
            tar = named_file(self.folder, listed.file, where=str(self.folder / INDEX))
            _check_size(tar, listed)
            shard = read_shard_index(tar.with_suffix(".json"), listed.index_sha256)
            found = next((scene for scene in shard.scenes if scene.name == name), None)
            if found is None:
                raise ProjectError(f"{tar}: holds nothing of {name!r}, which {INDEX} says; {AGAIN}")
            views += [_view(tar, view) for view in shard.views if view.scene == found.number]
        if found is None:
            raise ProjectError(f"{self.folder / INDEX}: no shard of {name!r}; {AGAIN}")
        return Scene(self.folder / name, found.kind, tuple(views), metric=found.metric)


def verify(folder: Path, *, progress: Callable[[str], None] = lambda text: None) -> list[str]:
    """A line for each shard that is missing or does not fit its checksums.

    ``progress`` is called with each shard's file name before it is read.
    """
    problems = []
    for listed in read_index(folder).shards:
        tar = named_file(folder, listed.file, where=str(folder / INDEX))
        progress(listed.file)
        try:
            _check_size(tar, listed)
            index = tar.with_suffix(".json")
            for path, wanted in ((tar, listed.sha256), (index, listed.index_sha256)):
                if not path.is_file():
                    raise ProjectError(f"{path}: no such file; {INDEX} lists its shard; {AGAIN}")
                if (found := sha256_of(path)) != wanted:
                    raise ProjectError(
                        f"{path}: damaged: its SHA-256 begins with {found[:12]}, {INDEX} says "
                        f"{wanted[:12]}; {AGAIN}"
                    )
        except ProjectError as error:
            problems.append(str(error))
    return problems


def _check_size(tar: Path, listed: ListedShard) -> None:
    if not is_file(tar):
        raise ProjectError(f"{tar}: no such file; {INDEX} lists it; {AGAIN}")
    size = tar.stat().st_size
    if size != listed.bytes:
        raise ProjectError(f"{tar}: {size} bytes; {INDEX} says {listed.bytes}; {AGAIN}")


def _view(tar: Path, record: ViewRecord) -> View:
    camera = Cameras(
        np.array(record.K)[None],
        np.array(record.cam_from_world)[None],
        np.array([record.width]),
        np.array([record.height]),
        (record.name,),
    )
    return View(record.name, camera, partial(_load, tar, record), record.has_depth, (tar,))


def _load(tar: Path, record: ViewRecord) -> Frame:
    where, shape = f"{tar}, view {record.name}", (record.height, record.width)
    members = {}
    try:
        with regular(tar).open("rb") as file:
            for name, (offset, size, checksum) in record.members.items():
                file.seek(offset)
                content = file.read(size)
                if len(content) != size or zlib.crc32(content) != checksum:
                    raise ProjectError(
                        f"{where}: {name} is damaged; gvtools data verify {tar.parent} lists all "
                        f"that is; {AGAIN}"
                    )
                members[name] = content
    except OSError as error:
        raise ProjectError(f"{where}: unreadable ({error.strerror}); {AGAIN}") from None
    frame = decoded(members, depth_unit=record.depth_unit, where=where)
    shapes = {a.shape[:2] for a in (frame.rgb, frame.depth, frame.mask) if a is not None}
    if shapes != {shape}:
        raise ProjectError(f"{where}: pixels {shapes}; expected {shape}; {AGAIN}")
    if frame.depth is not None and not (np.isfinite(frame.depth) & (frame.depth >= 0)).all():
        raise ProjectError(f"{where}: depth that is not finite, or negative; {AGAIN}")
    return frame
