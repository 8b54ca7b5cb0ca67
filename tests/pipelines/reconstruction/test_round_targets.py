"""The next round's targets are projected beside this one's: nothing changes but the time."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from memory_scenes import camera, random_memory

from gvtools.cameras import concatenate
from gvtools.kernels import parallel_kernels_may_overlap
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.rounds import CachedProjection, RoundTargets
from pipelines.reconstruction.settings import RunSettings


@pytest.fixture
def memory() -> SpatialMemory:
    memory = random_memory(5)
    # With it, numba chooses how kernels run.
    memory.project(camera())
    if not parallel_kernels_may_overlap():
        pytest.skip("no OpenMP and no TBB: rounds are not looked at ahead")
    return memory


def plan(*rounds: int) -> Plan:
    """Of so many targets a round."""
    cuts = np.cumsum([0, *rounds])
    at = [camera(center=(0.1 * i, 0, 0), name=f"t{i}") for i in range(int(cuts[-1]))]
    return cast(
        Plan,
        SimpleNamespace(
            config=RunSettings(),
            schedule=tuple(tuple(range(a, b)) for a, b in pairwise(cuts)),
            targets=SimpleNamespace(cameras=concatenate(at)),
        ),
    )


def test_rounds_are_the_plans_whether_looked_at_ahead_or_not(memory):
    with RoundTargets(plan(1, 2), memory) as targets:
        assert [t.camera.names for t in targets.of(1)] == [("t0",)]
        targets.prefetch_round(2)
        ahead = targets.of(2)
        again = targets.of(2)
        targets.prefetch_round(3)
    assert [t.camera.names for t in ahead] == [t.camera.names for t in again] == [("t1",), ("t2",)]
    for one, two in zip(ahead, again, strict=True):
        np.testing.assert_array_equal(one.guidance().rgb, two.guidance().rgb)
        np.testing.assert_array_equal(one.guidance().depth, two.guidance().depth)


def test_an_error_comes_where_the_round_begins(memory, monkeypatch):
    def broken(self: CachedProjection, snapshot: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(CachedProjection, "prefetch", broken)
    with RoundTargets(plan(1, 1), memory) as targets:
        targets.prefetch_round(2)
        with pytest.raises(ZeroDivisionError):
            targets.of(2)
