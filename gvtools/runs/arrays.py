"""Named arrays in a file that ``numpy.load`` reads, compressed where it pays.

Depth maps in float32 lose a fifth of their size by it, and take ten times as long to write; what is
mostly empty gets small.
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.files import ZIP_EPOCH

LEVEL = 1
# Bytes from the middle of an array that are tried, and the share of them that must be saved.
SAMPLE_BYTES, MIN_SAVED = 65536, 0.4


def save_arrays(target: Path | IO[bytes], **arrays: NDArray[Any]) -> None:
    """Write arrays by name, without pickle; equal arrays give equal bytes.

    Args:
        target: a path ending in .npz, or an open file.
        arrays: of numbers.
    """
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=LEVEL) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy", ZIP_EPOCH)
            if _pays(np.asarray(array)):
                info.compress_type = zipfile.ZIP_DEFLATED
            info._compresslevel = LEVEL  # type: ignore[attr-defined]
            with archive.open(info, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asarray(array), allow_pickle=False)


def _pays(array: NDArray[Any]) -> bool:
    """Whether compressing makes the array much smaller, by a part of it."""
    flat = array.reshape(-1)
    half = SAMPLE_BYTES // (2 * max(array.itemsize, 1))
    middle = len(flat) // 2
    part = np.ascontiguousarray(flat[max(middle - half, 0) : middle + half]).tobytes()
    return len(zlib.compress(part, LEVEL)) <= (1 - MIN_SAVED) * len(part)
