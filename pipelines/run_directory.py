"""A run's folder: what is in it, when a round counts as done, and how a run is taken up again.

A round is written under a temporary name and renamed when it is whole, its memory included, so a
kill at any moment leaves whole rounds only. The next round drops the previous one's memory file.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gvtools
from gvtools.errors import ProjectError
from gvtools.files import write_text
from pipelines.console import write_json


def fingerprint(files: Iterable[Path]) -> str:
    """A digest of the names, sizes and modification times of what a run reads."""
    digest = hashlib.sha256()
    for path in sorted(set(files)):
        try:
            status = path.stat()
        except OSError:
            digest.update(f"{path.name}:absent\n".encode())
            continue
        digest.update(f"{path.name}:{status.st_size}:{status.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Versions of what a run's bytes depend on."""
    from importlib.metadata import PackageNotFoundError, version

    out = {"gvtools": gvtools.__version__, "python": platform.python_version()}
    for name in ("numpy", "numba", "open3d", "pycolmap", "torch", "scipy"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "absent"
    return out


class RunDirectory:
    """The folder of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def start(self, identity: dict[str, Any], *, resume: bool) -> int:
        """Make or take up the folder; returns the number of rounds that are done.

        Args:
            identity: what decides the result; kept in run.json and compared on resuming.
            resume: continue after the last whole round.

        Raises:
            ProjectError: the folder holds something else, another run, or a run and ``resume`` is
                off; nothing is touched then.
        """
        record = self.path / "run.json"
        if self.path.exists() and not self.path.is_dir():
            raise ProjectError(f"{self.path}: is a file; give another --out")
        if not record.exists():
            if self.path.exists() and any(self.path.iterdir()):
                raise ProjectError(
                    f"{self.path}: holds files but no run.json, so it is no run of gvtools; give "
                    "another --out"
                )
            write_json(record, {**identity, "versions": versions()})
            return 0
        try:
            before = json.loads(record.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ProjectError(f"{record}: unreadable ({error}); give another --out") from None
        changed = [
            key for key in identity if before.get(key) != json.loads(json.dumps(identity[key]))
        ]
        if changed:
            raise ProjectError(
                f"{self.path}: belongs to another run ({', '.join(changed)} differ); give another "
                "--out"
            )
        if not resume:
            raise ProjectError(
                f"{self.path}: this run is there already; add --resume to continue it, or give "
                "another --out"
            )
        for leftover in self.path.glob(".round_*.part"):
            shutil.rmtree(leftover)
        done = len(self.reports())
        if done:
            self._settle(done - 1)
        return done

    def reports(self) -> list[dict[str, Any]]:
        """The reports of the whole rounds, in order."""
        out: list[dict[str, Any]] = []
        while True:
            path = self.round_path(len(out)) / "report.json"
            if not path.exists():
                return out
            out.append(json.loads(path.read_text(encoding="utf-8")))

    def round_path(self, number: int) -> Path:
        """Where round ``number`` stands."""
        return self.path / f"round_{number:03d}"

    def round_memory(self, number: int) -> Path:
        """The memory after round ``number``; kept for the last whole round only."""
        return self.round_path(number) / "memory.npz"

    @contextmanager
    def writing_round(self, number: int) -> Iterator[Path]:
        """A folder to fill; it becomes the round when the block ends without an error.

        Raises:
            ProjectError: the disk is full or the folder cannot be written; earlier rounds stand.
        """
        part = self.path / f".round_{number:03d}.part"
        try:
            if part.exists():
                shutil.rmtree(part)
            part.mkdir(parents=True)
            yield part
            os.replace(part, self.round_path(number))
        except BaseException as error:
            shutil.rmtree(part, ignore_errors=True)
            # A file that could not be written names itself; the user's concern is the round.
            cause = error.__cause__ if isinstance(error, ProjectError) else error
            if not isinstance(cause, OSError):
                raise
            raise ProjectError(
                f"{self.path}: round {number} cannot be written ({cause.strerror or cause}); free "
                "some space and add --resume; earlier rounds are intact"
            ) from cause
        self._settle(number)

    def _settle(self, number: int) -> None:
        """What follows from round ``number`` being whole; safe to repeat after a kill."""
        if number:
            self.round_memory(number - 1).unlink(missing_ok=True)
        lines = [json.dumps(report) for report in self.reports()]
        write_text(self.path / "rounds.jsonl", "".join(f"{line}\n" for line in lines))
