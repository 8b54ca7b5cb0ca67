"""What decides a run's result, as digests; compared on resuming."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

import gvtools


def fingerprint(files: Iterable[Path]) -> str:
    """A digest of the names, sizes and modification times of files that a run reads."""
    digest = hashlib.sha256()
    for path in sorted(set(files)):
        try:
            status = path.stat()
        except OSError:
            digest.update(f"{path.name}:absent\n".encode())
            continue
        digest.update(f"{path.name}:{status.st_size}:{status.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def array_digest(arrays: Iterable[NDArray[Any] | None]) -> str:
    """A digest of the bytes of arrays, in order; None stands for an absent array."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(b"none" if array is None else array.tobytes())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Versions of what a run's bytes depend on."""
    out = {"gvtools": gvtools.__version__, "python": platform.python_version()}
    for name in ("numpy", "numba", "open3d", "pycolmap", "torch", "scipy"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "absent"
    return out
