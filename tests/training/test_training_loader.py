from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from training_runs import ROOT, child

from gvtools.errors import DegenerateError
from gvtools.training.loader import batches
from gvtools.training.samples import TrainingBatch
from gvtools.training.views import ContextChoice, ProceduralViews

DATA = ProceduralViews(views=3, size=(24, 24), context=ContextChoice(most=2, group=4))


def _equal(a: TrainingBatch, b: TrainingBatch) -> bool:
    names = ("images", "depth", "valid", "cam_from_world", "K")
    same = [torch.equal(getattr(a.views, name), getattr(b.views, name)) for name in names]
    return all(same) and torch.equal(a.images, b.images) and torch.equal(a.depth, b.depth)


@pytest.mark.slow
def test_workers_make_the_same_batches() -> None:
    parts = [range(4 * i, 4 * i + 4) for i in range(3)]
    plain = list(batches(DATA, parts, workers=0))
    before = torch.get_rng_state()
    made = batches(DATA, parts, workers=2)
    assert all(_equal(next(made), batch) for batch in plain[:2])
    made.close()
    continued = batches(DATA, parts[2:], workers=1)
    assert _equal(next(continued), plain[2])
    assert torch.equal(before, torch.get_rng_state())


class Refusing:
    def sample(self, index):
        raise DegenerateError(f"sample {index} cannot be drawn")

    def describe(self):
        return {}


# A process with a worker, as it goes on.
_PARENT = """
import multiprocessing, os, signal, time
from gvtools.errors import ProjectError
from gvtools.training.loader import batches
from gvtools.training.views import ContextChoice, ProceduralViews

if __name__ == "__main__":
    data = ProceduralViews(views=3, size=(24, 24), context=ContextChoice(most=2, group=4))
    made = batches(data, (range(2 * i, 2 * i + 2) for i in range(10_000)), workers=1)
    next(made)
    workers = [child.pid for child in multiprocessing.active_children()]
"""
_WAITING = """
    print(*workers, flush=True)
    time.sleep(600)
"""
_KILLING = """
    os.kill(workers[0], signal.SIGKILL)
    try:
        for batch in made:
            pass
    except ProjectError as error:
        print(error)
"""


@pytest.mark.slow
def test_workers_end_with_a_process_that_is_killed(tmp_path):
    (tmp_path / "parent.py").write_text(_PARENT + _WAITING)
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py")],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    workers = [int(word) for word in parent.stdout.readline().split()]
    assert workers
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and any(_runs(worker) for worker in workers):
        time.sleep(0.1)
    assert not any(_runs(worker) for worker in workers)


@pytest.mark.slow
def test_a_worker_that_dies_is_one_line(tmp_path):
    (tmp_path / "parent.py").write_text(_PARENT + _KILLING)
    (line,) = child(tmp_path / "parent.py").splitlines()
    assert "a process that makes samples has died" in line and "--resume" in line


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (ProcessLookupError, FileNotFoundError):
        return False
    return state != "Z"


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_why_a_sample_is_missing_arrives_in_one_line(workers):
    with pytest.raises(DegenerateError, match=r"^sample 0 cannot be drawn$"):
        next(batches(Refusing(), [range(2)], workers=workers))
