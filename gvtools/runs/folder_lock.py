"""A folder of results that one process at a time works in."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gvtools.errors import ProjectError


@contextmanager
def folder_lock(path: Path) -> Iterator[None]:
    """Make the folder if need be; as long as the block lasts, other processes are kept out."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise ProjectError(
            f"{path}: cannot be made ({error.strerror}); give another --out"
        ) from None
    try:
        _lock(path, handle)
        yield
    finally:
        os.close(handle)


def _lock(path: Path, handle: int) -> None:
    try:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ProjectError(
            f"{path}: another process is at work there; wait for it, or give another --out"
        ) from None
    except (ImportError, OSError):
        return  # Where the system or the file system knows no locks, the user has to take care.
