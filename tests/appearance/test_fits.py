"""Several fits to the same photographs, whose pictures are averaged."""

from __future__ import annotations

import numpy as np
import pytest
from splat_scene import photographs, rough_gaussians, walk

from gvtools.appearance import fit as module
from gvtools.appearance import fit_options
from gvtools.appearance.fit import Fit, run_fits, with_chosen_backdrop
from gvtools.appearance.fit_options import FitOptions

WHOLE = 10


@pytest.fixture(autouse=True)
def short_fits(monkeypatch):
    monkeypatch.setattr(fit_options, "CONVERGED_PER_VIEW", 2)
    monkeypatch.setattr(fit_options, "CONVERGED_LEAST", WHOLE)


def fit_of(count: int = 5, **options: float) -> Fit:
    views = photographs(walk(count))
    bare = [view.__class__(view.rgb, view.K, view.cam_from_local) for view in views]
    return Fit(rough_gaussians(), bare, options=FitOptions(**options))


@pytest.mark.parametrize(
    ("steps", "made"),
    [(9, [9]), (14, [10]), (15, [10, 5]), (22, [10, 10]), (36, [10, 9, 8, 9]), (900, [10] * 6)],
)
def test_a_whole_fit_is_followed_by_others(steps, made):
    assert [fit.steps for fit in run_fits(fit_of(steps=steps))] == made


def test_time_is_shared_by_whole_fits():
    now = iter(range(10_000))
    # A step takes a second of this clock, and each fit two more.
    fits = run_fits(fit_of(seconds=40.0), clock=lambda: float(next(now)))
    assert [fit.steps for fit in fits][:2] == [10, 10]
    assert len(fits) == 3


def test_each_fit_chooses_anew_and_all_can_be_repeated():
    one, other = (run_fits(fit_of(steps=30)) for _ in range(2))
    values = [fit.gaussians.values.tobytes() for fit in one]
    assert len(set(values)) == 3
    assert values == [fit.gaussians.values.tobytes() for fit in other]


def test_all_fits_together_have_no_more_gaussians_than_allowed():
    alone = len(run_fits(fit_of(steps=10))[0].population)
    for most in (3 * alone, 3 * alone - 1):
        fits = run_fits(fit_of(steps=900, most_gaussians=most))
        assert len(fits) == most // alone
        assert sum(len(fit.population) for fit in fits) <= most
    assert len(run_fits(fit_of(steps=900, most_gaussians=alone))) == 1


def test_fits_end_when_left_out_photographs_gain_nothing(monkeypatch):
    gains = iter([0.5, 0.01, 0.5])
    monkeypatch.setattr(module, "_gain", lambda fits, fit: next(gains))
    assert len(run_fits(fit_of(8, steps=160))) == 3
    gains = iter([0.5, -0.01, 0.5])
    assert len(run_fits(fit_of(8, steps=160))) == 2


def test_a_fit_that_goes_on_with_another_stays_the_only_one():
    first = fit_of(steps=100)
    further = Fit(first.start, first.views, options=first.options, begin=0.6)
    assert run_fits(further) == [further]
    assert further.steps == 100


def test_further_fits_are_made_at_the_poses_of_the_first():
    first = Fit(rough_gaussians(), photographs(walk(5)), options=FitOptions(steps=30))
    first.run()
    moved = first.cameras.poses()
    again = first.again(1, first.options)
    np.testing.assert_array_equal([view.cam_from_local for view in again.views], moved)
    assert not again.cameras.with_poses
    assert again.seed == 1


@pytest.mark.parametrize(("gain", "backdrop"), [(0.2, True), (0.4, False)])
def test_left_out_photographs_choose_the_backdrop(gain, backdrop, monkeypatch):
    monkeypatch.setattr(module, "TRIAL_STEPS", 6)
    trials = []

    def psnr(self):
        trials.append(self)
        return 20.0 if self.backdrop else 20.0 + gain

    monkeypatch.setattr(Fit, "left_out_psnr", psnr)
    first = fit_of(count=10, steps=8)
    chosen, why = with_chosen_backdrop(first)
    assert chosen.backdrop is backdrop and (chosen is first) is backdrop
    assert "random 20.00 dB" in why and f"black {20 + gain:.2f} dB" in why
    # Trials leave photographs out to their end, and fit to no others than the fit itself.
    assert [0 < trial.steps < 6 and not trial.predicted for trial in trials] == [True, True]
    assert chosen.steps == 0
    alone = run_fits(chosen)[0]
    again = run_fits(with_chosen_backdrop(fit_of(count=10, steps=8))[0])[0]
    assert alone.gaussians.values.tobytes() == again.gaussians.values.tobytes()


@pytest.mark.parametrize(
    "made",
    [
        {"count": 5, "steps": 900},
        {"count": 17, "steps": 900},
        {"count": 10, "steps": 8},
        {"count": 10, "seconds": 9.0},
    ],
)
def test_many_photographs_none_left_out_and_short_fits_have_no_trials(made):
    fit = fit_of(**made)
    assert with_chosen_backdrop(fit) == (fit, "")
