"""The cameras of a run's rounds, each projected before its round begins."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.projection_cache import CachedProjection
from gvtools.kernels import parallel_kernels_may_overlap
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.reconstruction.plan import Plan


class RoundTargets:
    """The targets of each round as they follow the memory.

    While the targets of a round are completed, what observed views show of the next round's is
    projected in another thread, where projections are reused at all: completions do not change it.

    Args:
        plan: of the run.
        memory: that the rounds add to.
        appearance: shows what was observed; None leaves it to the memory.
    """

    def __init__(
        self, plan: Plan, memory: SpatialMemory, appearance: Appearance | None = None
    ) -> None:
        self.plan, self.memory, self.appearance = plan, memory, appearance
        self._pool = ThreadPoolExecutor(1)
        self._next: tuple[int, list[CachedProjection], list[Future[None]]] | None = None

    def __enter__(self) -> RoundTargets:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._pool.shutdown(cancel_futures=True)

    def of(self, number: int) -> list[CachedProjection]:
        """The targets of round ``number``, from 1, in order."""
        if self._next is None or self._next[0] != number:
            return self._projections(number)
        _, targets, looks = self._next
        self._next = None
        for look in looks:
            look.result()
        return targets

    def prefetch_round(self, number: int) -> None:
        """Begin to project what observed views show of round ``number``, if there is one."""
        if number > len(self.plan.schedule) or not parallel_kernels_may_overlap():
            return
        if self.plan.config.fusion.generated_as_observed:
            # A snapshot holds while generated points alone are fused.
            return
        targets = self._projections(number)
        snapshot = self.memory.snapshot()
        # One by one, so that a run that is stopped need not wait for all.
        looks = [self._pool.submit(target.prefetch, snapshot) for target in targets]
        self._next = (number, targets, looks)

    def _projections(self, number: int) -> list[CachedProjection]:
        config = self.plan.config
        return [
            CachedProjection(
                self.memory,
                camera,
                options=config.splat,
                reuse=config.savings.reuse,
                appearance=self.appearance,
            )
            for camera in self.plan.targets.cameras[list(self.plan.schedule[number - 1])]
        ]
