"""A fleet run: its tasks swept on Ray or on this machine, or written for Slurm; its tables."""

from __future__ import annotations

import json
import logging
import os
import shlex
import socket
import sys
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.tables import Column, Table, csv_text, markdown
from gvtools.files import make_folder, write_json, write_text
from gvtools.optional import require
from pipelines.console import Console
from pipelines.fleet.spec import Task, is_url
from pipelines.fleet.task import (
    DONE,
    FAILED,
    Record,
    read_record,
    run_task,
    write_record,
)

# Longest wait for a task to end [s]: then another one may have come.
WAIT_S = 1.0
# Time-out for connecting to a cluster [s].
CONNECT_S = 10.0
NOT_RUN = "not run"
TASKS, SUBMIT = "tasks.json", "submit.sh"
HEADS = ("scene", "stage", "status", "attempts", "seconds", "node")
_STATES = ("done", "running", "waiting", "failed", "again")


class Threads:
    """Several tasks at a time on this machine, each waited for by a thread."""

    def __init__(self, slots: int) -> None:
        self.slots = float(slots)
        self._pool = ThreadPoolExecutor(slots)

    def submit(self, task: Task, attempt: int) -> Future[Record]:
        """Begin a task; returns a handle."""
        return self._pool.submit(run_task, task, attempt)

    def finished(self, handles: Sequence[Future[Record]]) -> list[tuple[Future[Record], Record]]:
        """Handles of tasks that ended, with their records; waits for one at most ``WAIT_S``."""
        ended, _ = wait(handles, timeout=WAIT_S, return_when=FIRST_COMPLETED)
        return [(handle, self._record(handle)) for handle in ended]

    def _record(self, handle: Future[Record]) -> Record:
        try:
            return handle.result()
        except Exception as error:
            return lost_worker(f"{type(error).__name__}: {error}")

    def close(self) -> None:
        """Start no other task, and wait for those that run."""
        self._pool.shutdown(cancel_futures=True)


def lost_worker(reason: str) -> Record:
    """The record of a task whose worker could not write one; it may be run again."""
    return {"status": FAILED, "reason": reason, "again": True}


def run_fleet(
    tasks: Sequence[Task], pool: Threads | Ray, *, finished: Sequence[Task] = (), console: Console
) -> None:
    """Run tasks, the stages of a scene in turn, beside those finished before; each leaves a record.

    Progress is one table of counts on a terminal, and a line for each event elsewhere.
    """
    counts: dict[str, Counter[str]] = {task.stage: Counter() for task in (*finished, *tasks)}
    for task in finished:
        counts[task.stage]["done"] += 1
    scenes: dict[str, deque[Task]] = {}
    for task in tasks:
        scenes.setdefault(task.scene, deque()).append(task)
        counts[task.stage]["waiting"] += 1
    total, before = len(tasks) + len(finished), len(finished)
    console.line(f"{total} tasks" + (f", {before} finished before" if before else ""))
    ready = deque((stages[0], 1) for stages in scenes.values())
    running: dict[Any, tuple[Task, int]] = {}

    def ended(task: Task, record: Record, *, state: str, attempts: int) -> None:
        done = record["status"] == DONE
        counts[task.stage].update({state: -1, "done" if done else "failed": 1})
        over = sum(count["done"] + count["failed"] for count in counts.values())
        head = f"[{over}/{total}] {task.scene} {task.stage}"
        if not done:
            about = {"scene": task.scene, "stage": task.stage, "attempts": attempts}
            write_record(task.record(), {**about, **task.identity, **record})
            console.warn(f"{head}: failed: {record['reason']}")
        elif not console.interactive:
            console.line(f"{head}: {record['seconds']:.1f} s on {record['node']}")

    with _live_table(counts, console), closing(pool):
        while ready or running:
            while ready and len(running) < pool.slots:
                task, attempt = ready.popleft()
                counts[task.stage].update(running=1, waiting=-1)
                running[pool.submit(task, attempt)] = task, attempt
            for handle, record in pool.finished(list(running)):
                task, attempt = running.pop(handle)
                failed, stages = record["status"] == FAILED, scenes[task.scene]
                if failed and record.get("again") and attempt <= task.retries:
                    counts[task.stage].update(running=-1, waiting=1, again=1)
                    name = f"{task.scene} {task.stage}"
                    console.warn(f"{name}: attempt {attempt} failed: {record['reason']}")
                    ready.append((task, attempt + 1))
                    continue
                ended(task, record, state="running", attempts=attempt)
                stages.popleft()
                if not failed and stages:
                    ready.append((stages[0], 1))
                for later in stages if failed else ():
                    skipped = {"status": FAILED, "reason": f"stage {task.stage} failed"}
                    ended(later, skipped, state="waiting", attempts=0)


def _live_table(
    counts: Mapping[str, Counter[str]], console: Console
) -> AbstractContextManager[object]:
    if not console.interactive:
        return nullcontext()
    from rich.live import Live
    from rich.table import Table

    def table() -> Table:
        shown = Table("stage", *_STATES)
        for stage, count in counts.items():
            shown.add_row(stage, *(str(count[state]) for state in _STATES))
        return shown

    return Live(get_renderable=table, refresh_per_second=1, transient=True)


def this_machine(tasks: Sequence[Task]) -> Threads:
    """As many at a time as there are cores for the task with the most; one with any GPU."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    gpus = any(task.gpus for task in tasks)
    return Threads(1 if gpus else max(1, (cores or 1) // max(t.cpus for t in tasks)))


class Ray:
    """A Ray cluster, which queues the tasks; each asks for its cores, cards and memory."""

    slots = float("inf")

    def __init__(self, tasks: Sequence[Task], *, address: str, console: Console) -> None:
        # "auto" may find the address of a cluster that has ended: try 3 times, not 20, 40 s each.
        os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "3")
        instead = "or give --engine processes or slurm"
        ray = require("ray", extra="cluster", purpose="--engine ray", instead=instead)
        _check_reachable(address)
        try:
            context = ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise _no_cluster(address, str(error).splitlines()[0]) from None
        self._ray = ray
        self._remote = ray.remote(run_task)
        if context.dashboard_url:
            console.line(f"Ray's dashboard: http://{context.dashboard_url}")
        else:
            console.line("Ray's dashboard is not installed; pip install 'ray[default]' brings it")
        # Tasks that are too large for every node would wait for ever.
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        for task in {task.stage: task for task in tasks}.values():
            asked = {"CPU": task.cpus, "GPU": task.gpus, "memory": task.memory_gb * 1e9}
            if any(all(node.get(k, 0) >= v for k, v in asked.items()) for node in nodes):
                continue
            text = (
                f"stage {task.stage}: no machine has {task.cpus} cores, {task.gpus:g} cards and "
                f"{task.memory_gb:g} GB"
            )
            if address == "local":
                self.close()
                raise OptionError(f"{text}; ask for less")
            console.warn(f"{text}; it waits until one joins")

    def submit(self, task: Task, attempt: int) -> Any:
        """Begin a task on a machine with its labels, or, where none of those is free, on any."""
        options: dict[str, Any] = {
            "num_cpus": task.cpus,
            "num_gpus": task.gpus,
            "max_retries": 0,
            "name": f"{task.scene} {task.stage}",
        }
        if task.memory_gb:
            options["memory"] = int(task.memory_gb * 1e9)
        if task.labels:
            options["label_selector"] = dict(task.labels)
            options["fallback_strategy"] = [{"label_selector": {}}]
        return self._remote.options(**options).remote(task, attempt)

    def finished(self, handles: Sequence[Any]) -> list[tuple[Any, Record]]:
        """Those that ended, also by the loss of their worker or machine."""
        ended, _ = self._ray.wait(list(handles), num_returns=1, timeout=WAIT_S)
        return [(handle, self._record(handle)) for handle in ended]

    def _record(self, handle: Any) -> Record:
        try:
            return dict(self._ray.get(handle))
        except self._ray.exceptions.RayError as error:
            first = (str(error).strip().splitlines() or [""])[0]
            return lost_worker(f"worker lost ({type(error).__name__}: {first})")

    def close(self) -> None:
        """Leave the cluster; what still runs is ended."""
        self._ray.shutdown()


def _check_reachable(address: str) -> None:
    """Refuse an address where nothing listens: Ray itself would retry for a quarter of an hour."""
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdecimal() or "/" in host:
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise _no_cluster(address, str(error)) from None


def _no_cluster(address: str, reason: str) -> ProjectError:
    return ProjectError(
        f"--address {address}: no Ray cluster ({reason}); begin one with 'ray start --head', or "
        "give --address local"
    )


def write_slurm(tasks: Sequence[Task], folder: Path) -> Path:
    """Write the list of tasks, a job script for each stage, and the script to start; returns that.

    Task N of a stage's array is scene N; it begins when scene N has passed the stage before.
    """
    make_folder(folder / "slurm-logs")
    write_text(folder / TASKS, json.dumps([asdict(task) for task in tasks], indent=1) + "\n")
    stages: dict[str, list[int]] = {}
    for number, task in enumerate(tasks):
        stages.setdefault(task.stage, []).append(number)
    lines = ["#!/bin/bash", "# Submits the stages; extra options of sbatch may follow.", "set -e"]
    wait = ""
    for name, numbers in stages.items():
        script = folder / f"stage-{name}.sh"
        write_text(script, _array_job(tasks[numbers[0]], numbers, folder))
        lines.append(f'job=$(sbatch --parsable {wait}"$@" {shlex.quote(str(script))})')
        lines.append(f'echo "{name}: job $job"')
        wait = '--dependency=aftercorr:"${job%%;*}" --kill-on-invalid-dep=yes '
    write_text(folder / SUBMIT, "\n".join(lines) + "\n")
    return folder / SUBMIT


def _array_job(task: Task, numbers: Sequence[int], folder: Path) -> str:
    asked = [
        f"--job-name=gvtools-{task.stage}",
        f"--array=0-{len(numbers) - 1}",
        f"--cpus-per-task={task.cpus}",
        "--requeue",
        f"--output={folder}/slurm-logs/{task.stage}-%A_%a.log",
    ]
    if task.memory_gb:
        asked.append(f"--mem={-(-task.memory_gb * 1000 // 1):.0f}M")
    if task.gpus:
        asked.append(f"--gres=gpu:{-(-task.gpus // 1):.0f}")
    run = (
        f"{shlex.quote(sys.executable)} -m pipelines.fleet.task {shlex.quote(str(folder / TASKS))}"
    )
    heads = "\n".join(f"#SBATCH {option}" for option in asked)
    return (
        f"#!/bin/bash\n{heads}\n\n"
        f"# Tasks {numbers[0]} to {numbers[-1]} of the list are this stage's.\n"
        f"exec {run} $(({numbers[0]} + SLURM_ARRAY_TASK_ID))\n"
    )


def collect(tasks: Sequence[Task]) -> list[Record]:
    """A record of every task; one without any has the status "not run"."""
    records = []
    for task in tasks:
        head = {"scene": task.scene, "stage": task.stage, "status": NOT_RUN,
                "reason": "left no record"}  # fmt: skip
        record = read_record(task.record())
        if record is not None and record.get("command") != [*task.command]:
            record, head["reason"] = None, "was run with another command"
        records.append({**head, **(record or {})})
    return sorted(records, key=lambda record: record["scene"])


def result_table(records: Sequence[Record]) -> Table:
    """A row for each stage of each scene; a column for each figure that any has."""
    figures = sorted({name for record in records for name in record.get("figures", {})})
    rows = [
        (
            *(record.get(name) for name in HEADS),
            *(record.get("figures", {}).get(name) for name in figures),
            record.get("reason") or None,
        )
        for record in records
    ]
    columns = tuple(map(Column, (*HEADS, *figures, "reason")))
    return Table(columns, tuple(rows), caption="Fleet")


def report(tasks: Sequence[Task], root: str, console: Console) -> list[Record]:
    """Write results.json (and .csv, .md where the root is a path), print; returns what failed."""
    records = collect(tasks)
    table = result_table(records)
    if is_url(root):
        write_record(f"{root}/results.json", {"tasks": records})
    else:
        write_json(Path(root) / "results.json", {"tasks": records})
        write_text(Path(root) / "results.csv", csv_text(table))
        write_text(Path(root) / "results.md", markdown(table))
    heads = (*HEADS, "reason")
    console.table(heads, [[record.get(name) or None for name in heads] for record in records])
    failed = [record for record in records if record["status"] != DONE]
    console.line(f"{len(records) - len(failed)} of {len(records)} tasks done; results in {root}")
    return failed
