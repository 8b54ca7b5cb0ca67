"""Successive halving over knobs: many settings on few targets, few settings on all of them.

First every knob by itself, on a small share of the targets. Time, memory and PSNR are then taken
as sums of the knobs' own effects (of their logarithms; of PSNR itself), which predicts every
combination; combinations on the predicted front are tried on a larger share, the prediction is
corrected by what they gave, and the best of what was measured is tried on all targets.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError
from pipelines.tradeoff.outcome import Outcome, front
from pipelines.tradeoff.search_axes import (
    Knob,
    Point,
    Settings,
    delivers_less,
    neighbours,
    settings_of,
    usual,
)

# Shares of the targets, by stage.
SHARES = (0.25, 0.5, 1.0)
# Combinations of the predicted front that are tried, and those of them that are on all targets.
COMBINED, FINAL = 8, 5
# Trials of one knob that are, where the start is beyond the budget.
ALONE = 2
# dB that tell no two trials apart.
EQUAL = 0.02
# dB below the best that nobody wants, where anything else is within the budget.
POOR = 2.0
# dB, for predictions.
MOST = 99.0
# Combinations that are looked at; more are drawn at random.
LOOKED_AT = 50_000
# Pull of the effects towards 0, so that combinations cannot be explained by two knobs at once.
RIDGE = 1e-3
Run = Callable[[Settings, float], Outcome]


@dataclass(frozen=True)
class Tried:
    """A trial.

    Attributes:
        label: what it was tried for.
        point: its knobs' levels; None for settings of their own, such as a profile.
        share: of the targets.
        outcome: what it gave.
    """

    label: str
    point: Point | None
    share: float
    outcome: Outcome


@dataclass
class Search:
    """A sweep in progress.

    Attributes:
        knobs: what is varied.
        run: makes a trial of settings on a share of the targets.
        targets: of a whole run.
        limit: seconds that the sweep may take; trials that would not fit are left out.
        say: is told of each trial.
        kept: what a trial gave in an earlier sweep, or None; such trials take no time.
        of_bytes: the budget is one of memory, which then is what accuracy is weighed against.
        clock: seconds, for tests.
    """

    knobs: Sequence[Knob]
    run: Run
    targets: int
    limit: float
    say: Callable[[str], None] = print
    kept: Callable[[Settings, float], Outcome | None] = lambda settings, share: None
    of_bytes: bool = False
    clock: Callable[[], float] = time.perf_counter
    tried: list[Tried] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    _end: float = field(init=False, default=0.0)
    _given: set[str] = field(init=False, default_factory=set)

    def sweep(self, named: Sequence[tuple[str, Settings]], fits: Callable[[Outcome], bool]) -> None:
        """All stages.

        Args:
            named: settings of their own to try beside the knobs, such as profiles.
            fits: whether a whole run of an outcome is within the user's budget.
        """
        self._end = self.clock() + self.limit
        self._given = {"start", *(name for name, _ in named)}
        base = usual(self.knobs)
        self._try("start", base, SHARES[0])
        if not self.tried:
            why = self.refused.get("start")
            raise GvError(
                f"the run that was asked for is refused: {why}"
                if why
                else f"a limit of {self.limit:g} s leaves no time for a trial; expected more"
            )
        for name, settings in named:
            self._try_settings(name, settings, None, SHARES[0])
        for point in neighbours(self.knobs, base):
            self._try(self._change(point), point, SHARES[0])
        for point in self._promising(fits):
            self._try("combination", point, SHARES[1])
        for entry in self._finalists(fits):
            self._try_settings(entry.label, entry.outcome.settings, entry.point, SHARES[-1])

    def seconds(self, outcome: Outcome) -> float:
        """Of a whole run."""
        return outcome.seconds(self.targets)

    def cost(self, outcome: Outcome) -> float:
        """What the budget is of: seconds of a whole run, or bytes."""
        return outcome.bytes if self.of_bytes else self.seconds(outcome)

    def whole(self) -> list[Tried]:
        """Trials on all targets, or on the greatest share that any was made on."""
        most = max((entry.share for entry in self.tried), default=SHARES[-1])
        return [entry for entry in self.tried if entry.share == most]

    def predicted(self, points: Sequence[Point]) -> NDArray[np.float64]:
        """(N, 3) seconds of a whole run, bytes, PSNR of points, by the sum of the knobs' effects.

        What is known of a share's targets is told from what is known of the knobs by a term of
        the share's own; predictions are for the smallest share's targets.
        """
        known = [entry for entry in self.tried if entry.point is not None]
        rows = np.stack([self._row(entry.point, entry.share) for entry in known])  # type: ignore[arg-type]
        values = np.array([self._values(entry.outcome) for entry in known])
        mean = values.mean(0)
        gram = rows.T @ rows + RIDGE * np.eye(rows.shape[1])
        effects = np.linalg.solve(gram, rows.T @ (values - mean))
        found = np.stack([self._row(point, SHARES[0]) for point in points]) @ effects + mean
        found[:, :2] = np.exp(found[:, :2])
        return found

    def _values(self, outcome: Outcome) -> tuple[float, float, float]:
        return (
            float(np.log(outcome.seconds(self.targets))),
            float(np.log(max(outcome.bytes, 1.0))),
            # Equal pictures have infinitely many.
            min(outcome.psnr, MOST),
        )

    def _row(self, point: Point, share: float) -> NDArray[np.float64]:
        """Indicators of levels that are not the usual ones, and of the share."""
        row = []
        for knob, level in zip(self.knobs, point, strict=True):
            row += [float(level == i) for i in range(len(knob.levels)) if i != knob.usual]
        row += [float(share == other) for other in SHARES[1:]]
        return np.array(row)

    def _promising(self, fits: Callable[[Outcome], bool]) -> list[Point]:
        """Points on the predicted front, half of them of what delivers as much as the start.

        The best that is predicted to be within the budget comes first.
        """
        points = list(self._combinations())
        whole = [p for p in points if not delivers_less(self.knobs, settings_of(self.knobs, p))]
        found = self._best_within(whole, fits) or self._best_within(points, fits)
        if len(whole) == len(points):
            found += self._spread(points, COMBINED)
        else:
            found += self._spread(whole, COMBINED // 2) + self._spread(points, COMBINED // 2)
        return list(dict.fromkeys(found))

    def _best_within(self, points: Sequence[Point], fits: Callable[[Outcome], bool]) -> list[Point]:
        """The point of some that is predicted to be the most accurate within the budget, if any."""
        values = self.predicted(points)
        like = self.tried[0].outcome
        for index in np.argsort(-values[:, 2], kind="stable"):
            seconds, size, _ = map(float, values[index])
            if fits(replace(like, fixed=seconds, per_target=0.0, bytes=size)):
                return [points[index]]
        return []

    def _spread(self, points: Sequence[Point], count: int) -> list[Point]:
        """``count`` points on the predicted front of some, spread over its costs."""
        values = self.predicted(points)
        cost = values[:, int(self.of_bytes)]
        order = np.lexsort((-values[:, 2], cost))
        best = -np.inf
        found: list[int] = []
        for index in order:
            if values[index, 2] > best + EQUAL:
                best = values[index, 2]
                found.append(int(index))
        # Evenly over the front's log-cost, its ends included.
        costs = np.log(cost[found])
        wanted = np.linspace(costs[0], costs[-1], count)
        chosen = sorted({int(np.abs(costs - one).argmin()) for one in wanted})
        return [points[found[i]] for i in chosen]

    def _combinations(self) -> Iterable[Point]:
        """All points whose levels have each been tried, or a random draw of them."""
        levels = []
        for at, knob in enumerate(self.knobs):
            seen = {entry.point[at] for entry in self.tried if entry.point is not None}
            levels.append([i for i in range(len(knob.levels)) if i in seen])
        total = int(np.prod([len(choice) for choice in levels]))
        if total <= LOOKED_AT:
            yield from itertools.product(*levels)
            return
        rng = np.random.default_rng(0)
        for _ in range(LOOKED_AT):
            yield tuple(int(rng.choice(choice)) for choice in levels)

    def _finalists(self, fits: Callable[[Outcome], bool]) -> list[Tried]:
        """What is tried on all targets: the start, profiles, and the best of the larger share."""
        larger = [entry for entry in self.tried if entry.share == SHARES[1]]
        most = max((entry.outcome.psnr for entry in larger), default=0.0)
        good = [entry for entry in larger if entry.outcome.psnr >= most - POOR]
        if any(fits(entry.outcome) for entry in good):
            larger = good
        ranked: list[Outcome] = []
        # Of what delivers as much as the start first.
        for entries in ([e for e in larger if not self._less(e)], larger):
            outcomes = [entry.outcome for entry in entries]
            best = front(outcomes, self.cost)
            within = front(filter(fits, outcomes), self.cost) or best[:1]
            # The most accurate within the budget first, then the others of the front.
            of_these = list(reversed(within)) + [o for o in reversed(best) if o not in within]
            ranked += [o for o in of_these if o not in ranked][: (FINAL + 1) // 2]
        chosen = [entry for o in ranked[:FINAL] for entry in larger if entry.outcome is o]
        first = [entry for entry in self.tried if entry.share == SHARES[0]]
        if not fits(self.tried[0].outcome):
            # One knob alone may bring the start within the budget.
            alone = [entry for entry in first if entry.point and fits(entry.outcome)]
            alone.sort(key=lambda entry: (self._less(entry), -entry.outcome.psnr))
            chosen = alone[:ALONE] + chosen
        return [entry for entry in first if entry.label in self._given] + chosen

    def _less(self, entry: Tried) -> bool:
        return delivers_less(self.knobs, entry.outcome.settings)

    def recommended(self, fits: Callable[[Outcome], bool]) -> Tried | None:
        """The most accurate trial within the budget; None when none is.

        Of several that are as accurate the fastest, and one that delivers less than the start only
        where no other is within the budget.
        """
        within = [entry for entry in self.whole() if fits(entry.outcome)]
        full = [entry for entry in within if not self._less(entry)]
        most = max((entry.outcome.psnr for entry in full or within), default=0.0)
        best = [entry for entry in full or within if entry.outcome.psnr >= most - EQUAL]
        return min(best, key=lambda entry: self.seconds(entry.outcome), default=None)

    def _change(self, point: Point) -> str:
        for knob, level in zip(self.knobs, point, strict=True):
            if level != knob.usual:
                return f"{knob.name}: {knob.levels[level].name}"
        return "start"

    def _try(self, label: str, point: Point, share: float) -> None:
        self._try_settings(label, settings_of(self.knobs, point), point, share)

    def _try_settings(
        self, label: str, settings: Settings, point: Point | None, share: float
    ) -> None:
        if any(e.share == share and e.outcome.settings == settings for e in self.tried):
            return
        left = self._end - self.clock()
        if self.kept(settings, share) is None and self._expected(settings, point, share) > left:
            self.left_out.append(label)
            return
        try:
            outcome = self.run(settings, share)
        except GvError as error:
            # A disk that is full is no fault of the settings.
            if isinstance(error.__cause__, OSError):
                raise
            self.refused[label] = str(error)
            self.say(f"{label}: refused, {error}")
            return
        self.tried.append(Tried(label, point, share, outcome))
        self.say(
            f"{label} ({share:.0%} of the targets): {outcome.psnr:.2f} dB, "
            f"{outcome.seconds(self.targets):.1f} s a run, {outcome.bytes / 2**20:.0f} MiB"
        )

    def _expected(self, settings: Settings, point: Point | None, share: float) -> float:
        """Seconds of a trial: as it took on fewer targets, as predicted, or as the start's."""
        if not self.tried:
            return 0.0
        count = round(share * self.targets)
        same = [entry.outcome for entry in self.tried if entry.outcome.settings == settings]
        if same:
            return same[-1].seconds(count)
        start = self.tried[0].outcome
        if point is None or share == SHARES[0]:
            return start.seconds(count)
        whole = float(self.predicted([point])[0, 0])
        return whole * start.seconds(count) / max(self.seconds(start), 1e-9)


def marginal_values(search: Search) -> list[dict[str, Any]]:
    """What each knob alone gives and takes, from one level to the next dearer one.

    All on the smallest share's targets: PSNR and SSIM as differences, time, memory and observations
    as factors.
    """
    start = usual(search.knobs)
    smallest = {
        entry.point: entry.outcome
        for entry in search.tried
        if entry.point is not None and entry.share == SHARES[0]
    }
    rows = []
    for at, knob in enumerate(search.knobs):
        for level in range(len(knob.levels) - 1):
            one, two = (
                smallest.get((*start[:at], index, *start[at + 1 :])) for index in (level, level + 1)
            )
            if one is None or two is None:
                continue
            rows.append(
                {
                    "knob": knob.name,
                    "from": knob.levels[level].name,
                    "to": knob.levels[level + 1].name,
                    "psnr": two.psnr - one.psnr,
                    "ssim": two.ssim - one.ssim if one.ssim and two.ssim else None,
                    "time": two.seconds(search.targets) / one.seconds(search.targets),
                    "bytes": two.bytes / max(one.bytes, 1.0),
                    "observations": two.observations / max(one.observations, 1),
                }
            )
    return rows
