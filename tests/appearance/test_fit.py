"""Fits of a small scene: better pictures, the same bytes, on time, masks, exposure, validation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
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

from gvtools.appearance import fit as fit_module
from gvtools.appearance import fit_options
from gvtools.appearance.fit import OF_STEPS, OF_TIME, VALIDATION_ENDS, Fit, validation_rows
from gvtools.appearance.fit_options import (
    PER_STEP,
    PER_VIEW,
    FitOptions,
    converged_steps,
    most_gaussians,
)
from gvtools.appearance.loss import ESTIMATE, ESTIMATE_TOLERANCE, add_depth
from gvtools.appearance.splat.project_kernels import SH
from gvtools.appearance.splat.splat import Lens, Splat
from gvtools.poses.views import FitView, reduce_view

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


def test_without_validation_photographs_there_is_no_psnr_of_them(fitted):
    assert fitted.validation_psnr() is None


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


@pytest.mark.parametrize(
    ("options", "limit", "wanted"),
    [
        ({}, 120.0, True),
        ({"steps": 7}, None, True),
        ({"steps": 0}, None, False),
        ({"steps": 5, "seconds": 0.0}, 0.0, False),
        ({"steps": 0, "seconds": 3.0}, 3.0, True),
    ],
)
def test_a_fit_takes_two_minutes_at_most_unless_told_otherwise(options, limit, wanted):
    given = FitOptions(**options)
    assert (given.limit, given.wanted) == (limit, wanted)


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


def test_masks_do_not_pull_at_the_pixels_beside_them():
    """Where photographs are explained already, SSIM's windows see no edge at a mask's border."""
    start = rough_gaussians()
    start.values[:, SH : SH + 3] += np.random.default_rng(0).normal(0, 1, (len(start), 3))
    rgb = np.rint(picture(start, pose(0.0)).rgb * 255).astype(np.uint8)
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[10:20, 15:30] = False
    strongest = []
    for each in (None, mask):
        view = FitView(rgb, K, pose(0.0), each)
        fit = Fit(start, [view], options=FitOptions(ssim=1.0, exposure=False))
        lens = Lens.of(view.cam_from_local, K, size=(WIDTH, HEIGHT), near=fit.near)
        splat = Splat(start.values, lens)
        splat.image[:3] /= splat.image[4]
        gradient = fit._loss_gradient(0, splat, reduce_view(view, 1))
        strongest.append(np.abs(gradient[:3]).max())
    assert strongest[1] < 2 * strongest[0]


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


def depth_error(view, *, weight=0.1):
    """Median relative error of depth, from too far away, after a fit to one photograph."""
    start = rough_gaussians()
    start.values[:, :3] *= 1.12
    fit = Fit(start, [view], options=FitOptions(steps=120, depth=weight, poses=False))
    fit.run()
    lens = Lens.of(view.cam_from_local, K, size=(WIDTH, HEIGHT), near=0.05)
    _, _, _, weighted, alpha = Splat(fit.gaussians.values, lens).image
    solid = alpha > 0.5
    truth = photograph(pose(0.0)).depth
    assert truth is not None
    return float(np.median(np.abs(weighted[solid] / alpha[solid] / truth[solid] - 1)))


def test_recorded_depth_pulls_gaussians_to_where_it_is():
    # One photograph alone does not tell depth.
    view = photograph(pose(0.0))
    without = depth_error(view, weight=0.0)
    assert without > 0.03
    assert depth_error(view) < 0.5 * without


def test_an_estimate_pulls_gaussians_to_where_it_is():
    view = photograph(pose(0.0))
    without = depth_error(replace(view, depth=None))
    assert without > 0.03
    assert depth_error(replace(view, depth=None, estimate=view.depth)) < 0.5 * without


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


def test_validation_photographs_are_evenly_spread():
    assert validation_rows(7) == ()
    assert validation_rows(8) == (4,)
    assert validation_rows(16) == (4, 12)
    assert len(validation_rows(1000)) == len(set(validation_rows(1000))) == 5


def test_validation_photographs_begin_with_the_exposure_of_their_neighbours():
    views = photographs(walk(16))
    brightness = np.exp(np.linspace(-0.1, 0.1, 16))
    views = [
        replace(view, rgb=np.clip(view.rgb * bright, 0, 255).astype(np.uint8))
        for view, bright in zip(views, brightness, strict=True)
    ]
    fit = Fit(rough_gaussians(), views, options=FitOptions())
    for share in np.linspace(0, VALIDATION_ENDS - 1e-6, 300):
        fit.step(share)
    rows = list(validation_rows(16))
    assert not fit.cameras.log_gains[rows].any()
    fit._add_validation()
    gains = fit.cameras.log_gains[:, 0]
    assert gains[rows[0]] < -0.01 < 0.01 < gains[rows[1]]
    np.testing.assert_allclose(fit.cameras.log_gains.mean(axis=0), 0, atol=1e-12)


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
    for fit in fits:
        np.testing.assert_allclose(fit.predicted[held].rgb, expected.rgb, atol=1e-5)


def test_a_photograph_that_is_masked_everywhere_validates_nothing():
    views = photographs(walk(16))
    first, second = validation_rows(16)
    views[first] = replace(views[first], mask=np.zeros((HEIGHT, WIDTH), np.bool_))
    fit = Fit(rough_gaussians(), views, options=FitOptions())
    assert np.isfinite(fit.left_out_psnr())
    fit._add_validation()
    assert list(fit.predicted) == [second]


def test_harmonics_join_one_degree_after_the_other(views):
    fit = Fit(rough_gaussians(), views, options=FitOptions())
    for degree, share in ((0, 0.0), (1, 0.13), (2, 0.25)):
        for _ in range(3):
            fit.step(share)
        used = SH + 3 * (degree + 1) ** 2
        assert fit.gaussians.values[:, used - 3 : used].any()
        assert not fit.gaussians.values[:, used:].any()


def test_there_are_never_more_gaussians_than_allowed(views):
    start = rough_gaussians()
    options = FitOptions(steps=800, growth=1e-9, most_gaussians=len(start) + 50)
    fit, counts = Fit(start, views, options=options), []
    for share in np.linspace(0, 0.5, 401):
        fit.step(share)
        counts.append(len(fit.gaussians))
    assert len(start) < max(counts) <= options.most_gaussians


@pytest.mark.parametrize(
    ("options", "begin", "made", "share", "most"),
    [
        ({"steps": 100}, 0.0, 3, 0.4, 100 * PER_STEP),
        ({"steps": 10**6}, 0.0, 3, 0.4, converged_steps(8, recorded=False) * PER_STEP),
        ({"steps": 10**6}, 0.6, 3, 0.7, 300 + 8 * PER_VIEW),
        ({"steps": 10**6, "most_gaussians": 999}, 0.0, 3, 0.4, 999),
        # 40 steps in two fifths of the time; later ones take longer.
        ({"seconds": 9.0}, 0.0, 34, 0.4, 50 * PER_STEP),
        # A tenth of what is left, and steps that all take the same.
        ({"seconds": 9.0}, 0.6, 5, 0.64, 300 + 50 * PER_STEP),
    ],
)
def test_steps_and_photographs_limit_how_many_gaussians_there_are(
    views, options, begin, made, share, most
):
    fit = Fit(rough_gaussians(), (views * 8)[:8], options=FitOptions(**options), begin=begin)
    fit.steps = made
    fit._begun_with = 300 if begin else 0
    assert fit._most_gaussians(share) == pytest.approx(most, rel=0.02)


def test_recorded_depth_lets_a_fit_go_on_and_grow():
    bare, recorded = converged_steps(8, recorded=False), converged_steps(8, recorded=True)
    assert bare < recorded == converged_steps(1, recorded=True)
    assert most_gaussians(10**6, 8, recorded=False) == 8 * PER_VIEW
    assert most_gaussians(10**6, 8, recorded=True) == 10**6 * PER_STEP
    views = photographs(walk(3), depth=True)
    fit = Fit(rough_gaussians(), views, options=FitOptions(steps=10**6))
    assert (fit.recorded, fit.converged_after) == (True, recorded)


def test_steps_shorten_at_the_end():
    start, late, end = (fit_module._rates(share) for share in (0.0, 0.75, 1.0))
    np.testing.assert_array_equal(start[3:], late[3:])
    np.testing.assert_allclose(end[3:], fit_module.REST * late[3:], rtol=1e-6)
    assert (end[:3] < late[:3]).all()
