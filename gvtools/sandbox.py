"""Readers of other packages in a child process, whose memory and time the file's size limits.

A reader is a generator ``read(path, **options)`` of ``(facts, arrays)``: plain data for JSON, and
arrays by name. Each pair reaches the parent as it is made, so that files of any size pass. The
child must have a checked error to tell (``GvError``) or die; the parent says the rest.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gvtools import errors
from gvtools.errors import GvError
from gvtools.untrusted import load_arrays, parse_json, regular

Item = tuple[dict[str, Any], Mapping[str, NDArray[Any]]]
# Of the processor: seconds for a file, and for each of its bytes.
SECONDS, SECONDS_PER_BYTE = 60, 1e-6
# Of address space: beside what the packages map, and for each byte of the file.
SPARE_BYTES, BYTES_PER_BYTE = 1 << 29, 8
# Of one item; scans come in pieces of 64 MB.
MOST_BYTES = 1 << 30
HEAD = struct.Struct("<?Q")
ALONE = {"PXR_WORK_THREAD_LIMIT": "1", "RAYON_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1",
         "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # fmt: skip


class ReaderError(Exception):
    """The child ended without a word: the file is damaged, or asks for more than it is worth."""


def read_apart(reader: str, path: Path, **options: Any) -> Iterator[Item]:
    """What a reader gives of a file, read in a process of its own.

    Args:
        reader: "module:function".
    """
    command = [sys.executable, "-m", __name__, reader, str(regular(path).absolute())]
    paths = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    process = subprocess.Popen(
        [*command, json.dumps(options)], env={**os.environ, **ALONE, "PYTHONPATH": paths},
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        while head := process.stdout.read(HEAD.size):
            yield _item(head, process.stdout)
        if process.wait():
            raise ReaderError(f"it ended with status {process.returncode}")
    finally:
        process.kill()
        process.stdout.close()
        process.wait()


def _item(head: bytes, stream: IO[bytes]) -> Item:
    sound, length = HEAD.unpack(head) if len(head) == HEAD.size else (False, MOST_BYTES + 1)
    data = stream.read(length) if length <= MOST_BYTES else b""
    if len(data) != length:
        raise ReaderError("it ended early")
    if not sound:
        told = parse_json(data)
        raise getattr(errors, told["kind"], GvError)(told["message"])
    arrays = load_arrays(data)
    return parse_json(arrays.pop("facts").tobytes()), arrays


def main() -> None:
    """Send what the reader of the command line makes of its file."""
    name, path, options = sys.argv[1:]
    module, function = name.split(":")
    # What libraries print is no answer.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    read = getattr(importlib.import_module(module), function)
    size = Path(path).stat().st_size
    try:
        for facts, arrays in _limited(read(Path(path), **json.loads(options)), size):
            buffer = io.BytesIO()
            told = np.frombuffer(json.dumps(facts).encode(), np.uint8)
            np.savez(buffer, facts=told, **arrays)  # type: ignore[arg-type]
            out.write(HEAD.pack(True, buffer.tell()))
            out.write(buffer.getbuffer())
            out.flush()
    except GvError as error:
        data = json.dumps({"kind": type(error).__name__, "message": str(error)}).encode()
        out.write(HEAD.pack(False, len(data)) + data)
    out.flush()


def _limited(items: Iterator[Item], size: int) -> Iterator[Item]:
    """The items of a reader that has loaded its packages before the first, under limits.

    The first item's facts may name more ``bytes_per_byte`` than BYTES_PER_BYTE.
    """
    ratio = int(next(items)[0].get("bytes_per_byte", BYTES_PER_BYTE))
    try:
        import resource
    except ImportError:  # Windows: nothing is limited
        return items

    seconds = int(SECONDS + SECONDS_PER_BYTE * size)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    mapped = Path("/proc/self/statm")
    if mapped.is_file():  # elsewhere memory is not limited
        pages = int(mapped.read_text().split()[0])
        most = pages * resource.getpagesize() + ratio * size + SPARE_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    return items


if __name__ == "__main__":
    main()
