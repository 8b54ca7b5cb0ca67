"""The sweep of a trade-off, on made-up runs whose time and accuracy are known."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from gvtools.completers.base import create
from gvtools.completers.effort import sparing
from gvtools.completers.geoverse.completer import GeoVerseCompleter
from gvtools.errors import GvError, OptionError, ProjectError
from pipelines.commands.tradeoff import parse_budget
from pipelines.config import RunConfig, with_setting, with_settings
from pipelines.reconstruction.plan import Plan
from pipelines.tradeoff.outcome import Outcome, front
from pipelines.tradeoff.search import FINAL, SHARES, Search, marginal_values
from pipelines.tradeoff.search_axes import (
    Knob,
    Level,
    delivers_less,
    knobs_of,
    neighbours,
    settings_of,
    usual,
)
from pipelines.tradeoff.trial import applied

TARGETS = 40
KNOBS = [
    Knob("edge", tuple(Level(str(v), {"edge": v}) for v in (4, 2, 1)), 1),
    Knob("steps", tuple(Level(str(v), {"steps": v}) for v in (1, 3)), 0),
    Knob("waste", tuple(Level(str(v), {"waste": v}) for v in (0, 5)), 1),
]


class Runs:
    """Seconds multiply, decibels add; waste takes time and gives nothing."""

    def __init__(self, refuse: object = None) -> None:
        self.now = 0.0
        self.refuse = refuse
        self.made: list[tuple[dict, float]] = []

    def __call__(self, settings, share):
        self.made.append((dict(settings), share))
        edge, steps = settings.get("edge", 2), settings.get("steps", 1)
        if edge == self.refuse:
            raise OptionError("edge is refused")
        seconds = 8.0 / edge * (1 + 0.5 * (steps == 3)) * (1 + settings.get("waste", 5) / 5)
        count = round(share * TARGETS)
        self.now += seconds * share
        return Outcome(
            settings=dict(settings),
            targets=count,
            fixed=0.2 * seconds,
            per_target=0.8 * seconds / TARGETS,
            bytes=1e6 / edge,
            observations=1000 // edge,
            psnr=20 - math.log2(edge) + 0.7 * (steps == 3) + 0.01 * share,
            psnr_valid=None,
            psnr_generated=None,
            ssim=0.5 + 0.1 * (steps == 3),
            depth_rel=None,
            coverage=None,
        )


def swept(budget: float, *, limit: float = 1e6, refuse: object = None) -> tuple[Search, Runs]:
    runs = Runs(refuse)
    search = Search(KNOBS, runs, TARGETS, limit=limit, say=lambda _: None, clock=lambda: runs.now)
    search.sweep([("profile odd", {"edge": 3})], lambda outcome: fits(outcome, budget))
    return search, runs


def fits(outcome: Outcome, budget: float) -> bool:
    return outcome.seconds(TARGETS) <= budget


@pytest.mark.parametrize(
    ("budget", "best"),
    [
        (100, {"edge": 1, "steps": 3, "waste": 0}),
        (9, {"edge": 1, "steps": 1, "waste": 0}),
        (3.5, {"edge": 4, "steps": 3, "waste": 0}),
    ],
)
def test_the_recommendation_is_the_best_combination_within_the_budget(budget, best):
    """None of them was tried before its knobs were known one by one."""
    search, runs = swept(budget)
    chosen = search.recommended(lambda outcome: fits(outcome, budget))
    assert chosen is not None and chosen.outcome.settings == best
    assert chosen.share == 1.0
    assert len([1 for _, share in runs.made if share == 1.0]) <= 2 + FINAL


@pytest.mark.parametrize(("budget", "less"), [(100, False), (1.0, True)])
def test_what_delivers_less_is_recommended_only_where_nothing_else_is_within_the_budget(
    budget, less
):
    size = Knob("size", (Level("half", {"max_side": 50}), Level("whole")), 1, delivered=99)
    runs = Runs()

    def run(settings, share):
        outcome = runs(settings, share)
        half = "max_side" in settings
        return replace(
            outcome,
            fixed=outcome.fixed / (1 + 3 * half),
            per_target=outcome.per_target / (1 + 3 * half),
            psnr=outcome.psnr + half,
        )

    search = Search(
        [*KNOBS, size], run, TARGETS, limit=1e6, say=lambda _: None, clock=lambda: runs.now
    )
    search.sweep([], lambda outcome: fits(outcome, budget))
    chosen = search.recommended(lambda outcome: fits(outcome, budget))
    assert chosen is not None and ("max_side" in chosen.outcome.settings) == less
    best = max(search.whole(), key=lambda entry: entry.outcome.psnr)
    assert "max_side" in best.outcome.settings
    # As a profile has it that no picture is too large for.
    assert not delivers_less(search.knobs, {"max_side": 480})


@pytest.mark.parametrize(
    ("budget", "best"),
    [
        (3e5, {"edge": 1, "steps": 1, "waste": 5, "dense": 0}),
        (2.4e5, {"edge": 2, "steps": 1, "waste": 5, "dense": 0}),
        (0.9e5, {"edge": 4, "steps": 1, "waste": 5, "dense": 0}),
    ],
)
def test_a_budget_of_bytes_is_weighed_against_what_takes_memory_but_no_time(budget, best):
    dense = Knob("dense", tuple(Level(str(v), {"dense": v}) for v in (0, 1)), 1)
    runs = Runs()

    def run(settings, share):
        outcome = runs(settings, share)
        thin = not settings.get("dense", 1)
        return replace(
            outcome, bytes=outcome.bytes / (1 + 3 * thin), psnr=outcome.psnr - 0.5 * thin
        )

    def within(outcome):
        return outcome.bytes <= budget

    search = Search(
        [*KNOBS, dense], run, TARGETS, limit=1e6, say=lambda _: None, of_bytes=True,
        clock=lambda: runs.now,
    )  # fmt: skip
    search.sweep([], within)
    chosen = search.recommended(within)
    assert chosen is not None and chosen.share == 1.0
    keys = ("edge", "dense")
    assert [chosen.outcome.settings[key] for key in keys] == [best[key] for key in keys]


def test_one_knob_alone_is_tried_to_the_end_where_the_start_is_beyond_the_budget():
    runs = Runs()

    def run(settings, share):
        # Together, two knobs cost what neither costs alone.
        outcome = runs(settings, share)
        changed = (settings["edge"] != 2) + (settings["steps"] != 1) + (settings["waste"] != 5)
        return replace(outcome, bytes=2e6 if changed > 1 else outcome.bytes)

    def within(outcome):
        return outcome.bytes < 3e5

    search = Search(
        KNOBS, run, TARGETS, limit=1e6, say=lambda _: None, of_bytes=True, clock=lambda: runs.now
    )
    search.sweep([], within)
    chosen = search.recommended(within)
    assert chosen is not None and chosen.share == 1.0
    assert chosen.outcome.settings == {"edge": 4, "steps": 1, "waste": 5}


def test_early_trials_are_small_and_each_knob_is_tried_alone():
    _, runs = swept(100)
    first = [settings for settings, share in runs.made if share == SHARES[0]]
    start = settings_of(KNOBS, usual(KNOBS))
    assert first[0] == start and {"edge": 3} in first
    for settings in first[2:]:
        assert sum(settings[key] != start[key] for key in start) == 1
    assert len(first) == 2 + len(neighbours(KNOBS, usual(KNOBS)))


def test_marginal_values_are_those_of_one_step_of_one_knob():
    search, _ = swept(100)
    rows = {(row["knob"], row["from"]): row for row in marginal_values(search)}
    halved = rows["edge", "2"]
    assert halved["psnr"] == pytest.approx(1.0) and halved["time"] == pytest.approx(2.0)
    assert halved["bytes"] == pytest.approx(2.0)
    steps = rows["steps", "1"]
    assert steps["psnr"] == pytest.approx(0.7) and steps["time"] == pytest.approx(1.5)
    wasted = rows["waste", "0"]
    assert wasted["psnr"] == pytest.approx(0.0) and wasted["time"] == pytest.approx(2.0)


def test_a_prediction_is_near_what_a_combination_gives():
    search, runs = swept(100)
    point = (2, 1, 0)
    seconds, size, psnr = search.predicted([point])[0]
    true = runs(settings_of(KNOBS, point), SHARES[0])
    assert seconds == pytest.approx(true.seconds(TARGETS), rel=0.05)
    assert size == pytest.approx(true.bytes, rel=0.05) and psnr == pytest.approx(true.psnr, abs=0.1)


def test_the_limit_holds_and_what_was_left_out_is_named():
    search, runs = swept(100, limit=20)
    assert runs.now <= 20
    assert search.left_out and search.tried
    whole, _ = swept(100)
    assert not whole.left_out and len(whole.tried) > len(search.tried)


def test_a_refused_setting_is_named_and_the_sweep_goes_on():
    search, _ = swept(100, refuse=4)
    assert search.refused == {"edge: 4": "edge is refused"}
    assert all(entry.outcome.settings.get("edge") != 4 for entry in search.tried)
    with pytest.raises(GvError, match="the run that was asked for is refused: edge is refused"):
        swept(100, refuse=2)


def test_no_trial_within_the_budget_gives_no_recommendation():
    search, _ = swept(0.1)
    assert search.recommended(lambda outcome: fits(outcome, 0.1)) is None


def test_the_front_holds_what_no_other_beats():
    search, _ = swept(100)
    outcomes = [entry.outcome for entry in search.tried]
    best = front(outcomes, lambda outcome: outcome.seconds(TARGETS))
    for outcome in outcomes:
        beaten = any(
            other.seconds(TARGETS) <= outcome.seconds(TARGETS) and other.psnr > outcome.psnr
            for other in outcomes
        )
        assert (outcome in best) != beaten or any(
            other.psnr == outcome.psnr and other.seconds(TARGETS) <= outcome.seconds(TARGETS)
            for other in best
        )
    times = [outcome.seconds(TARGETS) for outcome in best]
    assert times == sorted(times)


@pytest.mark.parametrize(
    ("text", "kind", "amount"),
    [
        ("60", "seconds", 60),
        ("1.5m", "seconds", 90),
        ("2h", "seconds", 7200),
        ("200MB", "bytes", 2e8),
        ("1 GiB", "bytes", 2**30),
        (None, "seconds", None),
    ],
)
def test_budgets_are_seconds_or_bytes(text, kind, amount):
    assert parse_budget(text) == (kind, amount)


@pytest.mark.parametrize("text", ["", "0", "-3", "5 apples", "fast", "1e3x"])
def test_a_budget_that_is_none_is_refused(text):
    with pytest.raises(OptionError, match="expected seconds"):
        parse_budget(text)


def knobs_in(source: str, config: RunConfig) -> dict[str, Knob]:
    """The knobs of a run whose depth comes from ``source``, by name."""
    cameras = SimpleNamespace(width=np.array([640]), height=np.array([480]))
    plan = SimpleNamespace(
        config=replace(config, voxel=0.01),
        targets=SimpleNamespace(cameras=cameras),
        source=SimpleNamespace(name=source),
    )
    return {knob.name: knob for knob in knobs_of(cast(Plan, plan))}


def test_what_is_swept_is_what_the_run_has():
    recorded = knobs_in("recorded", RunConfig(completer="none"))
    assert "stereo planes" not in recorded and "views explained, share of pixels" not in recorded
    computed = knobs_in("plane-sweep", RunConfig(completer="none"))
    planes, explained = computed["stereo planes"], computed["views explained, share of pixels"]
    assert planes.levels[planes.usual].settings == {"stereo.planes": None}
    assert explained.levels[explained.usual].settings == {"savings.depth_from_memory": 0.9}
    assert explained.levels[-1].settings == {"savings.depth_from_memory": None}
    # A value that is not among the usual ones is one of the levels, too.
    own = with_setting(RunConfig(completer="none"), "savings.depth_from_memory", 0.95)
    explained = knobs_in("da3", own)["views explained, share of pixels"]
    assert explained.levels[explained.usual].settings == {"savings.depth_from_memory": 0.95}
    # Every level is a setting that a run takes.
    for knob in computed.values():
        for level in knob.levels:
            for key, value in level.settings.items():
                with_setting(RunConfig(), key, value)


@pytest.mark.parametrize("footprints", [0.0, 0.7, 1.0, 4.0])
def test_far_voxels_are_swept_from_the_widest_to_those_of_near_ones(footprints):
    config = with_setting(RunConfig(completer="none"), "memory.voxels_per_footprint", footprints)
    knob = knobs_in("recorded", config)["far voxels"]
    values = [level.settings["memory.voxels_per_footprint"] for level in knob.levels]
    assert values == sorted(set(values), reverse=True)
    assert values[-1] == 0 and values[knob.usual] == footprints
    assert len({level.name for level in knob.levels}) == len(values) > 1


def test_a_knob_of_one_completer_says_nothing_of_the_others():
    knobs = [
        Knob("completer", (Level("a", {"completer": "a"}), Level("b", {"completer": "b"})), 0),
        Knob("b's", (Level("1", {"completer.of_b": 1}), Level("2", {"completer.of_b": 2})), 0,
             completer="b"),
    ]  # fmt: skip
    assert settings_of(knobs, (0, 1)) == {"completer": "a"}
    assert settings_of(knobs, (1, 1)) == {"completer": "b", "completer.of_b": 2}


@pytest.mark.parametrize(
    "texts",
    [[], ["completer=geoverse"], ["completer=geoverse", "completer.steps=2"],
     ["completer=exemplar", "completer.reach=0.1"]],
)  # fmt: skip
def test_every_completer_can_be_tried_from_any_start(texts):
    config = with_settings(RunConfig(), texts)
    knobs = list(knobs_in("recorded", config).values())
    at = [knob.name for knob in knobs].index("completer")
    names = [level.name for level in knobs[at].levels]
    assert names[:2] == ["none", "inpaint"] and "geoverse 3+1" in names
    if config.completer == "geoverse":
        # Between those with fewer and with more steps.
        assert names.index("geoverse as given") in (3, 4) and len(names) == 6
    for level in range(len(names)):
        point = tuple(level if i == at else knob.usual for i, knob in enumerate(knobs))
        changed = applied(config, settings_of(knobs, point))
        create(changed.completer, **changed.completer_options)
    start = applied(config, settings_of(knobs, usual(knobs)))
    assert start.completer == config.completer
    assert start.completer_options.items() >= config.completer_options.items()


@pytest.mark.parametrize(
    ("texts", "shares", "usual_share"),
    [
        ([], [1e6, 0.1, 0.0], 0.1),
        (["savings.no_prior=0.3"], [1e6, 0.3, 0.1, 0.0], 0.3),
        (["profile=accurate"], [1e6, 0.1, 0.0], 0.0),
        (["completer.no_prior_holes=0.2"], [1e6, 0.2, 0.1, 0.0], 0.2),
        (["completer.no_prior_holes=0"], [1e6, 0.1, 0.0], 0.0),
    ],
)
def test_a_video_prior_is_swept_where_the_weights_have_one(tmp_path, texts, shares, usual_share):
    pytest.importorskip("safetensors", reason="weights are read with safetensors")
    import geoverse_models as micro

    name = "holes without video prior, share of the diagonal"
    for injection in ("none", "control"):
        weights = micro.weights_folder(tmp_path / injection, micro.config(injection=injection))
        # What the prior is read from; nothing is completed here.
        (weights / "video").mkdir()
        core = ["completer=geoverse", f"completer.weights={weights}"]
        config = with_settings(RunConfig(), [*core, *texts])
        knobs = knobs_in("recorded", config)
        assert (name in knobs) == (injection == "control")
    runs = [with_settings(config, [f"{k}={v}" for k, v in level.settings.items()])
            for level in knobs[name].levels]  # fmt: skip
    told = []
    for run in runs:
        completer = create(run.completer, **run.completer_options)
        completer = sparing(completer, 0.0, no_prior=run.savings.no_prior)
        assert isinstance(completer, GeoVerseCompleter)
        told.append(completer.no_prior_holes or 0.0)
    assert told == shares and told[knobs[name].usual] == usual_share


def test_what_an_earlier_sweep_gave_takes_no_time():
    whole, _ = swept(100)
    given = {(str(e.outcome.settings), e.share): e.outcome for e in whole.tried}
    again = Search(
        KNOBS, Runs(), TARGETS, limit=1e-9, say=lambda _: None, clock=lambda: 0.0,
        kept=lambda settings, share: given.get((str(dict(settings)), share)),
    )  # fmt: skip
    again.sweep([("profile odd", {"edge": 3})], lambda outcome: fits(outcome, 100))
    assert len(again.tried) == len(whole.tried) and not again.left_out


def test_no_time_for_a_single_trial_is_said():
    now = iter([0.0, 1.0])
    search = Search(KNOBS, Runs(), TARGETS, limit=0.5, say=print, clock=lambda: next(now))
    with pytest.raises(GvError, match="leaves no time"):
        search.sweep([], lambda outcome: True)


def test_equal_pictures_can_be_predicted():
    runs = Runs()
    search = Search(
        KNOBS, lambda settings, share: replace(runs(settings, share), psnr=math.inf), TARGETS,
        limit=1e6, say=lambda _: None, clock=lambda: runs.now,
    )  # fmt: skip
    search.sweep([], lambda outcome: True)
    chosen = search.recommended(lambda outcome: True)
    assert chosen is not None and chosen.share == 1


def test_a_full_disk_is_no_fault_of_the_settings():
    def run(settings, share):
        raise ProjectError("cannot be written") from OSError("no space")

    search = Search(KNOBS, run, TARGETS, limit=1e6, say=print)
    with pytest.raises(ProjectError, match="cannot be written"):
        search.sweep([], lambda outcome: True)
