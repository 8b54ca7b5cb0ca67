"""What became of a fleet: one table, as text, CSV, Markdown and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gvtools.evaluation.tables import Column, Table, csv_text, markdown
from gvtools.files import write_json, write_text
from pipelines.console import Console
from pipelines.fleet.spec import Task, is_url
from pipelines.fleet.storage import read_record, write_record
from pipelines.fleet.task import DONE, record_of

NOT_RUN = "not run"


def collect(tasks: Sequence[Task]) -> list[dict[str, Any]]:
    """A record of every task; one without any has the status "not run"."""
    records = []
    for task in tasks:
        head = {"scene": task.scene, "stage": task.stage, "status": NOT_RUN,
                "reason": "left no record"}  # fmt: skip
        found = read_record(record_of(task))
        if found is not None and found.get("command") != [*task.command]:
            found, head["reason"] = None, "was run with another command"
        records.append({**head, **(found or {})})
    return sorted(records, key=lambda record: record["scene"])


def result_table(records: Sequence[dict[str, Any]]) -> Table:
    """A row for each stage of each scene; a column for each figure that any has."""
    figures = sorted({name for record in records for name in record.get("figures", {})})
    heads = ("scene", "stage", "status", "attempts", "seconds", "node", *figures, "reason")
    rows = [
        (
            *(record.get(name) for name in heads[:6]),
            *(record.get("figures", {}).get(name) for name in figures),
            record.get("reason") or None,
        )
        for record in records
    ]
    return Table(tuple(Column(head) for head in heads), tuple(rows), caption="Fleet")


def report(tasks: Sequence[Task], root: str, console: Console) -> list[dict[str, Any]]:
    """Write results.json (and .csv, .md where the root is a path), print; returns what failed."""
    records = collect(tasks)
    table = result_table(records)
    if is_url(root):
        write_record(f"{root}/results.json", {"tasks": records})
    else:
        write_json(Path(root) / "results.json", {"tasks": records})
        write_text(Path(root) / "results.csv", csv_text(table))
        write_text(Path(root) / "results.md", markdown(table))
    heads = ("scene", "stage", "status", "attempts", "seconds", "node", "reason")
    console.table(heads, [[record.get(name) or None for name in heads] for record in records])
    failed = [record for record in records if record["status"] != DONE]
    console.line(f"{len(records) - len(failed)} of {len(records)} tasks done; results in {root}")
    return failed
