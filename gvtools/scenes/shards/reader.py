"""Shards read as scenes: each view by its place in the tar, nothing is extracted.

Views are found by their numbers, so that any number of processes reads the same folder, each what
its own samples need.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable
from dataclasses import dataclass
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

AGAIN = "copy it again, or run gvtools data shards again"


def open_shards(folder: Path) -> SceneCollection:
    """The scenes of a folder of shards.

    Raises:
        ProjectError: the folder holds no complete shards.
    """
    index = read_index(folder)
    names = tuple(scene.name for scene in index.scenes)
    counts = tuple(scene.with_depth for scene in index.scenes)
    digest = hashlib.sha256((folder / INDEX).read_bytes()).hexdigest()[:16]
    read = ShardScenes(folder, index)
    return SceneCollection(index.title, names, read, counts, digest, index.data_set)


class ShardScenes:
    """Reads the scenes of a folder by name.

    Args:
        folder: of the shards.
        index: of the folder.
    """

    def __init__(self, folder: Path, index: ShardsIndex) -> None:
        self.folder, self.index = folder, index
        self._numbers = {scene.name: number for number, scene in enumerate(index.scenes)}

    def __call__(self, name: str) -> Scene:
        """The scene of a name.

        Raises:
            ProjectError: no such scene, or a shard of it is absent, cut off or damaged.
        """
        if name not in self._numbers:
            raise ProjectError(
                f"{self.folder}: no scene {name!r}; first of {len(self._numbers)}: "
                f"{next(iter(self._numbers))!r}"
            )
        views: list[View] = []
        found = None
        for number in self.index.scenes[self._numbers[name]].shards:
            listed = self.index.shards[number]
            tar = self.folder / listed.file
            _check_size(tar, listed)
            shard = read_shard_index(tar.with_suffix(".json"), listed.index_sha256)
            found = next(scene for scene in shard.scenes if scene.name == name)
            views += [_view(tar, view) for view in shard.views if view.scene == found.number]
        assert found is not None
        return Scene(self.folder / name, found.kind, tuple(views), metric=found.metric)


def verify(folder: Path, *, progress: Callable[[str], None] = lambda text: None) -> list[str]:
    """Compare every shard with its checksum; what is wrong, one line each.

    Args:
        folder: of the shards.
        progress: is told each shard's name before it is read.

    Raises:
        ProjectError: the folder holds no complete shards.
    """
    problems = []
    for listed in read_index(folder).shards:
        tar = folder / listed.file
        progress(listed.file)
        try:
            _check_size(tar, listed)
            index = tar.with_suffix(".json")
            for path, wanted in ((tar, listed.sha256), (index, listed.index_sha256)):
                _check_sum(path, wanted)
        except ProjectError as error:
            problems.append(str(error))
    return problems


def _check_size(tar: Path, listed: ListedShard) -> None:
    if not tar.is_file():
        raise ProjectError(f"{tar}: no such file; {INDEX} lists it; {AGAIN}")
    size = tar.stat().st_size
    if size != listed.bytes:
        raise ProjectError(f"{tar}: {size} bytes; {INDEX} says {listed.bytes}; {AGAIN}")


def _check_sum(path: Path, wanted: str) -> None:
    if not path.is_file():
        raise ProjectError(f"{path}: no such file; {INDEX} lists its shard; {AGAIN}")
    found = sha256_of(path)
    if found != wanted:
        raise ProjectError(
            f"{path}: damaged: its SHA-256 begins with {found[:12]}, {INDEX} says {wanted[:12]}; "
            f"{AGAIN}"
        )


def _view(tar: Path, record: ViewRecord) -> View:
    camera = Cameras(
        np.array(record.K)[None],
        np.array(record.cam_from_world)[None],
        np.array([record.width]),
        np.array([record.height]),
        (record.name,),
    )
    load = partial(_load, _Place(tar, record.members, record.depth_unit, record.name))
    return View(record.name, camera, load, record.has_depth, (tar,))


@dataclass(frozen=True)
class _Place:
    """Where a view's files lie in a tar, see ViewRecord."""

    tar: Path
    members: dict[str, tuple[int, int, int]]
    depth_unit: float | None
    name: str


def _load(place: _Place) -> Frame:
    where = f"{place.tar}, view {place.name}"
    members = {}
    try:
        with place.tar.open("rb") as file:
            for name, (offset, size, checksum) in place.members.items():
                file.seek(offset)
                content = file.read(size)
                if len(content) != size or zlib.crc32(content) != checksum:
                    raise ProjectError(
                        f"{where}: {name} is damaged; gvtools data verify {place.tar.parent} "
                        f"lists all that is; {AGAIN}"
                    )
                members[name] = content
    except OSError as error:
        raise ProjectError(f"{where}: unreadable ({error.strerror}); {AGAIN}") from None
    return decoded(members, depth_unit=place.depth_unit, where=where)
