"""Fits of a small scene: better pictures, the same bytes, on time, masks, exposure, validation."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import splat_scene
from splat_scene import (
    HEIGHT,
    WIDTH,
    K,
    photograph,
    photographs,
    picture,
    pose,
    psnr,
    rough_gaussians,
    walk,
)

from gvtools.appearance import fit as module
from gvtools.appearance import fit_options
from gvtools.appearance.appearance import SOLID
from gvtools.appearance.fit import (
    OF_STEPS,
    OF_TIME,
    VALIDATION_ENDS,
    Fit,
    run_fits,
    validation_rows,
    with_chosen_backdrop,
)
from gvtools.appearance.fit_options import (
    PER_STEP,
    PER_VIEW,
    FitOptions,
    converged_steps,
    most_gaussians,
)
from gvtools.appearance.loss import ESTIMATE, ESTIMATE_TOLERANCE, add_depth
from gvtools.appearance.splat.splat import Lens, Splat
from gvtools.poses.refinement import FitView, reduce_view

# Small numbers of steps leave no room for pictures at a quarter of their size; sizes go by share.
STEPS = 150


@pytest.fixture(scope="module")
def views():
    return photographs(walk(5))


@pytest.fixture(scope="module")
def fitted(views):
    fit = Fit(rough_gaussians(), views, options=FitOptions(steps=STEPS))
    fit.run()
    return fit


def test_a_view_that_was_held_out_is_predicted_6_db_better(fitted):
    held, start = photograph(pose(0.12)), rough_gaussians()
    truth = held.rgb / np.float32(255)
    before = psnr(picture(start, held.cam_from_local).rgb, truth)
    after = psnr(picture(fitted.gaussians, held.cam_from_local).rgb, truth)
    assert after > before + 6
    assert fitted.steps == STEPS
    assert fitted.validation_psnr() is None


# Prints the kernels that a fit compiles beyond those that a run compiles before its clock begins.
LATE_KERNELS = """
import sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from splat_scene import photographs, rough_gaussians, walk
from stereo_scenes import plane_scene
from gvtools.appearance.compile_kernels import kernel_sets
from gvtools.appearance.fit import Fit
from gvtools.appearance.fit_options import FitOptions
from gvtools.depth.options import StereoOptions
from gvtools.depth.stereo.plane_sweep import KERNELS, PlaneSweepStereo

def types():
    modules = [m for name, m in sys.modules.items() if name.startswith("gvtools.")]
    found = [k for m in modules for k in vars(m).values() if isinstance(k, Dispatcher)]
    return {(kernel.py_func.__name__, s) for kernel in found for s in kernel.signatures}

for kernels in (*kernel_sets(), KERNELS):
    kernels.compile()
before, points = types(), np.array([[0, 0, 2]], np.float32)
Fit(rough_gaussians(), photographs(walk(3)), options=FitOptions(steps=30), surface=points).run()
scene = plane_scene().scene
sweep = PlaneSweepStereo(scene, options=StereoOptions(max_side=64), views=scene.names)
sweep.depth(scene, scene.views[2], scene.views[2].load())
print(sorted(types() - before))
"""


def test_no_kernel_is_compiled_on_the_clock_of_a_fit_or_of_its_sweep():
    words = [sys.executable, "-c", LATE_KERNELS]
    place = {**os.environ, "PYTHONPATH": str(Path(splat_scene.__file__).parent)}
    found = subprocess.run(words, env=place, capture_output=True, text=True, check=True)
    assert found.stdout == "[]\n"


def test_the_start_is_left_as_it_was_and_its_frame_kept(views):
    start = rough_gaussians()
    before = start.values.copy()
    fit = Fit(start, views, options=FitOptions(steps=5))
    fit.run()
    np.testing.assert_array_equal(start.values, before)
    assert (fit.gaussians.values != before).any()
    assert fit.gaussians.frame is start.frame


def test_the_same_number_of_steps_gives_the_same_bytes(fitted, views):
    again = Fit(rough_gaussians(), views, options=FitOptions(steps=STEPS))
    again.run()
    assert again.gaussians.values.tobytes() == fitted.gaussians.values.tobytes()
    other = Fit(rough_gaussians(), views, options=FitOptions(steps=20), seed=1)
    other.run()
    assert other.gaussians.values.tobytes() != fitted.gaussians.values.tobytes()


@pytest.mark.parametrize(("seconds", "steps"), [(5.0, 4), (0.5, 0), (0.0, 0)])
def test_a_fit_for_a_time_ends_in_time(views, seconds, steps):
    now = iter(range(1000))
    told: list[float] = []
    fit = Fit(rough_gaussians(), views, options=FitOptions(seconds=seconds, steps=9))
    fit.run(clock=lambda: float(next(now)), report=told.append)
    # The clock is a second further at each look: once at the beginning, and before each step.
    assert fit.steps == steps
    assert next(now) == steps + 2
    assert told == [1.0]


def test_a_fit_tells_now_and_then_what_it_has_reached():
    told: list[tuple[float, int, float, float | None]] = []
    fit = Fit(rough_gaussians(), photographs(walk(8)), options=FitOptions(steps=100))
    fit.run(report=lambda share: told.append((share, fit.steps, fit.psnr, fit.validation_psnr())))
    assert [(share, steps) for share, steps, *_ in told] == [
        (pytest.approx(np.interp(0.49, OF_STEPS, OF_TIME)), 50),
        (pytest.approx(np.interp(0.99, OF_STEPS, OF_TIME)), 100),
        (1.0, 100),
    ]
    assert told[0][2] < told[1][2] < 40
    # One photograph is left out until three quarters of the fit are over.
    assert told[0][3] is not None and told[1][3] is not None
    assert told[0][3] < told[1][3] == told[2][3]
    assert fit.validation_psnr() == fit.psnr_of(fit.predicted)


def test_dark_surfaces_become_opaque(views):
    """Over black they could be fitted as well by Gaussians that stop little light."""
    view = FitView(views[2].rgb // 4, views[2].K, views[2].cam_from_local)
    fit = Fit(rough_gaussians(), [view], options=FitOptions(steps=STEPS, exposure=False))
    fit.run()
    assert np.median(picture(fit.gaussians, view.cam_from_local).alpha) > 0.9


@pytest.mark.parametrize("options", [{"steps": 40}, {"seconds": 40.0}])
def test_a_fit_ends_when_it_has_converged(views, monkeypatch, options):
    monkeypatch.setattr(fit_options, "CONVERGED_PER_VIEW", 2)
    monkeypatch.setattr(fit_options, "CONVERGED_LEAST", 5)
    now = iter(range(1000))
    fit = Fit(rough_gaussians(), views, options=FitOptions(**options))
    fit.run(clock=lambda: float(next(now)))
    assert fit.steps == 10
    further = Fit(rough_gaussians(), views, options=FitOptions(**options), begin=0.6)
    further.run(clock=lambda: float(next(now)))
    assert further.steps > 30


def test_a_fit_skips_what_its_validation_photographs_gain_nothing_by(monkeypatch):
    def steps_until_its_end(gains):
        monkeypatch.setattr(Fit, "_gains", lambda self: gains)
        now = iter(range(1000))
        views = photographs(walk(8))
        fit = Fit(rough_gaussians(), views, options=FitOptions(seconds=100.0))
        fit.run(clock=lambda: float(next(now)))
        assert fit.predicted
        return fit.steps

    # The part from 0.6 to 0.75 of the time, in which photographs have all of their size.
    assert steps_until_its_end(True) - steps_until_its_end(False) == pytest.approx(15, abs=4)


def test_a_fit_that_is_stopped_keeps_what_it_has():
    fit = Fit(rough_gaussians(), photographs(walk(8)), options=FitOptions(steps=100))
    fit.run(report=lambda share: fit.stop())
    assert fit.steps == 50 and fit.stopped
    # Validation photographs are judged all the same, and no other fit begins.
    assert set(fit.predicted) == set(validation_rows(8))
    assert fit.again(1, FitOptions(steps=9)).stopped


def test_masked_pixels_do_not_matter(views):
    def fit_to(fill):
        masked = []
        for number, view in enumerate(views):
            mask = np.ones((HEIGHT, WIDTH), bool)
            # Neither edge falls on a multiple of four, as pictures are taken smaller by four.
            mask[7:22, 9 + number : 30 + number] = False
            rgb = view.rgb.copy()
            rgb[~mask] = fill[~mask]
            masked.append(replace(view, rgb=rgb, mask=mask))
        fit = Fit(rough_gaussians(), masked, options=FitOptions(steps=40))
        fit.run()
        return fit.gaussians.values

    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    assert fit_to(noise).tobytes() == fit_to(np.full_like(noise, 255)).tobytes()


def test_photographs_of_different_brightness_are_explained_by_gains(views):
    logs = np.array([-0.06, -0.03, 0.0, 0.03, 0.06])[:, None] * [1.0, 0.5, -1.0]
    uneven = [
        replace(view, rgb=np.clip(view.rgb * np.exp(log), 0, 255).round().astype(np.uint8))
        for view, log in zip(views, logs, strict=True)
    ]
    fits = {}
    for exposure in (True, False):
        fits[exposure] = Fit(
            rough_gaussians(), uneven, options=FitOptions(steps=180, exposure=exposure)
        )
        fits[exposure].run()
    found = np.log([fits[True].cameras.gain(number) for number in range(5)])
    assert np.abs(found.mean(axis=0)).max() < 1e-6
    assert np.abs(found - logs).mean() < 0.4 * np.abs(logs).mean()
    assert all((fits[False].cameras.gain(number) == 1).all() for number in range(5))
    assert fits[True].psnr > fits[False].psnr + 0.3


@pytest.mark.parametrize("where", ["depth", "estimate"])
def test_depth_pulls_gaussians_to_where_it_is(where):
    """One photograph alone does not tell depth."""
    view = photograph(pose(0.0))
    truth = view.depth
    assert truth is not None
    start = rough_gaussians()
    start.values[:, :3] *= 1.12
    errors = []
    for known in (None, truth):
        given = replace(view, depth=known if where == "depth" else None)
        given = replace(given, estimate=known if where == "estimate" else None)
        fit = Fit(start, [given], options=FitOptions(steps=120, poses=False))
        fit.run()
        lens = Lens.of(view.cam_from_local, K, size=(WIDTH, HEIGHT), near=0.05)
        _, _, _, weighted, alpha = Splat(fit.gaussians.values, lens).image
        solid = alpha > 0.5
        errors.append(np.median(np.abs(weighted[solid] / alpha[solid] / truth[solid] - 1)))
    assert errors[1] < 0.5 * errors[0] and errors[0] > 0.03


def test_an_estimate_pulls_less_where_it_is_missed_by_less_than_its_tolerance():
    view = replace(photograph(pose(0.0)), depth=None)
    estimate = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    estimate[:, :9] = 0
    small = reduce_view(replace(view, estimate=estimate), 1)
    image = np.ones((5, HEIGHT, WIDTH), np.float32)
    pulls = []
    for missed in (0.0, 0.5, 1.0, 3.0, -3.0):
        image[3] = 2 * (1 + missed * ESTIMATE_TOLERANCE)
        gradient = np.zeros_like(image)
        add_depth(image, small, gradient, weight=0.0)
        assert not gradient[:3].any() and not gradient[:, :, :9].any()
        np.testing.assert_allclose(gradient[4], -2 * gradient[3])
        pulls.append(float(gradient[3, 0, 20]))
    np.testing.assert_allclose(pulls, ESTIMATE * np.array([0, 0.25, 0.5, 0.5, -0.5]), atol=1e-5)
    gradient = np.zeros_like(image)
    add_depth(image, reduce_view(view, 1), gradient, weight=1.0)
    assert not gradient.any()


@pytest.mark.parametrize(
    ("width", "widths"),
    [(3000, [187, 375, 750, 3000]), (1600, [200, 400, 800, 1600]), (480, [120, 240, 480, 480]),
     (240, [120, 240, 240, 240])],
)  # fmt: skip
def test_how_far_photographs_are_reduced_depends_on_their_size(width, widths):
    rgb = np.zeros((width * 3 // 4, width, 3), np.uint8)
    fit = Fit(rough_gaussians(), [FitView(rgb, K, pose(0.0), None, None)])
    shares = [*(share for share, _ in module.SIZES), module.LAST]
    assert [fit._at_size(0, share).target.shape[2] for share in shares] == widths


def test_validation_photographs_are_evenly_spread():
    assert validation_rows(7) == ()
    assert validation_rows(8) == (4,)
    assert validation_rows(16) == (4, 12)
    assert len(validation_rows(1000)) == len(set(validation_rows(1000))) == 5


def test_validation_photographs_are_left_out_until_they_join():
    views = photographs(walk(8))
    (held,) = validation_rows(8)
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    altered = [*views]
    altered[held] = replace(views[held], rgb=noise)
    options = FitOptions(exposure=False)
    fits = [Fit(rough_gaussians(), each, options=options) for each in (views, altered)]
    before = VALIDATION_ENDS - 1e-6
    for fit in fits:
        for share in np.linspace(0, before, 24):
            fit.step(share)
        assert fit.predicted == {}
    values = fits[0].gaussians.values.copy()
    assert values.tobytes() == fits[1].gaussians.values.tobytes()
    for fit in fits:
        for _ in range(16):
            fit.step(VALIDATION_ENDS)
    assert fits[0].gaussians.values.tobytes() != fits[1].gaussians.values.tobytes()
    # Predicted before they joined: from the given pose, by the Gaussians of then.
    assert list(fits[0].predicted) == [held]
    expected = picture(type(rough_gaussians())(values), views[held].cam_from_local)
    # With random colours behind them, what stops the light has its own colour.
    own = expected.rgb / np.maximum(expected.alpha, SOLID)[..., None]
    for fit in fits:
        np.testing.assert_allclose(fit.predicted[held].rgb, own, atol=1e-5)


def test_a_photograph_that_is_masked_everywhere_validates_nothing():
    views = photographs(walk(16))
    first, second = validation_rows(16)
    views[first] = replace(views[first], mask=np.zeros((HEIGHT, WIDTH), np.bool_))
    fit = Fit(rough_gaussians(), views, options=FitOptions())
    assert np.isfinite([fit.left_out_psnr(), fit.shown_psnr()]).all()
    fit._add_validation()
    assert list(fit.predicted) == [second]


def test_there_are_never_more_gaussians_than_allowed(views):
    start = rough_gaussians()
    options = FitOptions(steps=800, growth=1e-9, most_gaussians=len(start) + 50)
    fit, counts = Fit(start, views, options=options), []
    for share in np.linspace(0, 0.5, 401):
        fit.step(share)
        counts.append(len(fit.gaussians))
    assert len(start) < max(counts) <= options.most_gaussians


def test_recorded_depth_lets_a_fit_go_on_and_grow():
    bare, recorded = converged_steps(8, recorded=False), converged_steps(8, recorded=True)
    assert bare < recorded == converged_steps(1, recorded=True)
    assert most_gaussians(10**6, 8, recorded=False) == 8 * PER_VIEW
    assert most_gaussians(10**6, 8, recorded=True) == 10**6 * PER_STEP
    views = photographs(walk(3), depth=True)
    fit = Fit(rough_gaussians(), views, options=FitOptions(steps=10**6))
    assert (fit.recorded, fit.converged_after) == (True, recorded)


WHOLE = 10


@pytest.fixture
def fit_of(monkeypatch):
    """Fits without depth that converge after WHOLE steps."""
    monkeypatch.setattr(fit_options, "CONVERGED_PER_VIEW", 2)
    monkeypatch.setattr(fit_options, "CONVERGED_LEAST", WHOLE)

    def made(count: int = 5, **options: float) -> Fit:
        return Fit(rough_gaussians(), photographs(walk(count)), options=FitOptions(**options))

    return made


@pytest.mark.parametrize(
    ("steps", "made"),
    [(9, [9]), (14, [10]), (15, [10, 5]), (22, [10, 10]), (36, [10, 9, 8, 9]), (900, [10] * 6)],
)
def test_a_whole_fit_is_followed_by_others(steps, made, fit_of):
    assert [fit.steps for fit in run_fits(fit_of(steps=steps))] == made


def test_time_is_shared_by_whole_fits(fit_of):
    now = iter(range(10_000))
    # A step takes a second of this clock, and each fit two more.
    fits = run_fits(fit_of(seconds=40.0), clock=lambda: float(next(now)))
    assert [fit.steps for fit in fits][:2] == [10, 10]
    assert len(fits) == 3


def test_each_fit_chooses_anew_and_all_can_be_repeated(fit_of):
    one, other = (run_fits(fit_of(steps=30)) for _ in range(2))
    values = [fit.gaussians.values.tobytes() for fit in one]
    assert len(set(values)) == 3
    assert values == [fit.gaussians.values.tobytes() for fit in other]


def test_all_fits_together_have_no_more_gaussians_than_allowed(fit_of):
    alone = len(run_fits(fit_of(steps=10))[0].population)
    for most in (3 * alone, 3 * alone - 1):
        fits = run_fits(fit_of(steps=900, most_gaussians=most))
        assert len(fits) == most // alone
        assert sum(len(fit.population) for fit in fits) <= most
    assert len(run_fits(fit_of(steps=900, most_gaussians=alone))) == 1


def test_fits_end_when_left_out_photographs_gain_nothing(monkeypatch, fit_of):
    gains = iter([0.5, 0.01, 0.5])
    monkeypatch.setattr(module, "_gain", lambda fits, fit: next(gains))
    assert len(run_fits(fit_of(8, steps=160))) == 3
    gains = iter([0.5, -0.01, 0.5])
    assert len(run_fits(fit_of(8, steps=160))) == 2


def test_a_fit_that_goes_on_with_another_stays_the_only_one(fit_of):
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
def test_left_out_photographs_choose_the_backdrop(gain, backdrop, monkeypatch, fit_of):
    monkeypatch.setattr(module, "TRIAL_STEPS", 6)
    trials = []

    def psnr(self):
        trials.append(self)
        return 20.0 if self.backdrop else 20.0 + gain

    monkeypatch.setattr(Fit, "left_out_psnr", psnr)
    first = fit_of(count=10, steps=8)
    chosen, why = with_chosen_backdrop(first)
    assert chosen is trials[not backdrop] and chosen.backdrop is backdrop
    assert "random 20.00 dB" in why and f"black {20 + gain:.2f} dB" in why
    # Trials leave photographs out to their end, and fit to no others than the fit itself.
    assert [0 < trial.steps < 6 and not trial.predicted for trial in trials] == [True, True]
    alone = run_fits(chosen)[0]
    assert alone is chosen and alone.steps == 8
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
def test_many_photographs_none_left_out_and_short_fits_have_no_trials(made, fit_of):
    fit = fit_of(**made)
    assert with_chosen_backdrop(fit) == (fit, "")
