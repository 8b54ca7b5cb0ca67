"""A completer that memory does not suffice for gets fewer views at a time, then one clear line."""

from __future__ import annotations

import re

import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.completers.base import Completer, Completion, run_completer
from gvtools.errors import OptionError
from gvtools.guidance import Guidance


class Hungry(Completer):
    """Fills with a number of the view's own; memory suffices for ``most`` views."""

    name = "hungry"
    batches_targets = True

    def __init__(self, most: int, error: Exception, *, rays: bool = False) -> None:
        super().__init__()
        self.most, self.error, self.rays = most, error, rays
        self.calls: list[int] = []

    def complete(self, context, guidance, *, seed=0):
        self.calls.append(len(guidance))
        if len(guidance) > self.most:
            raise self.error
        depth = guidance.depth + 1
        return Completion(
            guidance.rgb, depth, np.ones_like(depth),
            np.zeros((*depth.shape, 6), np.float32) if self.rays else None,
        )  # fmt: skip


def guidance(count: int) -> Guidance:
    one = Cameras.pinhole(8, 6, focal=8.0)
    cameras = Cameras(
        np.repeat(one.K, count, 0), np.repeat(one.cam_from_world, count, 0),
        np.full(count, 8), np.full(count, 6), tuple(f"view {row}" for row in range(count)),
    )  # fmt: skip
    shape = (count, 6, 8)
    valid = np.zeros(shape, bool)
    depth = np.broadcast_to(np.arange(count, dtype=np.float32)[:, None, None], shape).copy()
    return Guidance(
        cameras, np.zeros((*shape, 3), np.float32), depth, valid, np.zeros(shape, np.float32), valid
    )


ERRORS = (
    MemoryError(),
    RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
)


@pytest.mark.parametrize("error", ERRORS, ids=("python", "cuda", "cpu"))
@pytest.mark.parametrize("rays", [False, True])
def test_views_come_in_smaller_parts_and_in_order(error, rays):
    completer = Hungry(2, error, rays=rays)
    completion = run_completer(completer, (), guidance(7))
    np.testing.assert_array_equal(completion.depth[:, 0, 0], np.arange(7) + 1)
    assert completer.calls == [7, 3, 1, 2, 4, 2, 2]
    assert (completion.rays is not None) == rays


@pytest.mark.parametrize("error", ERRORS, ids=("python", "cuda", "cpu"))
def test_one_view_that_does_not_fit_is_one_line(error):
    said = r"completer hungry: memory does not suffice for one view of 8x6 .*--max-side 4"
    with pytest.raises(OptionError, match=said) as caught:
        run_completer(Hungry(0, error), (), guidance(3))
    assert not re.search("\n", str(caught.value))


def test_results_that_do_not_fit_together_are_one_line(monkeypatch):
    def full(parts, cameras):
        raise MemoryError("Unable to allocate 9 MiB")

    monkeypatch.setattr("gvtools.completers.base.Completion.joined", full)
    said = r"results of 2 views of 8x6 \(Unable to allocate 9 MiB\); expected fewer"
    with pytest.raises(OptionError, match=said) as caught:
        run_completer(Hungry(1, MemoryError()), (), guidance(2))
    assert not re.search("\n", str(caught.value))


def test_other_errors_are_no_lack_of_memory():
    completer = Hungry(0, RuntimeError("a shape is wrong"))
    with pytest.raises(RuntimeError, match="a shape is wrong"):
        run_completer(completer, (), guidance(4))
    assert completer.calls == [4]
