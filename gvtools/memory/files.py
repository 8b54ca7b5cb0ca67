"""Files of a memory: a zip of arrays, or a folder of tiles."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, check_usable
from gvtools.errors import GvError, MemoryFileError
from gvtools.files import (
    ZIP_EPOCH,
    flush_file,
    folder_replaced_when_written,
    link_or_copy,
    recover_folder,
    replaced_when_written,
)
from gvtools.memory.store.array_file import ArrayFile, write_arrays
from gvtools.memory.store.store import MemoryOptions, Store
from gvtools.memory.store.tile import (
    Tile,
    check_fit,
    check_observations,
    fill,
    observation_arrays,
    read_segments,
)
from gvtools.memory.store.views import SourceView, ViewTable
from gvtools.memory.store.voxel_index import MOST_LEVEL
from gvtools.untrusted import other_version, parse_json, read_array, regular

S = TypeVar("S", bound=Store)

FORMAT = "gvtools memory"
VERSION = 4
CONVENTION = "OpenCV axes (x right, y down, z forward); first pixel's centre at (0.5, 0.5)"


def save_memory(memory: Store, path: Path) -> None:
    """Write ``memory`` to ``path``; an older file stays until the new one is whole."""
    arrays = _arrays(memory)
    header = {
        **description(memory),
        "arrays": {name: [array.dtype.str, list(array.shape)] for name, array in arrays.items()},
    }
    with (
        replaced_when_written(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive,
    ):
        _write(archive, "header.json", json.dumps(header, indent=1).encode())
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, array, allow_pickle=False)
            _write(archive, f"{name}.npy", buffer.getvalue())


def description(memory: Store) -> dict[str, Any]:
    """What a header says of a memory, JSON-ready."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "convention": CONVENTION,
        "voxel": memory.voxel.hex(),
        "origin": [float(x).hex() for x in memory.origin],
        "axes": [float(x).hex() for x in memory.frame.axes.ravel()],
        # Where a memory is kept does not belong to what it holds.
        "options": {k: v for k, v in memory.options.to_dict().items() if k != "budget"},
        "names": [memory.views[i].camera.names[0] for i in range(len(memory.views))],
    }


@contextmanager
def _fitting(path: Path) -> Iterator[None]:
    """Refuses parts of a memory that contradict each other, whatever that makes the code raise."""
    try:
        yield
    except MemoryFileError:
        raise
    except (AttributeError, GvError, IndexError, KeyError, TypeError, ValueError) as error:
        raise MemoryFileError(f"{path}: the memory's parts do not fit together ({error})") from None


def load_memory(path: Path, kind: Callable[..., S], **more: Any) -> S:
    """Read a memory of a class, see ``create_empty``; every byte is checked."""
    header, arrays = _read(path)
    with _fitting(path):
        check_observations(arrays, len(header["names"]))
        empty = create_empty(header, kind, **more)
        append_views(empty.views, header["names"], arrays)
        fill(empty.whole, arrays, empty.views)
        start = arrays["agreement_start"]
        for i, round_ in enumerate(arrays["agreement_round"].tolist()):
            rows = slice(int(start[i]), int(start[i + 1]))
            empty.whole.agree(
                arrays["agreement_row"][rows].copy(), arrays["agreement_weight"][rows].copy(),
                round=round_,
            )  # fmt: skip
        empty.whole.rebuild_index()
    return empty


def create_empty(header: dict[str, Any], kind: Callable[..., S], **more: Any) -> S:
    """An empty memory of a class as a header describes it; ``more``: options and arguments."""
    options = {k: more.pop(k) for k in list(more) if k in MemoryOptions.model_fields}
    return kind(
        float.fromhex(header["voxel"]),
        origin=[float.fromhex(x) for x in header["origin"]],
        axes=np.reshape([float.fromhex(x) for x in header["axes"]], (3, 3)),
        options=MemoryOptions(**header["options"], **options),
        **more,
    )


def _arrays(memory: Store) -> dict[str, NDArray[Any]]:
    """Observations, with the confidence that loading adds again left out, and views."""
    arrays = observation_arrays(memory.whole)
    agreements = {name: arrays.pop(name) for name in list(arrays) if name.startswith("agreement_")}
    del agreements["agreement_before"]
    arrays["confidence"] = memory.own_confidence()
    return arrays | view_arrays(memory.views) | agreements


def view_arrays(views: ViewTable) -> dict[str, NDArray[Any]]:
    """Cameras, rounds and free-space grids of the views as arrays."""
    cameras = views.cameras
    grids = [view.free_depth for view in views]
    scanned = {"view_scanned": views.scanned} if views.scanned.any() else {}
    return {
        **scanned,
        "view_K": cameras.K if cameras else np.zeros((0, 3, 3)),
        "view_cam_from_world": cameras.cam_from_world if cameras else np.zeros((0, 4, 4)),
        "view_size": np.stack([cameras.width, cameras.height], 1)
        if cameras
        else np.zeros((0, 2), np.int64),
        "view_round": views.round,
        "view_generated": views.generated,
        "grid_shape": np.array([g.shape for g in grids], np.int64).reshape(-1, 2),
        "grid_depth": np.concatenate([np.zeros(0, np.float32), *(g.ravel() for g in grids)]),
    }


def append_views(table: ViewTable, names: list[str], arrays: dict[str, NDArray[Any]]) -> None:
    """Add the views of ``view_arrays`` to an empty table."""
    _check_views(arrays, len(names))
    at = 0
    for i, name in enumerate(names):
        rows = slice(i, i + 1)
        camera = Cameras(
            arrays["view_K"][rows], arrays["view_cam_from_world"][rows],
            arrays["view_size"][rows, 0], arrays["view_size"][rows, 1], (name,),
        )  # fmt: skip
        check_usable(camera)
        height, width = arrays["grid_shape"][i].tolist()
        grid = arrays["grid_depth"][at : at + height * width].reshape(height, width).copy()
        at += height * width
        generated = bool(arrays["view_generated"][i])
        scanned = "view_scanned" in arrays and bool(arrays["view_scanned"][i])
        table.append(SourceView(camera, int(arrays["view_round"][i]), generated, grid, scanned))


def _write(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name, ZIP_EPOCH), data)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The header and its arrays, each checked against the zip's CRC and the header's list."""
    if not path.is_file():
        raise MemoryFileError(f"{path}: no such memory file")
    size = path.stat().st_size
    try:
        with zipfile.ZipFile(regular(path)) as archive:
            # A damaged directory may claim absurd sizes; nothing here is compressed.
            if sum(item.file_size for item in archive.infolist()) > size:
                raise MemoryFileError(f"{path}: its directory claims more bytes than the file has")
            header = parse_json(archive.read("header.json"))
            if not isinstance(header, dict) or header.get("format") != FORMAT:
                raise MemoryFileError(f"{path}: not a gvtools memory")
            _check_version(path, header.get("version"))
            arrays = {}
            for name, (dtype, shape) in header["arrays"].items():
                data = archive.read(f"{name}.npy")
                array = read_array(io.BytesIO(data), len(data))
                if array.dtype.str != dtype or list(array.shape) != shape:
                    raise MemoryFileError(f"{path}: array {name} is not what the header lists")
                arrays[name] = array
    except MemoryFileError:
        raise
    except Exception as error:  # any parser's complaint means the same to the user
        reason = f"{type(error).__name__}: {error}"
        raise MemoryFileError(
            f"{path}: damaged or truncated memory file ({reason}); restore it or run again"
        ) from None
    return header, arrays


def _check_version(path: Path, version: Any) -> None:
    if version != VERSION:
        raise MemoryFileError(
            f"{path}: memory format version {version}; this gvtools reads version {VERSION}; "
            f"{other_version(version, VERSION, 'run the reconstruction again')}"
        )


def _check_views(arrays: dict[str, NDArray[Any]], views: int) -> None:
    shapes = {
        "view_K": (views, 3, 3), "view_cam_from_world": (views, 4, 4), "view_size": (views, 2),
        "view_round": (views,), "view_generated": (views,), "view_scanned": (views,),
        "grid_shape": (views, 2),
    }  # fmt: skip
    if "view_scanned" not in arrays:
        del shapes["view_scanned"]
    for name, shape in shapes.items():
        found = arrays[name]
        fits = found.shape == shape and np.isfinite(found).all()
        check_fit(fits, f"{name} of shape {found.shape}; expected {shape}, finite")
    # Depth of free space may be infinite.
    grids = arrays["grid_depth"]
    filled = int(arrays["grid_shape"].prod(axis=1).sum()) == len(grids)
    known = filled and not np.isnan(grids).any()
    check_fit(known, "the free-space grids do not fill their array, or are not finite")


INDEX, SUFFIX = "memory.index", ".tiles"


def tile_folder(path: Path) -> Path:
    """The folder of tiles that goes with the path of a memory's file."""
    return path if path.suffix == SUFFIX else path.with_suffix(SUFFIX)


def save_tiles(memory: Store, folder: Path) -> Path:
    """Write a memory in tiles."""
    tiles = memory.tiles
    with tiles.lock, folder_replaced_when_written(folder) as new:
        table = []
        for number, tile in tiles:
            if tile.file is None or tile.dirty:
                tiles.write(number)
            assert tile.file is not None
            flush_file(tile.file)
            link_or_copy(tile.file, new / tile.file.name)
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
    _check_version(folder, meta.get("version"))
    with _fitting(folder):
        memory = create_empty(
            meta, kind, budget=meta["budget"] if budget is None else budget, scratch=scratch
        )
        arrays = {name: index.array(name) for name in index.names}
        append_views(memory.views, meta["names"], arrays)
        _add_tiles(memory, folder, meta, arrays=arrays, scratch=scratch)
    return memory


def _add_tiles(
    memory: Store, folder: Path, meta: dict[str, Any],
    *, arrays: dict[str, NDArray[Any]], scratch: Path | None,
) -> None:  # fmt: skip
    tiles = memory.tiles
    tiles.clear()
    tiles.octree.divided = {tuple(node) for node in meta["divided"]}
    of_tile, local = arrays["segment_tile"], arrays["segment_local"]
    known = not len(of_tile) or 0 <= of_tile.min() <= of_tile.max() < len(meta["tiles"])
    known &= int(arrays["segment_level"].max(initial=0)) <= MOST_LEVEL
    check_fit(known, "a segment names a tile or a level that is not there")
    order = np.lexsort((local, of_tile))
    ends = np.searchsorted(of_tile[order], np.arange(len(meta["tiles"]) + 1))
    n = len(of_tile)
    start, length = np.empty(n, np.int64), np.empty(n, np.int32)
    view, box = np.empty(n, np.int32), np.empty((n, 7), np.float32)
    for i, (node, name, checksum, size, count, voxels, agreed) in enumerate(meta["tiles"]):
        numbers = (*node, size, count, voxels, *agreed)
        whole = all(type(n) is int and 0 <= n < 2**48 for n in numbers)
        check_fit(whole, f"tile {name!r}: of {node!r}, {size!r}, {count!r}, {voxels!r}")
        path = folder / Path(name).name
        tiles.write_after(path.name)
        file = ArrayFile(path)
        if file.checksum != checksum:
            raise MemoryFileError(
                f"{path}: is another state of the tile than {INDEX} names; restore it or run again"
            )
        if scratch is not None:
            path = tiles.folder / path.name
            link_or_copy(file.path, path)
        rows = order[ends[i] : ends[i + 1]].astype(np.int32)
        segments = read_segments(file, len(memory.views))
        fits = len(rows) == segments.count and file.meta.get("count") == count
        if not fits or not np.array_equal(local[rows], np.arange(len(rows))):
            raise MemoryFileError(f"{path}: the tile's parts do not fit together; run again")
        start[rows], length[rows] = segments.start[: len(rows)], segments.length[: len(rows)]
        view[rows], box[rows] = segments.view[: len(rows)], segments.box[: len(rows)]
        tile = Tile(
            tuple(node), rows, file=path, owned=scratch is not None, size=size, count=count,
            voxels=voxels, agreed=tuple(agreed),
        )  # fmt: skip
        tiles.add(tile)
    tiles.places.append_rows(of_tile, local, start, arrays["segment_level"])
    memory.segments.follow(length, view, box)


def copy_tiles(source: Path, target: Path) -> None:
    """Make the tiles in a folder those of another, too, by links where there are any."""
    with folder_replaced_when_written(target) as new:
        for path in sorted(source.iterdir()):
            link_or_copy(path, new / path.name)
