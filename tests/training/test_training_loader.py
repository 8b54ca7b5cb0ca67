from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from gvtools.errors import DegenerateError
from gvtools.training.batch import TrainingBatch
from gvtools.training.context_choice import ContextChoice
from gvtools.training.dataset import ProceduralViews
from gvtools.training.loader import BatchLoader
from gvtools.training.view_sample import collated

DATA = ProceduralViews(views=3, size=(24, 24), context=ContextChoice(most=2, group=4))


def _equal(a: TrainingBatch, b: TrainingBatch) -> bool:
    names = ("images", "depth", "valid", "cam_from_world", "K")
    same = [torch.equal(getattr(a.views, name), getattr(b.views, name)) for name in names]
    return all(same) and torch.equal(a.images, b.images) and torch.equal(a.depth, b.depth)


class _Half:
    """One of two processes' part of a step."""

    def __init__(self, rank: int) -> None:
        self.rank = rank

    def __call__(self, step: range) -> range:
        half = len(step) // 2
        return step[self.rank * half : (self.rank + 1) * half]


def test_workers_make_the_same_batches() -> None:
    """Two workers, one that begins later, and none: the same bytes."""
    plain = [collated([DATA.sample(n) for n in range(4 * i, 4 * i + 4)]) for i in range(3)]
    before = torch.get_rng_state()
    loader = BatchLoader(DATA, 4, workers=2)
    assert all(_equal(loader(range(4 * i, 4 * i + 4)), plain[i]) for i in range(2))
    loader.close()
    continued = BatchLoader(DATA, 4, workers=1)
    assert _equal(continued(range(8, 12)), plain[2])
    continued.close()
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_workers_and_shares(rank: int) -> None:
    loader = BatchLoader(DATA, 4, workers=1, share=_Half(rank))
    for step in (1, 2):
        numbers = range(4 * step + 2 * rank, 4 * step + 2 * rank + 2)
        assert _equal(loader(numbers), collated([DATA.sample(n) for n in numbers]))
    loader.close()


class Refusing:
    """A data set without samples."""

    def sample(self, index):
        raise DegenerateError(f"sample {index} cannot be drawn")

    def describe(self):
        return {}


_ORPHANS = """
import os, time
from gvtools.training.context_choice import ContextChoice
from gvtools.training.dataset import ProceduralViews
from gvtools.training.loader import BatchLoader

if __name__ == "__main__":
    data = ProceduralViews(views=3, size=(24, 24), context=ContextChoice(most=2, group=4))
    loader = BatchLoader(data, 2, workers=1)
    loader(range(2))
    import multiprocessing
    print(*(child.pid for child in multiprocessing.active_children()), flush=True)
    time.sleep(600)
"""


def test_workers_end_with_a_process_that_is_killed(tmp_path):
    (tmp_path / "parent.py").write_text(_ORPHANS)
    root = Path(__file__).resolve().parents[2]
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py")],
        env={**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"},
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


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (ProcessLookupError, FileNotFoundError):
        return False
    return state != "Z"


@pytest.mark.parametrize("workers", [0, 1])
def test_why_a_sample_is_missing_arrives_in_one_line(workers):
    loader = BatchLoader(Refusing(), 2, workers=workers)
    with pytest.raises(DegenerateError, match=r"^sample 0 cannot be drawn$"):
        loader(range(2))
    loader.close()
