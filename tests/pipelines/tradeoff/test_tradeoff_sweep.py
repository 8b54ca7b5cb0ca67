"""The sweep of a trade-off, on simulated runs whose time and accuracy are known."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.settings import with_texts, with_values
from pipelines.commands.tradeoff import parse_budget
from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.settings import RunSettings
from pipelines.tradeoff.search_axes import SearchAxis, search_axes
from pipelines.tradeoff.sweep import Sweep, pareto_front
from pipelines.tradeoff.trial import Trial, applied

SIDE = 100
AXES = [
    SearchAxis("edge", (("4", {"edge": 4}), ("2", {}), ("1", {"edge": 1}))),
    SearchAxis("steps", (("1", {}), ("3", {"steps": 3}))),
    SearchAxis("waste", (("0", {"waste": 0}), ("5", {}))),
    SearchAxis("picture size", (("50 px", {"max_side": 50}), ("100 px", {}))),
]


class Runs:
    """Seconds multiply, decibels add; waste takes time and gives nothing."""

    def __init__(self, *, refuse: object = None, earlier: Sequence[Trial] = ()) -> None:
        self.now = 0.0
        self.refuse, self.earlier = refuse, earlier

    def kept(self, label, settings):
        return next((trial for trial in self.earlier if trial.settings == settings), None)

    def make(self, label, settings):
        edge, steps = settings.get("edge", 2), settings.get("steps", 1)
        if edge == self.refuse:
            raise OptionError("edge is refused")
        half = "max_side" in settings
        seconds = 8.0 / edge * (1.5 if steps == 3 else 1) * (1 + settings.get("waste", 5) / 5)
        seconds /= 1 + 3 * half
        self.now += seconds
        return Trial(
            label=label, settings=dict(settings), seconds=seconds, bytes=1e6 / edge,
            observations=1000 // edge, psnr=20 - np.log2(edge) + 0.7 * (steps == 3) + half,
            ssim=0.5,
        )  # fmt: skip


def sweep_of(runs: Any, *, limit: float = 1e6, clock: Any = lambda: 0.0) -> Sweep:
    return Sweep(AXES, runs, SIDE, limit, say=lambda _: None, clock=clock)


def swept(*, limit: float = 1e6, **options: Any) -> tuple[Sweep, Runs]:
    runs = Runs(**options)
    sweep = sweep_of(runs, limit=limit, clock=lambda: runs.now)
    sweep.run({"odd": {"edge": 3}, "balanced": {}})
    return sweep, runs


def test_the_start_the_profiles_and_every_single_setting_are_tried_once():
    sweep, _ = swept()
    assert [trial.label for trial in sweep.trials] == [
        "start", "profile odd", "edge: 4", "edge: 1", "steps: 3", "waste: 0", "picture size: 50 px",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "budget", "best"),
    [("seconds", 100, "edge: 1"), ("seconds", 13, "steps: 3"), ("seconds", 7, "waste: 0"),
     ("seconds", 2.5, "picture size: 50 px"), ("seconds", 0.1, None), ("bytes", 3e5, "edge: 4")],
)  # fmt: skip
def test_the_most_accurate_trial_within_the_budget_is_recommended(kind, budget, best):
    """Smaller pictures, the most accurate of all here, only where nothing else is within it."""
    sweep, _ = swept()
    if budget == 3e5:
        sweep.trials = [t for t in sweep.trials if t.label != "profile odd"]
    chosen = sweep.recommended((kind, budget))
    assert (chosen and chosen.label) == best


def test_marginal_values_are_those_of_one_step_of_one_setting():
    rows = {(row.setting, row.before): row[3:] for row in swept()[0].steps()}
    assert rows["edge", "2"] == pytest.approx((1, 0, 2, 2, 2))
    assert rows["steps", "1"] == pytest.approx((0.7, 0, 1.5, 1, 1))
    assert rows["waste", "0"] == pytest.approx((0, 0, 2, 1, 1))


def test_the_limit_holds_and_what_was_left_out_is_named():
    sweep, runs = swept(limit=20)
    whole, _ = swept()
    assert runs.now <= 20 and sweep.left_out and not whole.left_out
    assert len(sweep.trials) + len(sweep.left_out) == len(whole.trials)


def test_a_refused_setting_is_named_and_the_sweep_goes_on():
    sweep, _ = swept(refuse=4)
    assert sweep.refused == {"edge: 4": "edge is refused"}
    assert "edge: 1" in [trial.label for trial in sweep.trials]
    with pytest.raises(GvError, match="the run that was asked for is refused: edge is refused"):
        swept(refuse=2)


def test_the_front_holds_what_no_other_beats():
    trials = swept()[0].trials
    front = pareto_front(trials)
    for trial in trials:
        beaten = any(
            other.seconds <= trial.seconds and other.psnr >= trial.psnr
            for other in trials
            if other is not trial
        )
        assert (trial in front) != beaten
    assert sorted(front, key=lambda trial: trial.seconds) == front


def test_an_earlier_sweeps_trials_take_no_time():
    whole, _ = swept()
    again, runs = swept(limit=1e-9, earlier=whole.trials)
    assert again.trials == whole.trials and not again.left_out and not runs.now


def test_no_time_for_a_single_trial_is_said():
    with pytest.raises(GvError, match="leaves no time"):
        sweep_of(Runs(), limit=0.5, clock=iter([0.0, 1.0]).__next__).run({})


def test_a_full_disk_is_no_fault_of_the_settings():
    runs = Runs()

    def make(label, settings):
        raise ProjectError("cannot be written") from OSError("no space")

    runs.make = make  # type: ignore[method-assign]
    with pytest.raises(ProjectError, match="cannot be written"):
        sweep_of(runs).run({})


@pytest.mark.parametrize(
    ("text", "kind", "amount"),
    [("60", "seconds", 60), ("1.5m", "seconds", 90), ("2h", "seconds", 7200),
     ("200MB", "bytes", 2e8), ("1 GiB", "bytes", 2**30), (None, "seconds", None)],
)  # fmt: skip
def test_budgets_are_seconds_or_bytes(text, kind, amount):
    assert parse_budget(text) == (kind, amount)


@pytest.mark.parametrize("text", ["", "0", "-3", "5 apples", "fast", "1e3x"])
def test_a_budget_that_is_none_is_refused(text):
    with pytest.raises(OptionError, match="expected seconds"):
        parse_budget(text)


def axes_of(source: str, config: RunSettings, *, voxel: float = 0.01) -> dict[str, dict]:
    """The axes of a run whose depth comes from ``source``: values by name, by axis."""
    cameras = SimpleNamespace(width=np.array([640]), height=np.array([480]))
    plan = SimpleNamespace(
        config=config.replaced(voxel=voxel),
        targets=SimpleNamespace(cameras=cameras),
        source=SimpleNamespace(name=source),
    )
    return {axis.name: dict(axis.values) for axis in search_axes(cast(Plan, plan))}


@pytest.mark.parametrize(
    ("completer", "source"),
    [("none", "recorded"), ("inpaint", "plane-sweep"), ("inpaint", "da3")],
)
def test_every_axis_holds_the_start_and_values_that_a_run_takes(completer, source):
    config = RunSettings(completer=completer)
    axes = axes_of(source, config)
    assert ("stereo planes" in axes) == (source == "plane-sweep")
    assert ("views explained, share of pixels" in axes) == (source != "recorded")
    assert ("least confidence that is fused" in axes) == (completer != "none")
    for name, values in axes.items():
        assert len(values) > 1 and [settings for settings in values.values() if not settings], name
        for settings in values.values():
            assert (applied(config, settings) != config) == bool(settings), (name, settings)


def test_a_value_of_ones_own_takes_its_place_among_the_others():
    config = with_values(RunSettings(), {"memory.observations_per_voxel": 30})
    values = axes_of("recorded", config)["observations a voxel"]
    assert list(values) == ["4", "12", "30", "48"] and values["30"] == {}
    config = with_values(RunSettings(), {"savings.depth_from_memory": 0.95})
    values = axes_of("da3", config)["views explained, share of pixels"]
    assert list(values) == ["0.8", "0.9", "0.95", "default"] and values["0.95"] == {}
    assert list(axes_of("recorded", RunSettings(), voxel=0.00922743)["voxel edge"]) == [
        "0.01845",
        "0.009227",
        "0.004614",
    ]
    config = with_values(RunSettings(), {"memory.voxels_per_footprint": 0.0})
    assert list(axes_of("recorded", config)["far voxels, footprints"]) == ["1", "0"]


def test_the_generative_cores_settings_are_swept_where_it_completes():
    small = "holes left to inpaint, share of the diagonal"
    assert small not in axes_of("recorded", RunSettings())
    core = ["completer=geoverse", "completer.steps=2", "effort.inpaint_below=0.05"]
    axes = axes_of("recorded", with_texts(RunSettings(), core))
    assert list(axes[small]) == ["0.1", "0.05", "0.02", "0"] and axes[small]["0.05"] == {}
    assert axes["generative steps"]["2"] == {} and "1" in axes["generative steps"]
    assert list(axes["completer"]) == ["none", "inpaint", "geoverse"]
