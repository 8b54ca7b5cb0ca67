"""A run's folder: what is in it, when a round counts as done, and how a run is taken up again.

A round is written under a temporary name and renamed when it is whole, its memory included, so a
kill at any moment leaves whole rounds only. The next round drops the previous one's memory file.
Of a round that was not finished, the depth that it had computed is kept for the next attempt, which
takes it over where it is the same run.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import gvtools
from gvtools.errors import ProjectError
from gvtools.files import write_text
from pipelines.console import write_json
from gvtools.runs.folder_lock import held_folder


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


# What is being written has such a name until it is whole.
LEFTOVERS = ".*.part"
# Files of an unfinished round that are whole, and worth more than starting again.
LASTING = "context_depth_*"


class RunDirectory:
    """The folder of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def refuse_foreign(self) -> None:
        """Refuse a path that holds something other than a run.

        Raises:
            ProjectError: a file, or a folder with files but no run.json.
        """
        if self.path.exists() and not self.path.is_dir():
            raise ProjectError(f"{self.path}: is a file; give another --out")
        if self.path.exists() and not (self.path / "run.json").exists() and self._results():
            raise ProjectError(
                f"{self.path}: holds files but no run.json, so it is no run of gvtools; give "
                "another --out"
            )

    @contextmanager
    def taken_up(self, identity: dict[str, Any], *, resume: bool) -> Iterator[int]:
        """Make or take up the folder; gives the number of rounds that are done.

        As long as the block lasts, other processes are kept out.

        Args:
            identity: what decides the result; kept in run.json and compared on resuming.
            resume: continue after the last whole round.

        Raises:
            ProjectError: the folder holds something else, another run, a run that is at work, or
                a run and ``resume`` is off; nothing is touched then.
        """
        self.refuse_foreign()
        with held_folder(self.path):
            yield self._start(identity, resume=resume)

    def check(self, identity: dict[str, Any], *, resume: bool) -> bool:
        """Whether a run is there that ``taken_up`` would continue; touches nothing.

        Raises:
            ProjectError: as of ``taken_up``.
        """
        self.refuse_foreign()
        record = self.path / "run.json"
        if not record.exists():
            return False
        try:
            before = json.loads(record.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ProjectError(f"{record}: unreadable ({error}); give another --out") from None
        ours = isinstance(before, dict) and before.keys() >= {*identity, "versions"}
        if ours and not self._results():
            # Nothing came of the first attempt; its options bind nobody.
            return False
        if not isinstance(before, dict):
            before = {}
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
        return True

    def _start(self, identity: dict[str, Any], *, resume: bool) -> int:
        there = self.check(identity, resume=resume)
        record = {**identity, "versions": versions()}
        begun = self._is_recorded(record)
        self._drop_leftovers(but=self._part(0) if begun else None)
        if not there:
            if not begun:
                write_json(self.path / "run.json", record)
            return 0
        done = len(self.reports())
        # Rounds after a removed one stood on it; they are done anew.
        for later in sorted(self.path.glob("round_[0-9]*")):
            if later.name > self.round_path(done - 1).name:
                shutil.rmtree(later)
        if done:
            self._settle(done - 1)
        return done

    def _is_recorded(self, record: dict[str, Any]) -> bool:
        """Whether a first attempt at the very same run, by the same versions, was begun here."""
        try:
            before = json.loads((self.path / "run.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        return bool(before == json.loads(json.dumps(record)))

    def _results(self) -> list[Path]:
        """What the folder holds beside the run's record and what a kill left half-written."""
        return [
            path
            for path in self.path.iterdir()
            if path.name != "run.json" and not fnmatch(path.name, LEFTOVERS)
        ]

    def _drop_leftovers(self, *, but: Path | None) -> None:
        for leftover in self.path.glob(LEFTOVERS):
            if leftover == but:
                continue
            if leftover.is_dir():
                shutil.rmtree(leftover)
            else:
                leftover.unlink()

    def reports(self) -> list[dict[str, Any]]:
        """The reports of the whole rounds, in order."""
        out: list[dict[str, Any]] = []
        while True:
            path = self.round_path(len(out)) / "report.json"
            if not path.exists():
                return out
            try:
                out.append(json.loads(path.read_text(encoding="utf-8")))
            except (OSError, ValueError) as error:
                raise ProjectError(
                    f"{path}: no readable report ({error}); remove this round's folder and add "
                    "--resume to the run"
                ) from None

    def round_path(self, number: int) -> Path:
        """Where round ``number`` stands."""
        return self.path / f"round_{number:03d}"

    def _part(self, number: int) -> Path:
        """Where round ``number`` is written."""
        return self.path / f".round_{number:03d}.part"

    def round_memory(self, number: int) -> Path:
        """The memory after round ``number``; kept for the last whole round only."""
        return self.round_path(number) / "memory.npz"

    @contextmanager
    def writing_round(self, number: int) -> Iterator[Path]:
        """A folder to fill; it becomes the round when the block ends without an error.

        What an earlier attempt at this round left that lasts (LASTING) is in it.

        Raises:
            ProjectError: the disk is full or the folder cannot be written; earlier rounds stand.
        """
        part = self._part(number)
        try:
            part.mkdir(parents=True, exist_ok=True)
            _clear(part)
            yield part
            os.replace(part, self.round_path(number))
        except BaseException as error:
            with suppress(OSError):
                _clear(part)
                part.rmdir()  # Fails where something lasts.
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


def _clear(part: Path) -> None:
    """Remove what does not last from the folder of an unfinished round."""
    for path in part.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif not fnmatch(path.name, LASTING):
            path.unlink()
