"""A memory's file: a zip of .npy members, versioned, checksummed, without pickle.

Every member carries the zip's CRC-32, and ``header.json`` lists each array's type and shape, so a
file that was cut short, altered or written by another version is refused by name. Saving the same
memory twice gives the same bytes.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, check_usable
from gvtools.errors import GvError, MemoryFileError
from gvtools.files import ZIP_EPOCH, replaced_when_written
from gvtools.memory.store.store import MemoryOptions, Store
from gvtools.memory.store.tile import fill, observation_arrays
from gvtools.memory.store.views import SourceView, ViewTable
from gvtools.memory.store.voxel_index import MOST_LEVEL
from gvtools.untrusted import parse_json, read_array, regular

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


def load_memory(path: Path, kind: Callable[..., S], **more: Any) -> S:
    """Read a memory of a class, see ``described``; every byte is checked."""
    header, arrays = _read(path)
    try:
        _check_consistency(arrays, len(header["names"]))
        empty = described(header, kind, **more)
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
    except (GvError, IndexError, KeyError, TypeError, ValueError) as error:
        raise MemoryFileError(f"{path}: the memory's parts do not fit together ({error})") from None
    return empty


def described(header: dict[str, Any], kind: Callable[..., S], **more: Any) -> S:
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
            version = header.get("version")
            if version != VERSION:
                raise MemoryFileError(
                    f"{path}: memory format version {version}; this gvtools reads version "
                    f"{VERSION}; run the reconstruction again"
                )
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


def _check_consistency(arrays: dict[str, NDArray[Any]], views: int) -> None:
    count = len(arrays["view"])
    columns = {
        "positions": (count, 3), "colors": (count, 3), "confidence": (count,),
        "spacing": (count,), "level": (count,),
        "view_K": (views, 3, 3), "view_cam_from_world": (views, 4, 4), "view_size": (views, 2),
        "view_round": (views,), "view_generated": (views,), "grid_shape": (views, 2),
    }  # fmt: skip
    for name, shape in columns.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} has shape {arrays[name].shape}, not {shape}")
    if "view_scanned" in arrays and arrays["view_scanned"].shape != (views,):
        raise ValueError(f"view_scanned has shape {arrays['view_scanned'].shape}, not ({views},)")
    for name, array in arrays.items():
        # Depth of free space, and boxes of nothing, may be infinite.
        bad = np.isnan(array) if name in ("grid_depth", "segment_box") else ~np.isfinite(array)
        if bad.any():
            raise ValueError(f"{name} holds numbers that are not finite")
    for name in ("spacing", "confidence"):
        if (arrays[name] < 0).any():
            raise ValueError(f"{name} is negative in places")
    rows = arrays["view"]
    if count and not (rows.min() >= 0 and rows.max() < views):
        raise ValueError("an observation names a view that is not there")
    level = arrays["level"]
    if level.dtype != np.uint8 or (count and level.max() > MOST_LEVEL):
        raise ValueError("an observation is of a level that is not there")
    start, length = arrays["segment_start"], arrays["segment_length"].astype(np.int64)
    if len(start) and not (start[0] == 0 and (start[1:] == (start + length)[:-1]).all()):
        raise ValueError("segments are not contiguous")
    if int(length.sum()) != count:
        raise ValueError("segments do not cover the observations")
    segment_view = arrays["segment_view"]
    if len(segment_view) and not (segment_view.min() >= 0 and segment_view.max() < views):
        raise ValueError("a segment names a view that is not there")
    if int(arrays["grid_shape"].prod(axis=1).sum()) != len(arrays["grid_depth"]):
        raise ValueError("the free-space grids do not fill their array")
