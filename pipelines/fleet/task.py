"""One stage of one scene on the machine that it fell to: an ordinary command, with its log.

The stage's record, FOLDER/SCENE/STAGE.json, is written last; a stage is finished when it says so.
Folders lie on shared storage, by path or by fsspec URL.
"""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic
from typing import Any

from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.files import digest, remove, write_json
from gvtools.optional import require
from pipelines.fleet.spec import Task, is_url

Record = dict[str, Any]
# Statuses of a record. One that failed has a ``reason``, and ``again`` where another attempt helps.
DONE, FAILED = "done", "failed"
# Commands that go on where an earlier attempt stopped, when told so.
RESUMABLE = ("reconstruct", "train", "merge")
# Commands whose folder appears at once, and that refuse one which is there.
AT_ONCE = ("capture", "split")
THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_BUSY = "another process is at work there"


def finished_record(task: Task) -> Record | None:
    """The record of a stage that was finished by the same command on the same input."""
    record = read_record(task.record())
    wanted = {"status": DONE, **task.identity}
    return record if record and wanted.items() <= record.items() else None


def run_task(task: Task, attempt: int = 1) -> Record:
    """Run a task, and write and return its record."""
    began = monotonic()
    try:
        status, reason, again = _attempt(task)
    except GvError as error:
        status, reason, again = FAILED, str(error), isinstance(error.__cause__, OSError)
    record: Record = {
        "scene": task.scene,
        "stage": task.stage,
        "status": status,
        "reason": reason,
        "again": again,
        "attempts": attempt,
        "seconds": monotonic() - began,
        "node": platform.node(),
        **task.identity,
    }
    if status == DONE:
        record["figures"] = _figures(_folder(task, task.stage))
    write_record(task.record(), record)
    return record


def _attempt(task: Task) -> tuple[str, str, bool]:
    """Status, reason, and whether trying again may help."""
    for stage in task.before:
        if (read_record(task.record(stage)) or {}).get("status") != DONE:
            return FAILED, f"stage {stage} is not done", False
    out = _folder(task, task.stage)
    words = {stage: str(fetch(f"{task.root}/{task.scene}/{stage}")) for stage in task.before}
    words |= {"project": str(fetch(task.project)), "name": task.scene, "out": str(out)}
    arguments = [*task.command]
    for name, value in words.items():
        arguments = [word.replace(f"{{{name}}}", value) for word in arguments]
    out.parent.mkdir(parents=True, exist_ok=True)
    log = out.with_name(f"{task.stage}.log")
    if task.command[0] in RESUMABLE and out.exists():
        arguments += [] if "--resume" in arguments else ["--resume"]
    elif task.command[0] in AT_ONCE and log.exists() and out.is_dir():
        # An attempt ended after the command and before the record.
        remove(out)
    with log.open("ab") as file:
        code = subprocess.run(
            [sys.executable, "-m", "pipelines.cli", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env={**os.environ, **dict.fromkeys(THREADS, str(task.cpus))},
            preexec_fn=_ending_with(os.getpid()),
        ).returncode
    text = log.read_text(encoding="utf-8", errors="replace")
    last = (text.splitlines() or [""])[-1]
    if is_url(task.root):
        write_record(f"{task.root}/{task.scene}/{task.stage}.log.json", {"log": text})
    if code == 0:
        upload(out, f"{task.root}/{task.scene}/{task.stage}")
        return DONE, "", False
    if code < 0:
        return FAILED, f"ended by {signal.Signals(-code).name}", True
    # Status 2 says that the input is wrong, which another attempt would find, too.
    return FAILED, last or f"exit status {code}", code != 2 or _BUSY in last


def _ending_with(worker: int) -> Callable[[], None] | None:
    """What a command's process does first, so that it ends with its worker."""
    if sys.platform != "linux":
        return None
    import ctypes

    # Loaded here: between fork and exec, locks of other threads may be held for ever.
    system = ctypes.CDLL(None)

    def die_with_worker() -> None:
        system.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != worker:
            # It died before the line above.
            os._exit(1)

    return die_with_worker


def _folder(task: Task, stage: str) -> Path:
    place = f"{task.root}/{task.scene}"
    return (cache_folder(place) if is_url(task.root) else Path(place)) / stage


def _figures(folder: Path) -> dict[str, float]:
    """Numbers that a command left as JSON: metrics.json, evaluation.json, results.json."""
    figures: dict[str, float] = {}
    for name in ("metrics.json", "evaluation.json", "results.json"):
        for key, value in (read_record(str(folder / name)) or {}).items():
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                figures.setdefault(key, value)
    return figures


def cache_folder(url: str) -> Path:
    """Where the local copy of a URL lies, under GVTOOLS_FLEET_CACHE; it may not exist yet."""
    default = Path(tempfile.gettempdir()) / "gvtools-fleet"
    base = Path(os.environ.get("GVTOOLS_FLEET_CACHE", default))
    return base / digest(url) / url.rstrip("/").rpartition("/")[2]


def fetch(place: str) -> Path:
    """A local path of a file or folder; a URL is downloaded once and not looked at again."""
    if not is_url(place):
        return Path(place)
    local = cache_folder(place)
    if not local.exists():
        with _reached(place, "fetched") as (files, remote):
            local.parent.mkdir(parents=True, exist_ok=True)
            # A folder of its own: several tasks on this machine may download the same URL.
            with tempfile.TemporaryDirectory(prefix=".part-", dir=local.parent) as part:
                _download(files, remote, Path(part, local.name))
                if not local.exists():
                    os.rename(Path(part, local.name), local)
    return local


def _download(files: Any, remote: str, target: Path) -> None:
    if files.isfile(remote):
        files.get_file(remote, str(target))
        return
    names = [name for name in files.find(remote) if not name.endswith("/")]
    if not names:
        raise FileNotFoundError(f"nothing at {remote}")
    for name in names:
        relative = name[len(remote) :].lstrip("/")
        if not name.startswith(remote) or ".." in Path(relative).parts or not relative:
            raise ProjectError(f"{name}: lies outside {remote}")
        (target / relative).parent.mkdir(parents=True, exist_ok=True)
        files.get_file(name, str(target / relative))


def upload(folder: Path, place: str) -> None:
    """Copy a finished folder to its URL; does nothing if ``place`` is a path."""
    if not is_url(place):
        return
    with _reached(place, "written") as (files, remote):
        if files.exists(remote):
            # Left by an upload that was interrupted.
            files.rm(remote, recursive=True)
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                name = path.relative_to(folder).as_posix()
                files.pipe_file(f"{remote}/{name}", path.read_bytes())


def read_record(place: str) -> Record | None:
    """A JSON object; None if the file is absent or damaged."""
    record = None
    if not is_url(place):
        with suppress(OSError, ValueError):
            record = json.loads(Path(place).read_bytes())
    else:
        with _reached(place, "read") as (files, remote), suppress(FileNotFoundError, ValueError):
            files.invalidate_cache()
            record = json.loads(files.cat_file(remote))
    return record if isinstance(record, dict) else None


def write_record(place: str, record: Record) -> None:
    """Write a JSON object; a file on disk appears only when complete."""
    if not is_url(place):
        write_json(Path(place), record)
        return
    with _reached(place, "written") as (files, remote):
        files.pipe_file(remote, json.dumps(record, indent=1).encode())


@contextmanager
def _reached(place: str, done: str) -> Iterator[tuple[Any, str]]:
    """The file system of a URL, and the path there; what fails in the block names the URL."""
    fsspec = require("fsspec", extra="cluster", purpose=place)
    try:
        files, remote = fsspec.url_to_fs(place)
    except (ImportError, ValueError) as error:
        raise OptionError(
            f"{place}: {error}; pip install 'gvtools[cluster]' reads s3:// URLs"
        ) from None
    try:
        yield files, str(remote).rstrip("/")
    except OSError as error:
        raise ProjectError(f"{place}: cannot be {done} ({error})") from error


def main(argv: list[str]) -> int:
    """Run the task of a list (path, number) that a Slurm array names, with its retries."""
    task = Task(**json.loads(Path(argv[0]).read_text(encoding="utf-8"))[int(argv[1])])
    if finished_record(task):
        return 0
    for attempt in range(1, task.retries + 2):
        record = run_task(task, attempt)
        print(f"{task.scene} {task.stage}: {record['status']} {record['reason']}".rstrip())
        if record["status"] == DONE or not record["again"]:
            break
    return 0 if record["status"] == DONE else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
