"""A training's stages, and its log: one JSON line a record."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gvtools.files import write_text
from gvtools.untrusted import parse_json, read_text

STAGES = ("encoder", "denoiser", "reflow", "heads", "refiner")  # in order
LOG = "log.jsonl"


class TrainingLog:
    """Appends records; those after the step that a training is resumed at are dropped."""

    def __init__(self, folder: Path, *, step: int = 0) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / LOG
        kept = [line for line in read_log(folder) if line["step"] <= step]
        text = "".join(json.dumps(line) + "\n" for line in kept)
        write_text(self.path, text)

    def write(self, step: int, values: dict[str, float]) -> None:
        """One record."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": step, **values}) + "\n")


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The whole records of a stage; a line that was cut by a kill is left out."""
    path = folder / LOG
    records = []
    for line in read_text(path).splitlines() if path.exists() else ():
        try:
            records.append(parse_json(line))
        except ValueError:
            continue
    return records
