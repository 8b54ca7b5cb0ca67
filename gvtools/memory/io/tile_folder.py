"""A memory in tiles as a folder: ``memory.index``, and a file for each tile.

A tile's file is never changed: another state of it has another name, so saving links the files that
are there already (a copy where the file system has no links). The folder is filled under a
temporary name and renamed: a kill leaves what was saved before.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError, MemoryFileError, ProjectError
from gvtools.files import flush_file, folder_replaced_when_written, recover_folder
from gvtools.memory.io.npz import VERSION, append_views, described, description, view_arrays
from gvtools.memory.store.array_file import ArrayFile, write_arrays
from gvtools.memory.store.store import Store
from gvtools.memory.store.tile import Tile, check, check_segments, read_segments
from gvtools.memory.store.voxel_index import MOST_LEVEL

S = TypeVar("S", bound=Store)

INDEX, SUFFIX = "memory.index", ".tiles"


def tile_folder(path: Path) -> Path:
    """The folder of tiles that goes with the path of a memory's file."""
    return path if path.suffix == SUFFIX else path.with_suffix(SUFFIX)


def save_tiles(memory: Store, folder: Path) -> Path:
    """Write a memory in tiles."""
    tiles = memory.tiles
    with tiles.lock, _replaced(folder) as new:
        table = []
        for number, tile in tiles:
            if tile.file is None or tile.dirty:
                tiles.write(number)
            assert tile.file is not None
            flush_file(tile.file)
            link(tile.file, new / tile.file.name)
            checksum = ArrayFile(tile.file).checksum
            table.append(
                [list(tile.node), tile.file.name, checksum, tile.size, tile.count, tile.voxels,
                 list(tile.agreed)]
            )  # fmt: skip
        meta = {
            **description(memory),
            "budget": memory.options.budget,
            "tiles": table,
            "divided": sorted(map(list, tiles.octree.divided)),
        }
        numbers = np.full(len(tiles.tiles), -1, np.int32)
        numbers[[number for number, _ in tiles]] = np.arange(len(table))
        places = tiles.places.rows()
        write_arrays(
            new / INDEX, meta,
            {
                **view_arrays(memory.views),
                "segment_tile": numbers[places["tile"]],
                "segment_local": places["local"],
                "segment_level": places["level"],
            },
        )  # fmt: skip
    # What only the earlier state had.
    names = {INDEX, *(entry[1] for entry in table)}
    for path in folder.iterdir():
        if path.name not in names:
            path.unlink(missing_ok=True)
    return folder


def load_tiles(
    kind: type[S], folder: Path, *, budget: int | None = None, scratch: Path | None = None
) -> S:
    """Read a memory of a class in tiles: the table of its segments; tiles when they are used.

    Tiles that change are written to ``scratch``; if it is given, all are linked into it at once, so
    that the folder may be removed. A ``budget`` of None is that it was saved with.
    """
    recover_folder(folder)
    index = ArrayFile(folder / INDEX)
    meta = index.meta
    if meta.get("version") != VERSION:
        raise MemoryFileError(
            f"{folder}: memory format version {meta.get('version')}; this gvtools reads version "
            f"{VERSION}; run the reconstruction again"
        )
    try:
        memory = described(
            meta, kind, budget=meta["budget"] if budget is None else budget, scratch=scratch
        )
        arrays = {name: index.array(name) for name in index.names}
        append_views(memory.views, meta["names"], arrays)
        _add_tiles(memory, folder, meta, arrays=arrays, scratch=scratch)
        return memory
    except MemoryFileError:
        raise
    except (AttributeError, GvError, IndexError, KeyError, TypeError, ValueError) as error:
        raise MemoryFileError(
            f"{folder}: the memory's parts do not fit together ({error})"
        ) from None


def _add_tiles(
    memory: Store, folder: Path, meta: dict[str, Any],
    *, arrays: dict[str, NDArray[Any]], scratch: Path | None,
) -> None:  # fmt: skip
    tiles = memory.tiles
    tiles.clear()
    tiles.octree.divided = {tuple(node) for node in meta["divided"]}
    of_tile, local = arrays["segment_tile"], arrays["segment_local"]
    unknown = len(of_tile) and not 0 <= of_tile.min() <= of_tile.max() < len(meta["tiles"])
    if unknown or int(arrays["segment_level"].max(initial=0)) > MOST_LEVEL:
        raise ValueError("a segment names a tile or a level that is not there")
    order = np.lexsort((local, of_tile))
    ends = np.searchsorted(of_tile[order], np.arange(len(meta["tiles"]) + 1))
    n = len(of_tile)
    start, length = np.empty(n, np.int64), np.empty(n, np.int32)
    view, box = np.empty(n, np.int32), np.empty((n, 7), np.float32)
    for i, (node, name, checksum, size, count, voxels, agreed) in enumerate(meta["tiles"]):
        if not all(
            type(n) is int and 0 <= n < 2**48 for n in (*node, size, count, voxels, *agreed)
        ):
            raise ValueError(f"tile {name!r}: of {node!r}, {size!r}, {count!r}, {voxels!r}")
        path = folder / Path(name).name
        tiles.write_after(path.name)
        file = ArrayFile(path)
        if file.checksum != checksum:
            raise MemoryFileError(
                f"{path}: is another state of the tile than {INDEX} names; restore it or run again"
            )
        if scratch is not None:
            path = tiles.folder / path.name
            link(file.path, path)
        rows = order[ends[i] : ends[i + 1]].astype(np.int32)
        segments = read_segments(file)
        check(file, len(rows) == segments.count and file.meta.get("count") == count)
        check(file, np.array_equal(local[rows], np.arange(len(rows))))
        check_segments(file, segments, len(memory.views))
        start[rows], length[rows] = segments.start[: len(rows)], segments.length[: len(rows)]
        view[rows], box[rows] = segments.view[: len(rows)], segments.box[: len(rows)]
        tile = Tile(
            tuple(node), rows, file=path, owned=scratch is not None, size=size, count=count,
            voxels=voxels, agreed=tuple(agreed),
        )  # fmt: skip
        tiles.add(tile)
    tiles.places.append(of_tile, local, start, level=arrays["segment_level"])
    memory.segments.follow(length, view, box)


def copy_tiles(source: Path, target: Path) -> None:
    """Make the tiles in a folder those of another, too, by links where there are any."""
    with _replaced(target) as new:
        for path in sorted(source.iterdir()):
            link(path, new / path.name)


def link(source: Path, target: Path) -> None:
    """Give a file a second name, or a copy where the file system has no links."""
    if target.exists() and target.samefile(source):
        return
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


@contextmanager
def _replaced(folder: Path) -> Iterator[Path]:
    """An empty folder that takes the place of ``folder``, which may be absent."""
    recover_folder(folder)
    if folder.exists():
        with folder_replaced_when_written(folder) as new:
            yield new
        return
    part = folder.with_name(f".{folder.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        yield part
        os.rename(part, folder)
    except OSError as error:
        raise ProjectError(
            f"{folder}: cannot be written ({error.strerror or error}); free some space or choose "
            "another folder"
        ) from error
    finally:
        with suppress(OSError):
            shutil.rmtree(part)
