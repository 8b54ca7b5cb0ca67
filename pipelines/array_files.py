"""Named arrays in a file that ``numpy.load`` reads, compressed where it pays.

Depth maps in float32 lose a fifth of their size by it, and take ten times as long to write.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.files import ZIP_EPOCH

LEVEL = 1


def save_arrays(target: Path | IO[bytes], **arrays: NDArray[Any]) -> None:
    """Write arrays by name, without pickle; equal arrays give equal bytes.

    Args:
        target: a path ending in .npz, or an open file.
        arrays: of numbers.
    """
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=LEVEL) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy", ZIP_EPOCH)
            if np.asarray(array).dtype.kind != "f":
                info.compress_type = zipfile.ZIP_DEFLATED
            info._compresslevel = LEVEL  # type: ignore[attr-defined]
            with archive.open(info, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asarray(array), allow_pickle=False)
