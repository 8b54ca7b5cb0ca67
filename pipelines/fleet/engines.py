"""Engines, which run a fleet's tasks: processes of this machine, or a Ray cluster."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict
from typing import Any, Protocol

from gvtools.errors import OptionError, ProjectError
from pipelines.console import Console
from pipelines.fleet.spec import Task
from pipelines.fleet.task import FAILED, run_task

# Progress is updated at least this often [s].
WAIT_S = 1.0
# Time-out for connecting to a cluster [s].
CONNECT_S = 10.0


class Engine(Protocol):
    """What the driver asks of an engine."""

    def submit(self, task: Task, attempt: int) -> Any:
        """Start or queue a task; returns a handle."""

    def finished(self, handles: Sequence[Any]) -> list[tuple[Any, dict[str, Any]]]:
        """Handles of tasks that ended, with their records; waits for one at most ``WAIT_S``."""

    def close(self) -> None:
        """Release the workers."""


def lost(reason: str) -> dict[str, Any]:
    """The record of a task whose worker could not write one; it may be retried."""
    return {"status": FAILED, "reason": reason, "again": True}


class Processes:
    """Processes of this machine.

    As many at a time as there are cores for the task with the most ``cpus``; one at a time if any
    task asks for a GPU.
    """

    def __init__(self, tasks: Sequence[Task]) -> None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        largest = max(task.cpus for task in tasks)
        gpus = any(task.gpus for task in tasks)
        self._pool = ThreadPoolExecutor(1 if gpus else max(1, (cores or 1) // largest))

    def submit(self, task: Task, attempt: int) -> Future[dict[str, Any]]:
        """Queue a task; it starts when a worker is free."""
        return self._pool.submit(run_task, asdict(task), attempt)

    def finished(
        self, handles: Sequence[Future[dict[str, Any]]]
    ) -> list[tuple[Future[dict[str, Any]], dict[str, Any]]]:
        """See Engine.finished."""
        done, _ = wait(handles, timeout=WAIT_S, return_when=FIRST_COMPLETED)
        return [(handle, _result(handle)) for handle in done]

    def close(self) -> None:
        """Start no other task, and wait for those that run."""
        self._pool.shutdown(cancel_futures=True)


def _result(handle: Future[dict[str, Any]]) -> dict[str, Any]:
    try:
        return handle.result()
    except Exception as error:
        return lost(f"{type(error).__name__}: {error}")


def _check_reachable(address: str) -> None:
    """Refuse an address where nothing listens: Ray itself would retry for a quarter of an hour."""
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdecimal() or "/" in host:
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise ProjectError(
            f"--address {address}: no Ray cluster ({error}); begin one with 'ray start --head', "
            "or give --address local"
        ) from None


class Ray:
    """A Ray cluster; each task asks for its cores, cards and memory."""

    def __init__(self, tasks: Sequence[Task], *, address: str, console: Console) -> None:
        # "auto" may find the address of a cluster that has ended: try 3 times, not 20, 40 s each.
        os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "3")
        try:
            import ray
        except ImportError:
            raise OptionError(
                "--engine ray: Ray is not installed; pip install 'gvtools[cluster]', or give "
                "--engine processes or slurm"
            ) from None
        _check_reachable(address)
        try:
            context = ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise ProjectError(
                f"--address {address}: no Ray cluster ({reason}); begin one with 'ray start "
                "--head', or give --address local"
            ) from None
        self._ray = ray
        self._remote = ray.remote(run_task)
        if context.dashboard_url:
            console.line(f"Ray's dashboard: http://{context.dashboard_url}")
        else:
            console.line("Ray's dashboard is not installed; pip install 'ray[default]' brings it")
        self._check(tasks, address, console)

    def _check(self, tasks: Sequence[Task], address: str, console: Console) -> None:
        """Warn of tasks that are too large for every node: they would wait for ever."""
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
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
        return self._remote.options(**options).remote(asdict(task), attempt)

    def finished(self, handles: Sequence[Any]) -> list[tuple[Any, dict[str, Any]]]:
        """Those that ended, also by the loss of their worker or machine."""
        done, _ = self._ray.wait(list(handles), num_returns=1, timeout=WAIT_S)
        return [(handle, self._record(handle)) for handle in done]

    def _record(self, handle: Any) -> dict[str, Any]:
        try:
            return dict(self._ray.get(handle))
        except self._ray.exceptions.RayError as error:
            first = (str(error).strip().splitlines() or [""])[0]
            return lost(f"worker lost ({type(error).__name__}: {first})")

    def close(self) -> None:
        """Leave the cluster; what still runs is ended."""
        self._ray.shutdown()
