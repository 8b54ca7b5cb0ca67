"""One stage of one scene on the machine that it fell to: an ordinary command, its log kept.

The stage's record, FOLDER/SCENE/STAGE.json, is written last; a stage is finished when it says so.
"""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from time import monotonic
from typing import Any

from gvtools.errors import GvError
from gvtools.files import remove, write_text
from pipelines.fleet.spec import Task, is_url
from pipelines.fleet.storage import fetched, read_record, scratch, stored, write_record

DONE, FAILED = "done", "failed"
# Commands that go on where an earlier attempt stopped, when told so.
RESUMABLE = ("reconstruct", "train", "merge")
# Commands whose folder appears at once, and that refuse one which is there.
AT_ONCE = ("capture", "split")
THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_BUSY = "another process is at work there"


def record_of(task: Task, stage: str | None = None) -> str:
    """Where the record of a task lies, or that of another stage of its scene."""
    return f"{task.root}/{task.scene}/{stage or task.stage}.json"


def finished(task: Task) -> dict[str, Any] | None:
    """The record of a stage that was finished by the same command on the same input."""
    record = read_record(record_of(task))
    same = record is not None and record.get("command") == [*task.command]
    same = same and record is not None and record.get("project") == task.project
    return record if same and record and record.get("status") == DONE else None


def run_task(data: dict[str, Any], attempt: int = 1) -> dict[str, Any]:
    """Run a task and write its record.

    Args:
        data: the fields of the task.
        attempt: 1 at first.

    Returns:
        The record: status, reason, whether trying again may help, seconds, node.
    """
    task = Task(**{**data, "command": tuple(data["command"]), "before": tuple(data["before"])})
    began = monotonic()
    try:
        status, reason, again = _attempt(task)
    except GvError as error:
        status, reason, again = FAILED, str(error), isinstance(error.__cause__, OSError)
    record = {
        "scene": task.scene,
        "stage": task.stage,
        "status": status,
        "reason": reason,
        "again": again,
        "attempts": attempt,
        "seconds": monotonic() - began,
        "node": platform.node(),
        "project": task.project,
        "command": [*task.command],
    }
    if status == DONE:
        record["figures"] = _figures(_folder(task, task.stage))
    write_record(record_of(task), record)
    return record


def _attempt(task: Task) -> tuple[str, str, bool]:
    missing = [stage for stage in task.before if not _is_done(task, stage)]
    if missing:
        return FAILED, f"stage {missing[0]} is not done", False
    folders = {stage: str(_input(task, stage)) for stage in task.before}
    words = {"project": str(fetched(task.project)), "name": task.scene,
             "out": str(_folder(task, task.stage)), **folders}  # fmt: skip
    arguments = [_filled(word, words) for word in task.command]
    out = Path(words["out"])
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
            preexec_fn=_dying_with(os.getpid()),
        ).returncode
    last = (log.read_text(encoding="utf-8", errors="replace").splitlines() or [""])[-1]
    if is_url(task.root):
        write_record(f"{task.root}/{task.scene}/{task.stage}.log.json", {"log": log.read_text(
            encoding="utf-8", errors="replace")})  # fmt: skip
    if code == 0:
        stored(out, f"{task.root}/{task.scene}/{task.stage}")
        return DONE, "", False
    if code < 0:
        return FAILED, f"ended by {signal.Signals(-code).name}", True
    # Status 2 says that the input is wrong, which another attempt would find, too.
    return FAILED, last or f"exit status {code}", code != 2 or _BUSY in last


def _dying_with(worker: int) -> Callable[[], None] | None:
    """What a command's process does first: it must not outlive its worker.

    The next attempt needs the folder.
    """
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


def _filled(word: str, words: dict[str, str]) -> str:
    for name, value in words.items():
        word = word.replace(f"{{{name}}}", value)
    return word


def _folder(task: Task, stage: str) -> Path:
    base = scratch(f"{task.root}/{task.scene}") if is_url(task.root) else None
    return (base or Path(task.root) / task.scene) / stage


def _input(task: Task, stage: str) -> Path:
    return fetched(f"{task.root}/{task.scene}/{stage}") if is_url(task.root) else _folder(
        task, stage)  # fmt: skip


def _is_done(task: Task, stage: str) -> bool:
    record = read_record(record_of(task, stage))
    return record is not None and record.get("status") == DONE


def _figures(folder: Path) -> dict[str, float]:
    """Numbers that a command left as JSON: metrics.json, evaluation.json, results.json."""
    found: dict[str, float] = {}
    for name in ("metrics.json", "evaluation.json", "results.json"):
        for key, value in (read_record(str(folder / name)) or {}).items():
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                found.setdefault(key, value)
    return found


def write_tasks(path: Path, tasks: list[Task]) -> None:
    """The list of tasks as ``python -m pipelines.fleet.task`` reads it."""
    write_text(path, json.dumps([asdict(task) for task in tasks], indent=1) + "\n")


def main(argv: list[str]) -> int:
    """Run the task of a list that a Slurm array gives by number, with its retries.

    Args:
        argv: path of the list, number.
    """
    data = json.loads(Path(argv[0]).read_text(encoding="utf-8"))[int(argv[1])]
    task = Task(**{**data, "command": tuple(data["command"]), "before": tuple(data["before"])})
    if finished(task):
        return 0
    for attempt in range(1, task.retries + 2):
        record = run_task(data, attempt)
        print(f"{task.scene} {task.stage}: {record['status']} {record['reason']}".rstrip())
        if record["status"] == DONE or not record["again"]:
            break
    return 0 if record["status"] == DONE else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
