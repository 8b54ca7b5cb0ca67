"""A round's targets: completed together where wanted, projected no oftener than needed."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from memory_scenes import camera as view_from
from memory_scenes import random_memory

from gvtools.cameras import Cameras
from gvtools.cameras import concatenate as all_of
from gvtools.completers.base import Completer, Completion, ScaleAlignment, ScaleStatus
from gvtools.errors import ShapeError
from gvtools.guidance import Guidance, concatenate
from gvtools.kernels import parallel_kernels_may_overlap
from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
from gvtools.settings import with_texts
from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.rounds import (
    CachedProjection,
    Clock,
    RoundTargets,
    complete_targets,
)
from pipelines.reconstruction.settings import RunSettings


def camera(name: str, size: tuple[int, int], x: float = 0.0) -> Cameras:
    height, width = size
    pose = np.eye(4)
    pose[0, 3] = -x
    K = np.array([[40.0, 0, width / 2], [0, 40.0, height / 2], [0, 0, 1]])
    return Cameras(K[None], pose[None], np.array([width]), np.array([height]), names=(name,))


class Recorder(Completer):
    """Fills holes with one grey and depth 2, or leaves them."""

    name = "recorder"

    def __init__(self, *, batches_targets: bool, fill: bool = True, factor: float | None = None):
        super().__init__()
        self.batches_targets, self.fill, self.factor = batches_targets, fill, factor
        self.status = ScaleStatus.CAMERA_CENTRES
        self.whole = False
        self.batches: list[tuple[str, ...]] = []

    def complete(self, context, guidance: Guidance, *, seed: int = 0) -> Completion:
        self.batches.append(guidance.cameras.names)
        hole = (~guidance.valid | self.whole) & self.fill
        rgb = np.where(hole[..., None], np.float32(0.5), guidance.rgb)
        depth = np.where(hole, np.float32(2), guidance.depth)
        confidence = np.where(hole, np.float32(0.5), np.minimum(guidance.confidence, 1))
        if self.factor is not None:
            depth = (depth * self.factor).astype(np.float32)
            return Completion(rgb, depth, confidence.astype(np.float32))
        alignment = (ScaleAlignment(self.status),) * len(rgb)
        return Completion(
            rgb, depth, confidence.astype(np.float32), scale_alignment=alignment, whole=self.whole
        )


@pytest.fixture
def memory() -> SpatialMemory:
    out = SpatialMemory(0.02)
    seen = camera("seen", (24, 32))
    rgb = np.full((24, 32, 3), 200, np.uint8)
    out.observe(rgb, np.full((24, 32), 2, np.float32), seen, round=0)
    return out


def complete(memory: SpatialMemory, completer: Recorder, targets: list[Cameras], *settings: str):
    calls: list[str] = []
    project = memory.project

    def counted(cameras, **options):
        calls.append(cameras.names[0])
        return project(cameras, **options)

    followed = [CachedProjection(memory, target, reuse=False) for target in targets]
    for target in followed:
        target.guidance()
    memory.project = counted  # type: ignore[method-assign]
    config = with_texts(RunSettings(), settings)
    results = list(complete_targets(
        followed, 1, memory=memory, completer=completer, context=(), config=config, clock=Clock(),
    ))  # fmt: skip
    return results, sum((result.fusion for result in results), FuseReport()), calls


def test_targets_of_different_sizes_are_completed_together_by_size(memory):
    sizes = [(24, 32), (32, 24), (24, 32), (32, 24)]
    targets = [camera(f"t{i}", size, x=0.3 * i) for i, size in enumerate(sizes)]
    completer = Recorder(batches_targets=True)
    results, total, calls = complete(memory, completer, targets)
    assert completer.batches == [("t0", "t2"), ("t1", "t3")] and not calls
    assert [r.guidance.cameras.names[0] for r in results] == ["t0", "t1", "t2", "t3"]
    for result, size in zip(results, sizes, strict=True):
        assert result.completion.depth.shape == (1, *size)
        assert (result.completion.depth > 0).all()
    assert total.added > 0


def test_a_later_target_sees_what_an_earlier_one_added(memory):
    targets = [camera("t0", (24, 32), x=0.4), camera("t1", (24, 32), x=0.4)]
    results, _, calls = complete(memory, Recorder(batches_targets=False), targets)
    assert calls == ["t1"]
    assert results[1].guidance.generated.any() and not results[0].guidance.generated.any()


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_depth_of_another_unit_is_aligned_with_the_memory(memory, factor):
    completer = Recorder(batches_targets=True, factor=factor)
    ((result,), total, _) = complete(memory, completer, [camera("t0", (24, 32), x=0.3)])
    scale = result.figures["scale"]
    assert scale["status"] == ScaleStatus.MEMORY_DEPTH and scale["accepted"]
    assert scale["scale"] == pytest.approx(1 / factor, rel=1e-5)
    assert scale["overlap_px"] == result.guidance.valid.sum()
    assert total.added > 0
    shown = memory.project(camera("t0", (24, 32), x=0.3))
    assert shown.generated.any()
    np.testing.assert_allclose(shown.depth[shown.generated], 2, rtol=1e-3)


def test_a_scale_that_the_completer_refuses_gives_no_points(memory):
    completer = Recorder(batches_targets=True)
    completer.status = ScaleStatus.CONTRADICTED
    ((result,), total, _) = complete(memory, completer, [camera("t0", (24, 32), x=0.3)])
    assert not total.added and not result.fused.any()
    assert not result.figures["scale"]["accepted"]
    assert result.figures["scale"]["description"].startswith("refused: known depth contradicts")


@pytest.mark.parametrize("pixels", ["holes", "all"])
@pytest.mark.parametrize("as_observed", ["false", "true"])
def test_whole_generated_views_are_fused_as_the_settings_say(memory, pixels, as_observed):
    completer = Recorder(batches_targets=True)
    completer.whole = True
    target, before = camera("t0", (24, 32), x=0.4), len(memory)
    settings = (f"fusion.pixels={pixels}", f"fusion.generated_as_observed={as_observed}")
    ((result,), _, _) = complete(memory, completer, [target], *settings)
    assert (result.completion.rgb == 0.5).all()
    known = result.guidance.valid[0]
    assert 0 < known.sum() < known.size
    assert (result.fused | known).all()
    assert result.fused[known].all() if pixels == "all" else not result.fused[known].any()
    shown = memory.project(target)
    if as_observed == "true":
        assert not memory.generated.any() and len(memory) > before
        grey = np.abs(shown.rgb[0][known] - 0.5).max(-1) < 0.1
        assert (grey.mean() > 0.5) == (pixels == "all")
    else:
        assert memory.generated.any() and shown.generated[0][~known].any()
        # What was observed stands, whatever is generated there.
        assert (shown.rgb[0][known] > 0.7).all()


def test_nothing_is_projected_again_while_nothing_is_fused(memory):
    targets = [camera(f"t{i}", (24, 32), x=0.4) for i in range(3)]
    _, total, calls = complete(memory, Recorder(batches_targets=False, fill=False), targets)
    assert not total.points and not calls


def test_guidance_of_one_size_makes_a_batch_and_of_two_sizes_is_refused(memory):
    views = [memory.project(camera(f"t{i}", (24, 32), x=0.1 * i)) for i in range(2)]
    both = concatenate(views)
    assert both.cameras.names == ("t0", "t1")
    for index, view in enumerate(views):
        assert np.array_equal(both[index].rgb, view.rgb)
        assert np.array_equal(both[index].valid, view.valid)
    with pytest.raises(ShapeError, match="2 picture sizes"):
        concatenate([*views, memory.project(camera("t2", (32, 24)))])
    with pytest.raises(ShapeError, match="0 picture sizes"):
        concatenate([])


# Targets that are looked at ahead.


@pytest.fixture
def seen() -> SpatialMemory:
    memory = random_memory(5)
    # With it, numba chooses how kernels run.
    memory.project(view_from())
    if not parallel_kernels_may_overlap():
        pytest.skip("no OpenMP and no TBB: rounds are not looked at ahead")
    return memory


def plan(*rounds: int) -> Plan:
    """Of so many targets a round."""
    cuts = np.cumsum([0, *rounds])
    at = [view_from(center=(0.1 * i, 0, 0), name=f"t{i}") for i in range(int(cuts[-1]))]
    return cast(
        Plan,
        SimpleNamespace(
            config=RunSettings(),
            schedule=tuple(tuple(range(a, b)) for a, b in pairwise(cuts)),
            targets=SimpleNamespace(cameras=all_of(at)),
        ),
    )


def test_rounds_are_the_plans_whether_looked_at_ahead_or_not(seen):
    with RoundTargets(plan(1, 2), seen) as targets:
        assert [t.camera.names for t in targets.of(1)] == [("t0",)]
        targets.prefetch_round(2)
        ahead = targets.of(2)
        again = targets.of(2)
        targets.prefetch_round(3)
    assert [t.camera.names for t in ahead] == [t.camera.names for t in again] == [("t1",), ("t2",)]
    for one, two in zip(ahead, again, strict=True):
        np.testing.assert_array_equal(one.guidance().rgb, two.guidance().rgb)
        np.testing.assert_array_equal(one.guidance().depth, two.guidance().depth)
