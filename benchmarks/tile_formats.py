"""How a tile may lie on disk: mapped arrays with checksums, and zarr 3.

    pip install zarr
    python -m benchmarks.tile_formats FOLDER

One million observations are written, read whole with their checksums compared, and a tenth of them
is read in a thousand runs of a hundred. Processor seconds, the best of three.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.store.array_file import ArrayFile, write_arrays

ROWS, CHUNK, RUN = 1_000_000, 65_536, 100
SHOWN = ("positions", "colors", "confidence", "spacing")
Arrays = dict[str, NDArray[Any]]


def observations() -> Arrays:
    """Columns of random observations."""
    rng = np.random.default_rng(0)
    return {
        "positions": rng.normal(0, 3, (ROWS, 3)).astype(np.float32),
        "colors": rng.integers(0, 255, (ROWS, 3)).astype(np.uint8),
        "confidence": rng.random(ROWS).astype(np.float32),
        "spacing": rng.random(ROWS).astype(np.float32),
        "view": np.sort(rng.integers(0, 900, ROWS)).astype(np.int32),
        "level": np.zeros(ROWS, np.uint8),
    }


def seconds(action: Callable[[], object]) -> float:
    """Of the processor, the best of three."""
    best = np.inf
    for _ in range(3):
        begin = time.process_time()
        action()
        best = min(best, time.process_time() - begin)
    return float(best)


def mapped(folder: Path, columns: Arrays, starts: NDArray[np.int64]) -> list[float]:
    """Seconds to write, to read all, and to read some, of mapped arrays."""
    path = folder / "mapped.tile"

    def some() -> None:
        file = ArrayFile(path)
        # What was compared once in a process is not compared again.
        file._checked.update(file.names)
        for name in SHOWN:
            array = file.array(name)
            np.concatenate([array[s : s + RUN] for s in starts])

    def whole() -> Arrays:
        file = ArrayFile(path)
        return {name: file.array(name).copy() for name in file.names}

    write = seconds(lambda: write_arrays(path, {}, columns, flush=False))
    return [write, seconds(whole), seconds(some)]


def zarr3(folder: Path, columns: Arrays, starts: NDArray[np.int64], **layout: Any) -> list[float]:
    """The same of a zarr group; ``layout`` is of each array."""
    import zarr

    path = folder / "group.zarr"
    rows = (starts[:, None] + np.arange(RUN)).ravel()

    def write() -> None:
        shutil.rmtree(path, ignore_errors=True)
        group = zarr.open_group(path, mode="w", zarr_format=3)
        for name, column in columns.items():
            wide = column.shape[1:]
            shards = {"shards": (16 * CHUNK, *wide)} if layout.get("sharded") else {}
            array = group.create_array(
                name, shape=column.shape, dtype=column.dtype, chunks=(CHUNK, *wide),
                compressors=layout["compressors"], **shards,
            )  # fmt: skip
            array[...] = column

    def whole() -> Any:
        group = zarr.open_group(path, mode="r")
        return {name: group[name][...] for name in columns}

    def some() -> Any:
        group = zarr.open_group(path, mode="r")
        return [group[name].oindex[rows] for name in SHOWN]

    return [seconds(write), seconds(whole), seconds(some)]


def main() -> None:
    """Print one line a format."""
    from zarr.codecs import Crc32cCodec

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where the files are written")
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    columns = observations()
    rng = np.random.default_rng(1)
    starts = np.sort(rng.choice(ROWS // RUN, ROWS // RUN // 10, replace=False)) * RUN
    print("seconds: write, read all, read a tenth")
    print("mapped", mapped(folder, columns, starts))
    layouts: dict[str, dict[str, Any]] = {
        "zarr, CRC-32C": {"compressors": [Crc32cCodec()]},
        "zarr, CRC-32C, sharded": {"compressors": None, "sharded": True},
        "zarr, compressed": {"compressors": "auto"},
    }
    for name, layout in layouts.items():
        print(name, zarr3(folder, columns, starts, **layout))


if __name__ == "__main__":
    main()
