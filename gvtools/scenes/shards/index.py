"""Indices of shards: ``index.json`` for all of a folder, ``shard-NNNNNN.json`` beside each tar.

``index.json`` says which shards hold a scene; only the indices of these are read to open it.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gvtools.errors import ProjectError
from gvtools.untrusted import read_bytes, regular

INDEX = "index.json"
FORMAT, VERSION = "gvtools shards", 1
KEPT_INDICES = 64  # of shards, in the memory of a process
_CHUNK = 2**22

# Number of a scene, number of a view in it: where a shard begins, and where the next one does.
Position = tuple[int, int]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


R = TypeVar("R", bound=_Record)


class ViewRecord(_Record):
    """One view of a shard."""

    scene: int  # number of its scene
    view: int  # its number in the scene
    name: str
    width: int  # pixels
    height: int
    # (3, 3), pixels, the first pixel's centre is (0.5, 0.5).
    K: tuple[tuple[float, float, float], ...]
    cam_from_world: tuple[tuple[float, float, float, float], ...]  # (4, 4), scene units
    # Scene units of a stored value of 1, where depth is a 16-bit picture.
    depth_unit: float | None = None
    # By file extension, such as "depth.png": byte offset in the tar, size in bytes, CRC-32.
    members: dict[str, tuple[int, int, int]]

    @property
    def has_depth(self) -> bool:
        """Whether there is a depth map."""
        return any(name.startswith("depth.") for name in self.members)


class SceneRecord(_Record):
    """One scene of which a shard holds views."""

    number: int  # in the order of conversion
    name: str  # unique
    kind: str  # of the project that it was read from
    metric: bool  # whether scene units are metres


class Skipped(_Record):
    """What could not be converted: a view, or with "" for it a whole scene."""

    scene: str
    view: str = ""
    reason: str  # as its reader says it


class ShardRecord(_Record):
    """One shard: the index beside its tar."""

    file: str  # name of the tar
    bytes: Annotated[int, Field(ge=0)]  # size of the tar
    sha256: str  # of the tar
    first: Position  # its first view
    next: Position  # the first view after it
    scenes: tuple[SceneRecord, ...]
    views: tuple[ViewRecord, ...]  # in the order of the tar
    skipped: tuple[Skipped, ...] = ()  # of what lies between ``first`` and ``next``


class ListedShard(_Record):
    """A shard as ``index.json`` lists it."""

    file: str  # name of the tar
    samples: int  # views
    bytes: int  # size of the tar
    sha256: str  # of the tar
    index_sha256: str  # of the index beside it


class ListedScene(_Record):
    """A scene as ``index.json`` lists it."""

    name: str  # unique
    views: int
    with_depth: int  # views that have depth
    shards: tuple[int, ...]  # numbers of the shards that hold its views


class ShardsIndex(_Record):
    """All shards of a folder; written when they are complete."""

    format: str = FORMAT
    version: int = VERSION
    title: str  # of what was converted
    data_set: str = ""  # its spec, or ""
    max_side: int | None = None  # longest side that pictures were reduced to, pixels
    scenes: tuple[ListedScene, ...]  # in the order of conversion
    shards: tuple[ListedShard, ...]
    skipped: tuple[Skipped, ...] = ()


def shard_name(number: int) -> str:
    """The tar of a number.

    >>> shard_name(7)
    'shard-000007.tar'
    """
    return f"shard-{number:06d}.tar"


def is_shards(folder: Path) -> bool:
    """Whether a folder holds complete shards."""
    path = folder / INDEX
    if not path.is_file():
        return False
    with regular(path).open("rb") as file:
        return f'"{FORMAT}"'.encode() in file.read(200)


def read_index(folder: Path) -> ShardsIndex:
    """The index of a folder of shards."""
    path = folder / INDEX
    if not path.is_file():
        raise ProjectError(
            f"{folder}: no {INDEX}; expected complete shards; run gvtools data shards to its end"
        )
    index = read_record(path, ShardsIndex)
    if (index.format, index.version) != (FORMAT, VERSION):
        raise ProjectError(
            f"{path}: {index.format!r} of version {index.version}; expected {FORMAT!r} of version "
            f"{VERSION}; convert again with this gvtools"
        )
    return index


@lru_cache(KEPT_INDICES)
def read_shard_index(path: Path, checksum: str) -> ShardRecord:
    """The index beside a shard; the last ones read are cached.

    Its checksum, as ``index.json`` lists it, is part of the cache's key, so that a shard that was
    converted anew is read again.
    """
    record = read_record(path, ShardRecord)
    if sha256_of(path) != checksum:
        raise ProjectError(
            f"{path}: damaged: its SHA-256 is not that of {INDEX}; run gvtools data shards again, "
            "which writes what is damaged anew"
        )
    return record


def read_record(path: Path, kind: type[R]) -> R:
    """A record from its JSON file."""
    try:
        return kind.model_validate_json(read_bytes(path))
    except (OSError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error.strerror
        raise ProjectError(
            f"{path}: unreadable ({reason}); run gvtools data shards again, which writes what is "
            "damaged anew"
        ) from None


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, as hex digits."""
    digest = hashlib.sha256()
    with regular(path).open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()
