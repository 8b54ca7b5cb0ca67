"""What a folder of shards holds: ``index.json`` for all, ``shard-NNNNNN.json`` beside each tar.

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
# How many shards' indices a process keeps in memory.
KEPT_INDICES = 64
_CHUNK = 2**22

Position = tuple[int, int]
"""Number of a scene, number of a view in it: where a shard begins, and where the next one does."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


R = TypeVar("R", bound=_Record)


class ViewRecord(_Record):
    """One view of a shard."""

    scene: int
    """Number of its scene."""
    view: int
    """Number of the view in its scene."""
    name: str
    """Of the view."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    K: tuple[tuple[float, float, float], ...]
    """(3, 3), pixels, the first pixel's centre is (0.5, 0.5)."""
    cam_from_world: tuple[tuple[float, float, float, float], ...]
    """(4, 4), scene units."""
    depth_unit: float | None = None
    """Scene units of a stored value of 1, where depth is a 16-bit picture."""
    members: dict[str, tuple[int, int, int]]
    """By file extension, such as "depth.png": byte offset in the tar, size in bytes, CRC-32."""

    @property
    def has_depth(self) -> bool:
        """Whether there is a depth map."""
        return any(name.startswith("depth.") for name in self.members)


class SceneRecord(_Record):
    """One scene of which a shard holds views."""

    number: int
    """In the order of conversion."""
    name: str
    """Unique."""
    kind: str
    """Of the project that it was read from."""
    metric: bool
    """Whether scene units are metres."""


class Skipped(_Record):
    """What could not be converted."""

    scene: str
    """Its name."""
    view: str = ""
    """Name of the view; "" for a whole scene."""
    reason: str
    """As its reader says it."""


class ShardRecord(_Record):
    """One shard: the index beside its tar."""

    file: str
    """Name of the tar."""
    bytes: Annotated[int, Field(ge=0)]
    """Size of the tar."""
    sha256: str
    """Of the tar."""
    first: Position
    """Its first view."""
    next: Position
    """The first view after it."""
    scenes: tuple[SceneRecord, ...]
    """Scenes of its views."""
    views: tuple[ViewRecord, ...]
    """In the order of the tar."""
    skipped: tuple[Skipped, ...] = ()
    """Of what lies between ``first`` and ``next``."""


class ListedShard(_Record):
    """A shard as ``index.json`` lists it."""

    file: str
    """Name of the tar."""
    samples: int
    """Views."""
    bytes: int
    """Size of the tar."""
    sha256: str
    """Of the tar."""
    index_sha256: str
    """Of the index beside it."""


class ListedScene(_Record):
    """A scene as ``index.json`` lists it."""

    name: str
    """Unique."""
    views: int
    """All of them."""
    with_depth: int
    """Views that have depth."""
    shards: tuple[int, ...]
    """Numbers of the shards that hold its views."""


class ShardsIndex(_Record):
    """All shards of a folder; written when they are complete."""

    format: str = FORMAT
    """Tells shards from other folders."""
    version: int = VERSION
    """Of this file."""
    title: str
    """Of what was converted."""
    data_set: str = ""
    """Its spec, or ""."""
    max_side: int | None = None
    """Longest side that pictures were reduced to. [px]"""
    scenes: tuple[ListedScene, ...]
    """In the order of conversion."""
    shards: tuple[ListedShard, ...]
    """In order."""
    skipped: tuple[Skipped, ...] = ()
    """Views and scenes that could not be converted."""


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

    Args:
        path: of the file.
        checksum: as ``index.json`` lists it; part of the cache's key, so that a shard that was
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
