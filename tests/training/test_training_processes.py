"""The group that ``torchrun`` starts, and its end."""

from __future__ import annotations

from pathlib import Path

import pytest
from training_runs import on_two

pytestmark = pytest.mark.slow

THREADS = Path("/proc/self/task")
PROGRAM = """
import sys
from pathlib import Path

import torch
import torch.distributed as dist

from gvtools.training.distributed import join_processes


def threads() -> int:
    return sum("gloo" in name.read_text() for name in Path("/proc/self/task").glob("*/comm"))


with join_processes("cpu") as processes:
    import torch._dynamo  # as optimizers do, on their first step

    dist.all_reduce(torch.ones(3))
    before = threads()
print(f"threads {before} then {threads()}.")
"""


@pytest.mark.skipif(not THREADS.exists(), reason="the system lists no threads in /proc")
def test_no_thread_of_the_group_outlives_it(tmp_path):
    """One that did could abort the process at its end."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    said = on_two(program)
    assert said.count("then 0.") == 2 and "threads 0" not in said
