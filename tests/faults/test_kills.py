"""Commands that are killed at random moments and given again end with undisturbed bytes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_two_hundred_kills_lose_nothing(tmp_path):
    """In a process of its own, which forks before it has threads."""
    program = ROOT / "tests" / "fixtures" / "kill_runs.py"
    done = subprocess.run(
        [sys.executable, str(program), str(tmp_path / "kills"), "--kills", "200"],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    cases = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, done.stderr[-2000:]
    assert [case for case in cases if case["problem"]] == []
    assert sum(case["kills"] for case in cases) >= 200
    assert len({case["command"] for case in cases}) >= 15
