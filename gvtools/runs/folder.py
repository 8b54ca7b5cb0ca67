"""A run's folder while it is written: rounds, locking and resuming.

A round is written under a temporary name and renamed when it is complete, its memory included, so a
kill at any moment leaves complete rounds only. Only the last complete round keeps its memory file.
The context depth that an unfinished round had computed is kept; the next attempt reads it if it is
the same run.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from gvtools.errors import ProjectError
from gvtools.files import remove, replaced_when_written, write_json, write_text
from gvtools.memory.files import copy_tiles
from gvtools.runs.digests import SUMS, check_sums, versions, write_sums
from gvtools.runs.layout import (
    MEMORY,
    METRICS,
    POINTS,
    RECORD,
    REPORT,
    ROUNDS,
    TILES,
    round_folder,
    saved_memory,
)
from gvtools.untrusted import read_json

# Files and folders that are still being written.
PARTIAL = ".*.part"
# Files of an unfinished round that are complete; the next attempt reuses them.
KEPT = "context_depth_*"


class RunDirectory:
    """The folder of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def refuse_foreign(self) -> None:
        """Refuse a path that holds something other than a run."""
        if self.path.exists() and not self.path.is_dir():
            raise ProjectError(f"{self.path}: is a file; give another --out")
        if self.path.exists() and not (self.path / RECORD).exists() and self._results():
            raise ProjectError(
                f"{self.path}: holds files but no run.json, so it is no run of gvtools; give "
                "another --out"
            )

    @contextmanager
    def open_or_resume(self, identity: dict[str, Any], *, resume: bool) -> Iterator[int]:
        """Make the folder or resume the run in it; gives the number of complete rounds.

        As long as the block lasts, other processes are kept out. ``identity``, which decides the
        result, is kept in run.json and compared on resuming.
        """
        self.refuse_foreign()
        with folder_lock(self.path):
            yield self._start(identity, resume=resume)

    def check(self, identity: dict[str, Any], *, resume: bool) -> bool:
        """Whether a run is there that ``open_or_resume`` would continue; touches nothing."""
        self.refuse_foreign()
        record = self.path / RECORD
        if not record.exists():
            return False
        before = self._record()
        if before is None:
            raise ProjectError(f"{record}: no readable JSON; give another --out")
        ours = isinstance(before, dict) and before.keys() >= {*identity, "versions"}
        if ours and not self._results():
            # A run was begun here but completed no round: start anew, whatever its options were.
            return False
        if not isinstance(before, dict):
            before = {}
        if changed := changed_keys(identity, before):
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
        resumes = self.check(identity, resume=resume)
        record = {**identity, "versions": versions()}
        # Options and versions of an unfinished attempt are the same: reuse its context depth.
        same = self._record() == json.loads(json.dumps(record))
        self._drop_partial(but=self.unfinished_round(0) if same else None)
        if not resumes:
            if not same:
                write_json(self.path / RECORD, record)
            return 0
        done = len(self.reports())
        # Rounds after a removed one were built on it and have to be repeated.
        for folder in sorted(self.path.glob("round_[0-9]*")):
            number = folder.name.removeprefix("round_")
            if number.isdigit() and int(number) >= done:
                shutil.rmtree(folder)
        for finished in range(done):
            check_sums(self.round_path(finished))
        # The run's end writes anew what it has sums of.
        (self.path / SUMS).unlink(missing_ok=True)
        if done:
            self._finish_round(done - 1)
        return done

    def _record(self) -> Any:
        """What the run's record holds; None where it cannot be read."""
        try:
            return read_json(self.path / RECORD)
        except (OSError, ValueError):
            return None

    def add_to_record(self, key: str, value: Any) -> None:
        """Say in run.json what was found on the way, beside what decides the result."""
        record = self._record()
        if isinstance(record, dict) and record.get(key) != json.loads(json.dumps(value)):
            write_json(self.path / RECORD, {**record, key: value})

    def _results(self) -> list[Path]:
        """What the folder holds beside the run's record and what a kill left half-written."""
        return [
            path
            for path in self.path.iterdir()
            if path.name != RECORD and not fnmatch(path.name, PARTIAL)
        ]

    def _drop_partial(self, *, but: Path | None) -> None:
        for partial in (*self.path.glob(PARTIAL), *self.path.glob(f"round_*/{PARTIAL}")):
            if partial == but:
                continue
            if partial.is_dir():
                shutil.rmtree(partial)
            else:
                partial.unlink()

    def reports(self) -> list[dict[str, Any]]:
        """The reports of the complete rounds, in order."""
        out: list[dict[str, Any]] = []
        while True:
            path = self.round_path(len(out)) / REPORT
            if not path.exists():
                return out
            try:
                out.append(read_json(path))
            except (OSError, ValueError) as error:
                raise ProjectError(
                    f"{path}: no readable report ({error}); remove this round's folder and add "
                    "--resume to the run"
                ) from None

    def round_path(self, number: int) -> Path:
        """The folder of round ``number``."""
        return round_folder(self.path, number)

    def unfinished_round(self, number: int) -> Path:
        """Where round ``number`` is written; context depth that lies there is taken over."""
        return self.path / f".round_{number:03d}.part"

    def round_memory(self, number: int) -> Path:
        """The memory after round ``number``; kept for the last complete round only."""
        return saved_memory(self.round_path(number))

    def last_memory(self, done: int) -> Path:
        """The newest memory file of a run with ``done`` complete rounds."""
        for path in (self.round_memory(done - 1), saved_memory(self.path)):
            if path.exists():
                return path
        raise ProjectError(
            f"{self.path}: the memory after round {done - 1} is gone, as with a later round's "
            "folder that was removed; start again with another --out"
        )

    def finish(self, number: int, metrics: Mapping[str, Any]) -> None:
        """Write the run's figures, make the last round's memory the run's own, and write sums."""
        write_json(self.path / METRICS, metrics)
        last = self.round_memory(number)
        if last.exists():
            # Copy, then delete: a concurrent reader always finds at least one of the two.
            if last.is_dir():
                copy_tiles(last, self.path / TILES)
            else:
                with replaced_when_written(self.path / MEMORY) as temporary:
                    shutil.copyfile(last, temporary)
            remove(last)
        write_sums(self.path, [n for n in (METRICS, POINTS) if (self.path / n).is_file()])

    @contextmanager
    def writing_round(self, number: int) -> Iterator[Path]:
        """A folder to fill; it becomes the round when the block ends without an error.

        It holds the files that an earlier attempt at this round left (KEPT).
        """
        part = self.unfinished_round(number)
        try:
            part.mkdir(parents=True, exist_ok=True)
            _clear(part)
            yield part
            write_sums(part)
            os.replace(part, self.round_path(number))
        except BaseException as error:
            with suppress(OSError):
                _clear(part)
                part.rmdir()  # Fails while it holds kept files.
            # A file that could not be written names itself; the user's concern is the round.
            cause = error.__cause__ if isinstance(error, ProjectError) else error
            if not isinstance(cause, OSError):
                raise
            raise ProjectError(
                f"{self.path}: round {number} cannot be written ({cause.strerror or cause}); free "
                "some space and add --resume; earlier rounds are intact"
            ) from cause
        self._finish_round(number)

    def _finish_round(self, number: int) -> None:
        """Remove the previous round's memory file and rewrite rounds.jsonl; safe to repeat."""
        if number:
            remove(self.round_memory(number - 1))
        lines = [json.dumps(report) for report in self.reports()]
        write_text(self.path / ROUNDS, "".join(f"{line}\n" for line in lines))


def changed_keys(identity: Mapping[str, Any], record: Mapping[str, Any]) -> list[str]:
    """The keys of an identity that have another value in a run's record.

    ``memory.budget`` changes no result: a run may go on with another.
    """
    return [
        key
        for key in identity
        if _decisive(record.get(key)) != _decisive(json.loads(json.dumps(identity[key])))
    ]


def _decisive(value: Any) -> Any:
    """A value of a record without ``memory.budget``, where it holds the settings."""
    if not isinstance(value, dict) or not isinstance(value.get("memory"), dict):
        return value
    return {**value, "memory": {k: v for k, v in value["memory"].items() if k != "budget"}}


def _clear(part: Path) -> None:
    """Remove what is not kept from the folder of an unfinished round."""
    for path in part.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif not fnmatch(path.name, KEPT):
            path.unlink()


@contextmanager
def folder_lock(path: Path) -> Iterator[None]:
    """Make the folder if need be; as long as the block lasts, other processes are kept out."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        # Windows opens no folder, and knows no locks of them.
        handle = os.open(path, os.O_RDONLY) if os.name == "posix" else None
    except OSError as error:
        raise ProjectError(
            f"{path}: cannot be made ({error.strerror}); give another --out"
        ) from None
    try:
        if handle is not None:
            _lock(path, handle)
        yield
    finally:
        if handle is not None:
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
