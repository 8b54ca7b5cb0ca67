"""HDF5 and OpenEXR files of data sets; their packages come with ``gvtools[data]``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.optional import require
from gvtools.untrusted import UNPACKED_BYTES, UNPACKED_RATIO, regular

if TYPE_CHECKING:
    import h5py


@contextmanager
def hdf5_file(path: Path) -> Iterator[h5py.File]:
    """The HDF5 file at ``path``, open for reading."""
    h5py = require("h5py", extra="data", purpose=f"{path}: HDF5", error=ProjectError)
    try:
        with h5py.File(regular(path), "r") as file:
            yield file
    except (OSError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise _unreadable(path, error) from None


def read_dataset(path: Path, found: Any) -> NDArray[Any]:
    """What a data set of an HDF5 file holds.

    Args:
        path: the file.
        found: of h5py.
    """
    size = path.stat().st_size
    if not hasattr(found, "nbytes"):
        raise ValueError("a group; expected an array")
    if found.nbytes > UNPACKED_RATIO * size + UNPACKED_BYTES:
        raise ValueError(f"an array of shape {found.shape} in {size} bytes")
    return np.asarray(found[()])


def hdf5_array(path: Path, key: str) -> NDArray[Any]:
    """One array of an HDF5 file.

    Args:
        path: the file.
        key: the array's name in it.
    """
    with hdf5_file(path) as file:
        if key not in file:
            raise KeyError(f"holds {', '.join(list(file)[:5]) or 'nothing'}; expected {key!r}")
        return read_dataset(path, file[key])


def exr_channel(path: Path, channels: tuple[str, ...]) -> NDArray[np.float32]:
    """(H, W) float32, one channel of an OpenEXR file.

    Args:
        path: the file.
        channels: names in order of preference; the first that is there is read.
    """
    OpenEXR = require("OpenEXR", extra="data", purpose=f"{path}: EXR", error=ProjectError)
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


def _unreadable(path: Path, error: Exception) -> ProjectError:
    if isinstance(error, FileNotFoundError):
        return ProjectError(f"{path}: no such file")
    reason = str(error.args[0] if error.args else error).splitlines()[0].replace(str(path), "")
    return ProjectError(
        f"{path}: unreadable ({reason}); expected a complete file; download it again"
    )
