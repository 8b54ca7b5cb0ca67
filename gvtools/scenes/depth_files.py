"""Depth maps in HDF5, OpenEXR, PFM and raw files; their packages come with ``gvtools[data]``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.optional import require
from gvtools.scenes.images import readings
from gvtools.untrusted import UNPACKED_BYTES, UNPACKED_RATIO, regular

if TYPE_CHECKING:
    import h5py

Depth = NDArray[np.float32]


@contextmanager
def hdf5_file(path: Path) -> Iterator[h5py.File]:
    """The HDF5 file at ``path``, open for reading."""
    h5py = require("h5py", extra="data", purpose=f"{path}: HDF5")
    try:
        with h5py.File(regular(path), "r") as file:
            yield file
    except (OSError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise _unreadable(path, error) from None


def read_dataset(path: Path, found: Any) -> NDArray[Any]:
    """A data set of h5py, of the HDF5 file at ``path``."""
    size = path.stat().st_size
    if not hasattr(found, "nbytes"):
        raise ValueError("a group; expected an array")
    if found.nbytes > UNPACKED_RATIO * size + UNPACKED_BYTES:
        raise ValueError(f"an array of shape {found.shape} in {size} bytes")
    return np.asarray(found[()])


def hdf5_array(path: Path, key: str) -> NDArray[Any]:
    """The array of that name in an HDF5 file."""
    with hdf5_file(path) as file:
        if key not in file:
            raise KeyError(f"holds {', '.join(list(file)[:5]) or 'nothing'}; expected {key!r}")
        return read_dataset(path, file[key])


def hdf5_depth(path: Path, *, key: str) -> Depth:
    """(H, W) float32 z-depth in an array of an HDF5 file, 0 for none."""
    depth = np.squeeze(hdf5_array(path, key))
    if depth.ndim != 2:
        raise ProjectError(f"{path}, {key}: shape {depth.shape}; expected (height, width)")
    return readings(depth)


def exr_channel(path: Path, channels: tuple[str, ...]) -> NDArray[np.float32]:
    """(H, W) float32 of an OpenEXR file: the first of the channels that is there."""
    OpenEXR = require("OpenEXR", extra="data", purpose=f"{path}: EXR")
    if not path.is_file():
        raise ProjectError(f"{path}: no such file")
    try:
        # Else R, G and B come as one array.
        with OpenEXR.File(str(path), separate_channels=True) as file:
            found = dict(file.channels())
            for name in channels:
                if name in found:
                    return np.array(found[name].pixels, np.float32)
    except (OSError, RuntimeError, ValueError) as error:
        raise _unreadable(path, error) from None
    raise ProjectError(
        f"{path}: holds the channels {', '.join(sorted(found))}; expected {' or '.join(channels)}"
    )


def exr_depth(path: Path, *, channels: tuple[str, ...]) -> Depth:
    """(H, W) float32 z-depth in a channel of an OpenEXR file, 0 for none."""
    return readings(exr_channel(path, channels))


def read_pfm_depth(path: Path, *, unit: float = 1.0) -> Depth:
    """(H, W) float32 z-depth of a grey PFM file, whose rows run from the bottom up; 0 for none."""
    try:
        with regular(path).open("rb") as file:
            kind = file.readline().split()
            width, height = (int(word) for word in file.readline().split())
            dtype = np.dtype("<f4" if float(file.readline()) < 0 else ">f4")
            if kind != [b"Pf"]:
                raise ValueError(f"it begins with {kind}, not with Pf")
            values = np.frombuffer(file.read(width * height * 4), dtype).reshape(height, width)
    except (OSError, ValueError) as error:
        raise ProjectError(f"{path}: no grey PFM ({error}); copy or export it again") from None
    return readings(values[::-1], unit=unit)


def _unreadable(path: Path, error: Exception) -> ProjectError:
    if isinstance(error, FileNotFoundError):
        return ProjectError(f"{path}: no such file")
    reason = str(error.args[0] if error.args else error).splitlines()[0].replace(str(path), "")
    return ProjectError(
        f"{path}: unreadable ({reason}); expected a complete file; download it again"
    )
