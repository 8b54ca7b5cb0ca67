"""Timing two ways of doing the same thing in one process, turn by turn."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

# OpenMP workers of the call before keep a core busy for up to 0.2 s, waiting for more work.
SETTLE_SECONDS = 0.25


@dataclass(frozen=True)
class Comparison:
    """One row of a benchmark.

    Attributes:
        name: what was done.
        peer: what a user would otherwise call.
        ours_s: median seconds.
        peer_s: median seconds.
        ours_min_s: shortest; on a machine that does other work, nearest to the true cost.
        peer_min_s: shortest.
        repeats: timed turns of each.
        note: what else was found, such as how far the results agree.
    """

    name: str
    peer: str
    ours_s: float
    peer_s: float
    ours_min_s: float
    peer_min_s: float
    repeats: int
    note: str = ""

    @property
    def ratio(self) -> float:
        """Ours over the peer's, of the medians: below 1 is faster."""
        return self.ours_s / self.peer_s

    @property
    def ratio_of_minima(self) -> float:
        """Ours over the peer's, of the shortest times."""
        return self.ours_min_s / self.peer_min_s

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, with the ratios."""
        ratios = {"ratio": self.ratio, "ratio_of_minima": self.ratio_of_minima}
        return asdict(self) | ratios


def alternate(
    calls: Sequence[Callable[[int], object]],
    repeat: int,
    *,
    warm_up: int = 1,
    steady: bool = False,
) -> list[list[float]]:
    """Seconds of each call, the calls taking turns so that disturbances hit all alike.

    Args:
        calls: each is given the turn's number, warm-ups included.
        repeat: timed turns.
        warm_up: turns before them (compilation, caches).
        steady: in each turn, call once untimed right before, so that what is timed is one call of
            a stream of such calls; only for calls that change nothing.
    """
    seconds: list[list[float]] = [[] for _ in calls]
    for turn in range(warm_up + repeat):
        for call, kept in zip(calls, seconds, strict=True):
            gc.collect()
            time.sleep(SETTLE_SECONDS)
            if steady:
                call(turn)
            start = time.perf_counter()
            call(turn)
            elapsed = time.perf_counter() - start
            if turn >= warm_up:
                kept.append(elapsed)
    return seconds


def comparison(
    name: str, peer: str, ours_s: list[float], *, peer_s: list[float], note: str = ""
) -> Comparison:
    """Medians and minima of two lists of seconds."""
    return Comparison(
        name,
        peer,
        statistics.median(ours_s),
        statistics.median(peer_s),
        min(ours_s),
        min(peer_s),
        len(ours_s),
        note,
    )
