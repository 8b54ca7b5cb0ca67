"""Running a fleet: the stages of a scene one after another, different scenes in parallel."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from pipelines.console import Console
from pipelines.fleet.engines import Engine
from pipelines.fleet.progress import Progress
from pipelines.fleet.spec import Task
from pipelines.fleet.storage import write_record
from pipelines.fleet.task import DONE, FAILED, finished, record_of


def run_fleet(
    tasks: Sequence[Task], make_engine: Callable[[list[Task]], Engine], *, console: Console
) -> None:
    """Run all tasks that are not finished; at the end every task has a record.

    A task whose worker died, or whose command may succeed the next time, is restarted up to its
    ``retries`` times; ``reconstruct`` resumes after its last complete round.

    Args:
        tasks: stage by stage.
        make_engine: makes an engine for the tasks that have to run; not called if there are none.
        console: shows progress.
    """
    before = {id(task): finished(task) for task in tasks}
    left = [task for task in tasks if before[id(task)] is None]
    if not left:
        console.line(f"all {len(tasks)} tasks were finished before")
        return
    chains: dict[str, deque[Task]] = {}
    for task in left:
        chains.setdefault(task.scene, deque()).append(task)
    engine = make_engine(left)
    try:
        with Progress(tasks, left, console) as progress:
            _drive(chains, engine, progress)
    finally:
        engine.close()


def _drive(chains: dict[str, deque[Task]], engine: Engine, progress: Progress) -> None:
    running: dict[Any, tuple[Task, int]] = {}

    def begin(task: Task, attempt: int) -> None:
        running[engine.submit(task, attempt)] = task, attempt
        progress.began(task)

    for chain in chains.values():
        begin(chain.popleft(), 1)
    while running:
        for handle, record in engine.finished(list(running)):
            task, attempt = running.pop(handle)
            chain = chains[task.scene]
            if record["status"] == DONE:
                progress.ended(task, record)
                if chain:
                    begin(chain.popleft(), 1)
            elif record["again"] and attempt <= task.retries:
                progress.again(task, record["reason"], attempt)
                begin(task, attempt + 1)
            else:
                _give_up(task, record, attempt)
                progress.ended(task, record)
                while chain:
                    later = chain.popleft()
                    skipped = {"status": FAILED, "reason": f"stage {task.stage} failed"}
                    _give_up(later, skipped, 0)
                    progress.ended(later, skipped)
        progress.show()


def _give_up(task: Task, record: dict[str, Any], attempts: int) -> None:
    head = {"scene": task.scene, "stage": task.stage, "attempts": attempts,
            "project": task.project, "command": [*task.command]}  # fmt: skip
    write_record(record_of(task), {**head, **record})
