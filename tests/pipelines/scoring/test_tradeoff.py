"""The sweep of a trade-off, on simulated runs whose time and accuracy are known."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from gvtools.completers.base import create
from gvtools.errors import GvError, OptionError
from gvtools.settings import with_texts, with_values
from pipelines.console import Console
from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.settings import RunSettings
from pipelines.scoring.tradeoff import (
    START,
    Trial,
    changed,
    pareto_front,
    planned_trials,
    recommended,
    run_trials,
)

PLANNED = {
    START: {},
    "profile odd": {"edge": 3},
    "edge 4": {"edge": 4},
    "edge 1": {"edge": 1},
    "steps 3": {"steps": 3},
    "waste 0": {"waste": 0},
}


class Runs:
    """Seconds multiply, decibels add; waste takes time and gives nothing."""

    def __init__(self, *, refuse: object = None, earlier: Sequence[Trial] = ()) -> None:
        self.now = 0.0
        self.refuse, self.earlier = refuse, earlier

    def stored(self, label, settings):
        return next((trial for trial in self.earlier if trial.settings == settings), None)

    def make(self, label, settings):
        edge, steps = settings.get("edge", 2), settings.get("steps", 1)
        if edge == self.refuse:
            raise OptionError("edge is refused")
        seconds = 8.0 / edge * (1.5 if steps == 3 else 1) * (1 + settings.get("waste", 5) / 5)
        self.now += seconds
        return Trial(
            label=label, settings=dict(settings), seconds=seconds, bytes=1e6 / edge,
            observations=1000 // edge, psnr=20 - np.log2(edge) + 0.7 * (steps == 3),
        )  # fmt: skip


def swept(runs: Any = None, *, limit: float = 1e6) -> list[Trial]:
    runs = runs or Runs()
    return run_trials(PLANNED, runs, limit=limit, console=Console(), clock=lambda: runs.now)


@pytest.mark.parametrize(
    ("budget", "best"),
    [(None, "edge 1"), (13, "steps 3"), (7, "waste 0"), (0.1, None)],
)
def test_the_most_accurate_trial_within_the_budget_is_recommended(budget, best):
    chosen = recommended(swept(), budget)
    assert (chosen and chosen.label) == best


def test_the_limit_holds_and_what_was_left_out_is_named(capsys):
    runs = Runs()
    made = [trial.label for trial in swept(runs, limit=20)]
    assert runs.now <= 20 and START in made
    left_out = [label for label in PLANNED if label not in made]
    assert left_out and f"--limit: {', '.join(left_out)}" in capsys.readouterr().err
    # The start is made however little time there is.
    assert [trial.label for trial in swept(limit=1e-9)] == [START]


@pytest.mark.parametrize("long", [{"refine.seconds": 360.0, "edge": 4}, {"tune.minutes": 4.0}])
def test_a_long_fit_or_tuning_needs_its_time(capsys, long):
    planned = {START: {}, "long": long, "edge 4": {"edge": 4}}
    runs: Any = Runs()
    made = run_trials(planned, runs, limit=200, console=Console(), clock=lambda: runs.now)
    assert [trial.label for trial in made] == [START, "edge 4"]
    assert "long" in capsys.readouterr().err


def test_a_refused_setting_is_named_and_the_sweep_goes_on(capsys):
    trials = swept(Runs(refuse=4))
    assert "edge 4: refused, edge is refused" in capsys.readouterr().out
    assert "edge 1" in [trial.label for trial in trials]
    with pytest.raises(GvError, match="edge is refused"):
        swept(Runs(refuse=2))


def test_the_front_holds_what_no_other_beats():
    trials = swept()
    front = pareto_front(trials)
    for one in trials:
        beaten = [t for t in trials if t.seconds <= one.seconds and t.psnr >= one.psnr]
        assert (one in front) == (beaten == [one])
    assert sorted(front, key=lambda trial: trial.seconds) == front


def test_every_trial_is_made_once_and_an_earlier_sweeps_take_no_time():
    whole, runs = swept(), Runs(earlier=swept())
    assert [trial.label for trial in whole] == list(PLANNED)
    assert swept(runs, limit=1e-9) == whole and not runs.now


def planned_of(source: str, config: RunSettings, **profiles: Any) -> dict[str, Any]:
    """The trials of a run whose depth comes from ``source``."""
    plan = SimpleNamespace(
        config=config.replaced(voxel=0.01),
        source=SimpleNamespace(name=source),
        completer=create(config.completer, **config.completer_options),
        context=("a", "b", "c", "d"),
    )
    return planned_trials(cast(Plan, plan), profiles)


@pytest.mark.parametrize(
    ("completer", "source"),
    [("none", "recorded"), ("inpaint", "plane-sweep"), ("inpaint", "da3")],
)
def test_every_trial_but_the_start_changes_something_that_a_run_takes(completer, source):
    config = RunSettings(completer=completer).replaced(voxel=0.01)
    fast = {"max_side": 480, "views_per_round": 12}
    planned = planned_of(source, config, fast=fast, balanced={})
    assert next(iter(planned)) == START and "profile balanced" not in planned
    assert planned["profile fast"] == {"views_per_round": 12}
    assert ("stereo.planes 32" in planned) == (source == "plane-sweep")
    assert ("savings.depth_from_memory 0.8" in planned) == (source != "recorded")
    assert ("fusion.min_confidence 0.35" in planned) == (completer != "none")
    for label, settings in planned.items():
        assert (changed(config, settings) != config) == (label != START), label


def test_the_starts_own_values_are_no_trials():
    config = with_values(RunSettings(), {"memory.observations_per_voxel": 48})
    names = [name for name in planned_of("recorded", config) if "observations" in name]
    assert names == ["memory.observations_per_voxel 4", "memory.observations_per_voxel 12"]
    core = ["completer=geoverse", "completer.steps=3", "effort.inpaint_below=0.02"]
    planned = planned_of("recorded", with_texts(RunSettings(), core))
    assert {"completer none", "completer inpaint", "completer.steps 1"} <= set(planned)
    assert not {"completer geoverse", "effort.inpaint_below 0.02"} & set(planned)
    assert not any(name.startswith("completer.") for name in planned_of("recorded", RunSettings()))


def test_only_what_has_weights_is_tuned_in_a_trial():
    core = with_texts(RunSettings(), ["completer=geoverse"])
    planned = planned_of("recorded", core)
    assert planned["tune.minutes 4"] == {"tune.minutes": 4.0} and "tune.minutes 0" not in planned
    assert not any("tune" in name for name in planned_of("recorded", RunSettings()))
    # A start that is tuned is tried without, and its trial by another completer is not tuned.
    tuned = with_values(core, {"tune.minutes": 2.0})
    planned = planned_of("recorded", tuned)
    assert "tune.minutes 0" in planned
    assert not changed(tuned, planned["completer inpaint"]).tune.wanted
    # With a number of steps, minutes are not looked at.
    stepped = planned_of("recorded", with_values(core, {"tune.steps": 5}))
    assert not any("tune" in name for name in stepped)
