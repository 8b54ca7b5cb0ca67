"""Folders on shared storage, by path or by fsspec URL."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from gvtools.errors import OptionError, ProjectError
from gvtools.files import write_json
from pipelines.fleet.spec import is_url


def scratch(url: str) -> Path:
    """The local copy's folder for a URL, under GVTOOLS_FLEET_CACHE; it may not exist yet."""
    base = Path(
        os.environ.get("GVTOOLS_FLEET_CACHE", Path(tempfile.gettempdir()) / "gvtools-fleet")
    )
    return base / hashlib.sha256(url.encode()).hexdigest()[:16] / url.rstrip("/").rpartition("/")[2]


def fetched(place: str) -> Path:
    """A local path of a file or folder; a URL is downloaded once and not looked at again."""
    if not is_url(place):
        return Path(place)
    local = scratch(place)
    if not local.exists():
        files, remote = _open(place)
        part: Path | None = None
        try:
            local.parent.mkdir(parents=True, exist_ok=True)
            # A folder of its own: several tasks on this machine may download the same URL.
            part = Path(tempfile.mkdtemp(prefix=".part-", dir=local.parent))
            _fetch(files, remote, part / local.name)
            os.rename(part / local.name, local)
        except (OSError, ValueError) as error:
            if not local.exists():
                raise ProjectError(f"{place}: cannot be fetched ({error})") from error
        finally:
            if part is not None:
                shutil.rmtree(part, ignore_errors=True)
    return local


def _fetch(files: Any, remote: str, target: Path) -> None:
    if files.isfile(remote):
        files.get_file(remote, str(target))
        return
    for name in _find(files, remote):
        path = target / _relative(name, remote)
        path.parent.mkdir(parents=True, exist_ok=True)
        files.get_file(name, str(path))


def stored(folder: Path, place: str) -> None:
    """Upload a finished folder to its URL; does nothing if ``place`` is a path."""
    if not is_url(place):
        return
    files, remote = _open(place)
    try:
        if files.exists(remote):
            # Left by an upload that was interrupted.
            files.rm(remote, recursive=True)
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                files.pipe_file(
                    f"{remote}/{path.relative_to(folder).as_posix()}", path.read_bytes()
                )
    except OSError as error:
        raise ProjectError(f"{place}: cannot be written ({error})") from error


def read_record(place: str) -> dict[str, Any] | None:
    """A JSON object; None if the file is absent or damaged."""
    try:
        if is_url(place):
            files, remote = _open(place)
            files.invalidate_cache()
            text = files.cat_file(remote)
        else:
            text = Path(place).read_bytes()
        found = json.loads(text)
    except (FileNotFoundError, ValueError):
        return None
    except OSError as error:
        raise ProjectError(f"{place}: cannot be read ({error})") from error
    return found if isinstance(found, dict) else None


def write_record(place: str, data: dict[str, Any]) -> None:
    """Write a JSON object; a file on disk appears only when complete."""
    if not is_url(place):
        write_json(Path(place), data)
        return
    files, remote = _open(place)
    try:
        files.pipe_file(remote, json.dumps(data, indent=1).encode())
    except OSError as error:
        raise ProjectError(f"{place}: cannot be written ({error})") from error


def _open(place: str) -> tuple[Any, str]:
    try:
        import fsspec

        files, remote = fsspec.url_to_fs(place)
    except (ImportError, ValueError) as error:
        raise OptionError(
            f"{place}: {error}; pip install 'gvtools[cluster]' reads s3:// URLs"
        ) from None
    return files, str(remote).rstrip("/")


def _find(files: Any, remote: str) -> list[str]:
    names = [name for name in files.find(remote) if not name.endswith("/")]
    if not names:
        raise FileNotFoundError(f"nothing at {remote}")
    return names


def _relative(name: str, remote: str) -> str:
    relative = name[len(remote) :].lstrip("/")
    if not name.startswith(remote) or ".." in Path(relative).parts or not relative:
        raise ProjectError(f"{name}: lies outside {remote}")
    return relative
