"""How far a fleet is: one table on a terminal, a line for each event elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from pipelines.console import Console
from pipelines.fleet.spec import Task
from pipelines.fleet.task import DONE

_STATES = ("done", "running", "waiting", "failed", "again")


class Progress:
    """Counts by stage."""

    def __init__(self, tasks: Sequence[Task], left: Sequence[Task], console: Console) -> None:
        self._console, self._total = console, len(tasks)
        self._counts: dict[str, Counter[str]] = {task.stage: Counter() for task in tasks}
        for task in tasks:
            self._counts[task.stage]["done"] += 1
        for task in left:
            self._counts[task.stage]["done"] -= 1
            self._counts[task.stage]["waiting"] += 1
        self._live: Any = None
        before = self._total - len(left)
        console.line(f"{self._total} tasks" + (f", {before} finished before" if before else ""))

    def __enter__(self) -> Progress:
        if self._console.interactive:
            from rich.live import Live

            self._live = Live(self._table(), auto_refresh=False, transient=True)
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def began(self, task: Task) -> None:
        """A task was given to the engine."""
        self._counts[task.stage].update(running=1, waiting=-1)

    def again(self, task: Task, reason: str, attempt: int) -> None:
        """A task is begun once more."""
        self._counts[task.stage].update(running=-1, waiting=1, again=1)
        self._console.warn(f"{task.scene} {task.stage}: attempt {attempt} failed: {reason}")

    def ended(self, task: Task, record: dict[str, Any]) -> None:
        """A task is done, or given up; one that never began was waiting."""
        state = "running" if "again" in record else "waiting"
        done = record["status"] == DONE
        self._counts[task.stage].update({state: -1, "done" if done else "failed": 1})
        over = sum(count["done"] + count["failed"] for count in self._counts.values())
        head = f"[{over}/{self._total}] {task.scene} {task.stage}"
        if not done:
            self._console.warn(f"{head}: failed: {record['reason']}")
        elif self._live is None:
            self._console.line(f"{head}: {record['seconds']:.1f} s on {record['node']}")

    def show(self) -> None:
        """Draw the table anew."""
        if self._live is not None:
            self._live.update(self._table(), refresh=True)

    def _table(self) -> Any:
        from rich.table import Table

        table = Table("stage", *_STATES)
        for stage, counts in self._counts.items():
            table.add_row(stage, *(str(counts[state]) for state in _STATES))
        return table
