"""Scenes in WebDataset shards: tar files of views, with an index that finds each view at once.

``index.json`` says which shards hold a scene, ``shard-NNNNNN.json`` beside each tar where a view's
files lie in it; only the indices of a scene's shards are read to open it. Nothing is extracted, and
any number of processes may read the same folder in any order.

A view is ``KEY.jpg`` or ``KEY.png`` with the picture, ``KEY.depth.png`` or ``KEY.depth.npz`` with
its depth where it has any, ``KEY.mask.png`` where it has a mask, and ``KEY.json`` with its camera.
All but a picture that was compressed with a loss already comes back bit by bit.
"""

from __future__ import annotations

import hashlib
import io
import json
import zlib
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.scenes.collection import SceneCollection
from gvtools.scenes.images import DEPTH_SATURATED
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.untrusted import (
    is_file,
    load_arrays,
    named_file,
    open_picture,
    other_version,
    read_bytes,
    reading,
    regular,
    sha256_of,
)

AGAIN = "copy it again, or run gvtools data shards again"
INDEX = "index.json"
FORMAT, VERSION = "gvtools shards", 1
KEPT_INDICES = 64  # of shards, in the memory of a process

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
            f"{VERSION}; {other_version(index.version, VERSION, 'convert again with this gvtools')}"
        )
    return index


@lru_cache(KEPT_INDICES)
def read_shard_index(path: Path, checksum: str) -> ShardRecord:
    """The index beside a shard, cached with its checksum, as ``index.json`` lists it."""
    record = read_record(path, ShardRecord)
    if sha256_of(path) != checksum:
        raise ProjectError(
            f"{path}: damaged: its SHA-256 is not that of {INDEX}; run gvtools data shards again, "
            "which writes what is damaged anew"
        )
    return record


def read_record(path: Path, kind: type[R]) -> R:
    """A record from its JSON file."""
    with reading(path, "run gvtools data shards again, which writes what is damaged anew"):
        return kind.model_validate_json(read_bytes(path))


# --- a view as files, and back ----------------------------------------------------------------

PICTURES = ("jpg", "png")
DEPTH_PNG, DEPTH_NPZ, MASK, CAMERA = "depth.png", "depth.npz", "mask.png", "json"
# Pictures from any other file are kept without a loss.
LOSSY = frozenset({".jpg", ".jpeg", ".webp", ".mp4", ".mov", ".avi", ".mkv", ".webm"})
JPEG = {"quality": 95, "subsampling": 0}
# Metres of a stored unit that depth of recordings has: millimetres, TUM RGB-D's.
UNITS = (0.001, 0.0002)


def encoded(
    view: View, frame: Frame, about: Mapping[str, Any]
) -> tuple[dict[str, bytes], dict[str, Any]]:
    """A view's files by the end of their names, and its camera as records have it."""
    lossy = any(path.suffix.lower() in LOSSY for path in view.files[:1])
    picture = Image.fromarray(frame.rgb)
    members = {"jpg": _saved(picture, "JPEG", **JPEG)} if lossy else {"png": _saved(picture)}
    unit = None
    if frame.depth is not None:
        unit = exact_unit(frame.depth)
        if unit is None:
            members[DEPTH_NPZ] = _arrays(depth=frame.depth)
        else:
            stored = np.rint(frame.depth / np.float32(unit)).astype(np.uint16)
            members[DEPTH_PNG] = _saved(Image.fromarray(stored))
    if frame.mask is not None:
        members[MASK] = _saved(Image.fromarray(frame.mask))
    camera = {
        "name": view.name,
        "width": int(view.camera.width[0]),
        "height": int(view.camera.height[0]),
        "K": view.camera.K[0].tolist(),
        "cam_from_world": view.camera.cam_from_world[0].tolist(),
        "depth_unit": unit,
    }
    members[CAMERA] = json.dumps({**camera, **about}).encode()
    return members, camera


def decoded(members: Mapping[str, bytes], *, depth_unit: float | None, where: str) -> Frame:
    """The pixels of a view from its files, by the end of their names."""
    with reading(where, "expected a view as gvtools data shards writes it; convert again"):
        picture = next(members[name] for name in PICTURES if name in members)
        rgb = np.array(open_picture(picture).convert("RGB"))
        depth = mask = None
        if DEPTH_PNG in members:
            raw = np.asarray(open_picture(members[DEPTH_PNG]))
            depth = raw.astype(np.float32) * np.float32(depth_unit or 1.0)
        elif DEPTH_NPZ in members:
            depth = load_arrays(members[DEPTH_NPZ], "depth")["depth"]
        if MASK in members:
            mask = np.asarray(open_picture(members[MASK])).astype(bool)
        return Frame(rgb, depth, mask)


def exact_unit(depth: NDArray[np.float32]) -> float | None:
    """The unit in which 16-bit numbers are exactly these depths; None where there is none."""
    for unit in UNITS:
        stored = np.rint(depth / np.float32(unit))
        fits = (stored >= 0) & (stored < DEPTH_SATURATED)
        if fits.all() and np.array_equal(stored * np.float32(unit), depth):
            return unit
    return None


def _saved(image: Image.Image, form: str = "PNG", **options: int) -> bytes:
    file = io.BytesIO()
    image.save(file, form, **options)
    return file.getvalue()


def _arrays(**arrays: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    # Members of the archive carry the date 1980-01-01, so that equal depth is equal bytes.
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


# --- reading ------------------------------------------------------------------------------------


def open_shards(folder: Path) -> SceneCollection:
    """The scenes of a folder of shards."""
    index = read_index(folder)
    names = tuple(scene.name for scene in index.scenes)
    counts = tuple(scene.with_depth for scene in index.scenes)
    digest = hashlib.sha256(read_bytes(folder / INDEX)).hexdigest()[:16]
    read = partial(_read_scene, folder=folder, index=index)
    return SceneCollection(index.title, names, read, counts, digest, index.data_set)


def _read_scene(name: str, *, folder: Path, index: ShardsIndex) -> Scene:
    scenes, views = list[SceneRecord](), list[View]()
    with reading(folder / INDEX, AGAIN):
        for number in next(scene for scene in index.scenes if scene.name == name).shards:
            listed = index.shards[number]
            tar = named_file(folder, listed.file, where=str(folder / INDEX))
            _check_size(tar, listed)
            shard = read_shard_index(tar.with_suffix(".json"), listed.index_sha256)
            scenes.append(next(scene for scene in shard.scenes if scene.name == name))
            own = scenes[-1].number
            views += [_view(tar, view) for view in shard.views if view.scene == own]
        kind, metric = scenes[-1].kind, scenes[-1].metric
    return Scene(folder / name, kind, tuple(views), metric=metric)


def verify(folder: Path, *, progress: Callable[[str], None] = lambda text: None) -> list[str]:
    """A line for each shard that is missing or does not fit its checksums."""
    problems = []
    for listed in read_index(folder).shards:
        tar = named_file(folder, listed.file, where=str(folder / INDEX))
        progress(listed.file)
        files = {tar: listed.sha256, tar.with_suffix(".json"): listed.index_sha256}
        wrong = [f for f, wanted in files.items() if not is_file(f) or sha256_of(f) != wanted]
        if wrong:
            problems.append(
                f"{wrong[0]}: damaged or absent: its SHA-256 is not that of {INDEX}; {AGAIN}"
            )
    return problems


def _check_size(tar: Path, listed: ListedShard) -> None:
    if not is_file(tar):
        raise ProjectError(f"{tar}: no such file; {INDEX} lists it; {AGAIN}")
    size = tar.stat().st_size
    if size != listed.bytes:
        raise ProjectError(f"{tar}: {size} bytes; {INDEX} says {listed.bytes}; {AGAIN}")


def _view(tar: Path, record: ViewRecord) -> View:
    size = record.width, record.height
    camera = Cameras.alike(record.K, record.cam_from_world, size=size, names=(record.name,))
    return View(record.name, camera, partial(_load, tar, record), record.has_depth, (tar,))


def _load(tar: Path, record: ViewRecord) -> Frame:
    where, members = f"{tar}, view {record.name}", {}
    with reading(where, AGAIN), regular(tar).open("rb") as file:
        for name, (offset, size, checksum) in record.members.items():
            file.seek(offset)
            content = file.read(size)
            if len(content) != size or zlib.crc32(content) != checksum:
                raise ProjectError(
                    f"{where}: {name} is damaged; gvtools data verify {tar.parent} lists all that "
                    f"is; {AGAIN}"
                )
            members[name] = content
    return decoded(members, depth_unit=record.depth_unit, where=where)
