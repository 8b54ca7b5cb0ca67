"""The sweep: the start, the profiles, and single settings changed from the start."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

from gvtools.errors import GvError
from pipelines.tradeoff.search_axes import SearchAxis, Settings
from pipelines.tradeoff.trial import Trial, Trials

# Trials that differ by less are equally accurate, dB.
EQUAL = 0.02


class Step(NamedTuple):
    """A setting changed from one value to the next costlier one.

    PSNR and SSIM are differences; time, memory and observations are factors.
    """

    setting: str
    before: str
    after: str
    psnr: float
    ssim: float | None
    time: float
    bytes: float
    observations: float


@dataclass
class Sweep:
    """Every trial of a sweep; ``run`` makes them.

    Attributes:
        axes: settings that are changed one at a time.
        runs: makes trials, and has those of earlier sweeps, which take no time.
        side: longer side of the start's pictures, pixels.
        limit: seconds for all trials; those that would not fit are left out and named.
        say: is told of each trial.
        clock: seconds.
        trials: made so far.
        refused: label and reason of trials that cannot be run.
        left_out: labels of trials that there was no time for.
    """

    axes: Sequence[SearchAxis]
    runs: Trials
    side: int
    limit: float
    say: Callable[[str], None] = print
    clock: Callable[[], float] = time.perf_counter
    trials: list[Trial] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    def run(self, profiles: Mapping[str, Settings]) -> None:
        """Make every trial: the start, the profiles, each value of each axis.

        Raises:
            GvError: the start is refused, or there is no time for it.
        """
        end = self.clock() + self.limit
        self._try("start", {}, end)
        if self.refused:
            raise GvError(f"the run that was asked for is refused: {self.refused['start']}")
        if not self.trials:
            raise GvError(f"a limit of {self.limit:g} s leaves no time for a trial; expected more")
        for name, settings in profiles.items():
            self._try(f"profile {name}", settings, end)
        for axis in self.axes:
            for value, settings in axis.values:
                self._try(f"{axis.name}: {value}", settings, end)

    def _try(self, label: str, settings: Settings, end: float) -> None:
        if self._made(settings) is not None:
            return
        trial = self.runs.kept(label, settings)
        # A trial is expected to take as long as the start.
        expected = self.trials[0].seconds if self.trials else 0.0
        if trial is None and self.clock() + expected > end:
            self.left_out.append(label)
            return
        try:
            trial = trial or self.runs.make(label, settings)
        except GvError as error:
            # A full disk is not the settings' fault.
            if isinstance(error.__cause__, OSError):
                raise
            self.refused[label] = str(error)
            self.say(f"{label}: refused, {error}")
            return
        self.trials.append(trial)
        self.say(
            f"{label}: {trial.psnr:.2f} dB, {trial.seconds:.1f} s, {trial.bytes / 2**20:.0f} MiB"
        )

    def _made(self, settings: Settings) -> Trial | None:
        return next((trial for trial in self.trials if trial.settings == settings), None)

    def recommended(self, budget: tuple[str, float | None]) -> Trial | None:
        """The most accurate trial within the budget, of equal ones the fastest; None if none fits.

        One with smaller pictures than the start's only where no other fits.

        Args:
            budget: "seconds" or "bytes" of a run, and how many; None for no limit.
        """
        kind, most = budget
        within = [t for t in self.trials if most is None or getattr(t, kind) <= most]
        full = [trial for trial in within if not self.smaller(trial)] or within
        highest = max((trial.psnr for trial in full), default=0.0)
        best = [trial for trial in full if trial.psnr >= highest - EQUAL]
        return min(best, key=lambda trial: trial.seconds, default=None)

    def smaller(self, trial: Trial) -> bool:
        """Whether its pictures are smaller than the start's: another product."""
        side = trial.settings.get("max_side")
        return side is not None and side < self.side

    def steps(self) -> list[Step]:
        """What each axis gives and takes from one value to the next costlier one."""
        rows = []
        for axis in self.axes:
            for (name, settings), (next_name, next_settings) in pairwise(axis.values):
                one, two = self._made(settings), self._made(next_settings)
                if one is None or two is None:
                    continue
                rows.append(
                    Step(
                        axis.name,
                        name,
                        next_name,
                        psnr=two.psnr - one.psnr,
                        ssim=two.ssim - one.ssim if one.ssim and two.ssim else None,
                        time=two.seconds / one.seconds,
                        bytes=two.bytes / max(one.bytes, 1.0),
                        observations=two.observations / max(one.observations, 1),
                    )
                )
        return rows


def pareto_front(trials: Sequence[Trial]) -> list[Trial]:
    """Trials that no other beats in both time and PSNR, fastest first."""
    front: list[Trial] = []
    for trial in sorted(trials, key=lambda trial: (trial.seconds, -trial.psnr)):
        if not front or trial.psnr > front[-1].psnr:
            front.append(trial)
    return front
