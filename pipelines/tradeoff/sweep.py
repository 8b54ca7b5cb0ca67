"""The sweep: the start, the profiles, and single settings changed from the start."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from gvtools.errors import GvError
from pipelines.tradeoff.search_axes import SearchAxis, Settings
from pipelines.tradeoff.trial import Outcome

# Trials that differ by less are equally accurate, dB.
EQUAL = 0.02


@dataclass(frozen=True)
class Trial:
    """A run of the sweep.

    Attributes:
        label: "start", "profile NAME", or the setting that it changes.
        outcome: what it gave.
    """

    label: str
    outcome: Outcome


@dataclass
class Sweep:
    """Every trial of a sweep; ``run`` makes them.

    Attributes:
        axes: settings that are changed one at a time.
        make: runs one trial.
        side: longer side of the start's pictures, pixels.
        limit: seconds for all trials; those that would not fit are left out and named.
        say: is told of each trial.
        kept: what a trial gave in an earlier sweep, or None; these take no time.
        clock: seconds.
        trials: made so far.
        refused: label and reason of trials that cannot be run.
        left_out: labels of trials that there was no time for.
    """

    axes: Sequence[SearchAxis]
    make: Callable[[Settings], Outcome]
    side: int
    limit: float
    say: Callable[[str], None] = print
    kept: Callable[[Settings], Outcome | None] = lambda settings: None
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
        if not self.trials:
            reason = self.refused.get("start")
            raise GvError(
                f"the run that was asked for is refused: {reason}"
                if reason
                else f"a limit of {self.limit:g} s leaves no time for a trial; expected more"
            )
        for name, settings in profiles.items():
            self._try(f"profile {name}", settings, end)
        for axis in self.axes:
            for value, settings in axis.values:
                self._try(f"{axis.name}: {value}", settings, end)

    def _try(self, label: str, settings: Settings, end: float) -> None:
        if self._outcome(settings) is not None:
            return
        # A trial is expected to take as long as the start.
        expected = self.trials[0].outcome.seconds if self.trials else 0.0
        if self.kept(settings) is None and self.clock() + expected > end:
            self.left_out.append(label)
            return
        try:
            outcome = self.make(settings)
        except GvError as error:
            # A full disk is not the settings' fault.
            if isinstance(error.__cause__, OSError):
                raise
            self.refused[label] = str(error)
            self.say(f"{label}: refused, {error}")
            return
        self.trials.append(Trial(label, outcome))
        self.say(
            f"{label}: {outcome.psnr:.2f} dB, {outcome.seconds:.1f} s, "
            f"{outcome.bytes / 2**20:.0f} MiB"
        )

    def _outcome(self, settings: Settings) -> Outcome | None:
        found = [t.outcome for t in self.trials if t.outcome.settings == settings]
        return found[0] if found else None

    def recommended(self, fits: Callable[[Outcome], bool]) -> Trial | None:
        """The most accurate trial within the budget, of equal ones the fastest; None if none fits.

        One with smaller pictures than the start's only where no other fits.
        """
        within = [trial for trial in self.trials if fits(trial.outcome)]
        full = [trial for trial in within if not self.smaller(trial.outcome)] or within
        most = max((trial.outcome.psnr for trial in full), default=0.0)
        best = [trial for trial in full if trial.outcome.psnr >= most - EQUAL]
        return min(best, key=lambda trial: trial.outcome.seconds, default=None)

    def smaller(self, outcome: Outcome) -> bool:
        """Whether its pictures are smaller than the start's: another product."""
        side = outcome.settings.get("max_side")
        return side is not None and side < self.side

    def marginal_values(self) -> list[dict[str, Any]]:
        """What each axis gives and takes from one value to the next costlier one.

        PSNR and SSIM are differences; time, memory and observations are factors.
        """
        rows = []
        for axis in self.axes:
            for (name, settings), (next_name, next_settings) in zip(
                axis.values, axis.values[1:], strict=False
            ):
                one, two = self._outcome(settings), self._outcome(next_settings)
                if one is None or two is None:
                    continue
                rows.append(
                    {
                        "setting": axis.name,
                        "from": name,
                        "to": next_name,
                        "psnr": two.psnr - one.psnr,
                        "ssim": two.ssim - one.ssim if one.ssim and two.ssim else None,
                        "time": two.seconds / one.seconds,
                        "bytes": two.bytes / max(one.bytes, 1.0),
                        "observations": two.observations / max(one.observations, 1),
                    }
                )
        return rows


def pareto_front(trials: Sequence[Trial]) -> list[Trial]:
    """Trials that no other beats in both time and PSNR, fastest first."""
    front: list[Trial] = []
    for trial in sorted(trials, key=lambda t: (t.outcome.seconds, -t.outcome.psnr)):
        if not front or trial.outcome.psnr > front[-1].outcome.psnr:
            front.append(trial)
    return front
