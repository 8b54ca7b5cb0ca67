from __future__ import annotations

import os
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch

from gvtools.errors import DegenerateError, OptionError
from gvtools.training.batch import TrainingBatch
from gvtools.training.context_choice import ContextOptions
from gvtools.training.dataset import ProceduralViews
from gvtools.training.loader import BatchLoader
from gvtools.training.view_sample import Sample, collated

DATA = ProceduralViews(views=3, size=(24, 24), context=ContextOptions(most=2, group=4))


class Counting:
    """A data set of plain numbers that notes what is asked of it."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def sample(self, index: int) -> Sample:
        self.asked.append(index)
        number = torch.full((1, 1, 1, 1), float(index))
        eye = torch.eye(4)[None]
        return Sample(
            images=number.expand(1, 3, 1, 1), depth=number, hint=number.expand(1, 3, 1, 1),
            hint_depth=number, valid=number > -1, cam_from_world=eye, K=eye[:, :3, :3],
            place=torch.zeros(1, dtype=torch.int64), context=1,
        )  # fmt: skip

    def describe(self) -> dict[str, Any]:
        return {}


def _numbers(batch: TrainingBatch) -> list[int]:
    return [int(n) for n in batch.depth.flatten()]


def _equal(a: TrainingBatch, b: TrainingBatch) -> bool:
    names = ("images", "depth", "valid", "cam_from_world", "K")
    same = [torch.equal(getattr(a.views, name), getattr(b.views, name)) for name in names]
    return all(same) and torch.equal(a.images, b.images) and torch.equal(a.depth, b.depth)


def test_batches_in_order_and_from_where_the_state_says() -> None:
    loader = BatchLoader(Counting(), 4)
    first = list(islice(loader, 3))
    assert [_numbers(batch) for batch in first] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]
    state = loader.state_dict()
    assert state == {"next_index": 12}
    other = BatchLoader(Counting(), 4)
    other.load_state_dict(state)
    assert _numbers(next(iter(other))) == _numbers(next(iter(loader))) == [12, 13, 14, 15]


class _Half:
    """One of two processes' part of a step."""

    def __init__(self, rank: int) -> None:
        self.rank = rank

    def __call__(self, step: range) -> range:
        half = len(step) // 2
        return step[self.rank * half : (self.rank + 1) * half]


def test_processes_share_a_step() -> None:
    parts = [BatchLoader(Counting(), 4, share=_Half(rank)) for rank in (0, 1)]
    batches = [[_numbers(batch) for batch in islice(part, 2)] for part in parts]
    assert batches == [[[0, 1], [4, 5]], [[2, 3], [6, 7]]]


def test_any_numbers_can_be_asked_for() -> None:
    loader = BatchLoader(Counting(), 4)
    assert _numbers(loader(range(5, 7))) == [5, 6]
    assert loader.next_index == 7
    assert _numbers(next(iter(loader))) == [7]
    with pytest.raises(OptionError, match="no samples"):
        loader(range(3, 3))


def test_workers_make_the_same_batches() -> None:
    """Two workers, one that is continued, and none: the same bytes."""
    plain = [collated([DATA.sample(n) for n in range(4 * i, 4 * i + 4)]) for i in range(3)]
    before = torch.get_rng_state()
    loader = BatchLoader(DATA, 4, workers=2)
    made = list(islice(loader, 2))
    assert all(_equal(a, b) for a, b in zip(made, plain, strict=False))
    state = loader.state_dict()
    loader.close()
    continued = BatchLoader(DATA, 4, workers=1)
    continued.load_state_dict(state)
    assert _equal(next(iter(continued)), plain[2])
    continued.close()
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_workers_and_shares(rank: int) -> None:
    loader = BatchLoader(DATA, 4, workers=1, share=_Half(rank), start=4)
    for step, batch in enumerate(islice(loader, 2), start=1):
        numbers = range(4 * step + 2 * rank, 4 * step + 2 * rank + 2)
        assert _equal(batch, collated([DATA.sample(n) for n in numbers]))
    loader.close()


class Refusing:
    """A data set without samples."""

    def sample(self, index):
        raise DegenerateError(f"sample {index} cannot be drawn")

    def describe(self):
        return {}


_ORPHANS = """
import os, time
from gvtools.training.context_choice import ContextOptions
from gvtools.training.dataset import ProceduralViews
from gvtools.training.loader import BatchLoader

if __name__ == "__main__":
    data = ProceduralViews(views=3, size=(24, 24), context=ContextOptions(most=2, group=4))
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
