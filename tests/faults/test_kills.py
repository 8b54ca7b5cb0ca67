"""Commands that are killed at random moments and given again end with undisturbed bytes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def killed(folder: Path, *words: str) -> list[dict]:
    """The cases of the harness in a process of its own, which forks before it has threads."""
    log = folder / "log.jsonl"
    program = ROOT / "tests" / "fixtures" / "kill_runs.py"
    done = subprocess.run(
        [sys.executable, str(program), str(folder), "--log", str(log), *words],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    cases = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    assert cases, done.stderr[-2000:]
    assert [case for case in cases if case["problem"]] == [], done.stdout
    assert done.returncode == 0
    return cases


@pytest.mark.slow
def test_two_hundred_kills_lose_nothing(tmp_path):
    cases = killed(tmp_path, "--kills", "200")
    counts = Counter(case["command"] for case in cases)
    assert sum(case["kills"] for case in cases) >= 200
    assert len(counts) >= 15
