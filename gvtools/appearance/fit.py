"""Fitting of Gaussians to photographs: stochastic gradient descent, one photograph a step.

After Kerbl et al. 2023, with step lengths for hundreds of steps instead of tens of thousands.
Positions move in units of a pixel's width at their depth, so results do not depend on the scene's
scale.

A fit has converged after a number of steps that grows with the number of photographs; more steps
gain next to nothing. Fits with other random seeds make other errors, above all where few
photographs leave much undetermined, so the mean of their pictures is better than each of them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance import loss
from gvtools.appearance.appearance import Picture, mean_picture
from gvtools.appearance.camera_corrections import CameraCorrections, Exposures
from gvtools.appearance.fit_options import FitOptions, converged_steps, most_gaussians
from gvtools.appearance.free_space import floaters, free_depth
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.loss import add_bending, add_depth
from gvtools.appearance.population import Population, Sample, pixel_width
from gvtools.appearance.splat.project_kernels import LOG_SCALE, LOGIT, QUATERNION, SH, VALUES
from gvtools.appearance.splat.splat import Lens, Splat
from gvtools.kernels import in_threads
from gvtools.poses.refinement import (
    LEAST_BETTER,
    FitView,
    ReducedView,
    comparable,
    prediction_error,
    reduce_view,
)

# The progress of a fit runs from 0 to 1: the share of its time, not of its steps, that is over.
# Numbers below that name a part of the fit are progress.

# The progress from which photographs are taken at a quarter, half and all of their size; those with
# fewer than SMALL pixels at twice that, others halved until they have at most LARGE, before LAST.
SIZES = ((0.0, 4), (0.2, 2), (0.6, 1))
SMALL, LARGE, LAST = 112_000, 900_000, 0.85
# Each degree of the spherical harmonics joins after so much progress.
DEGREE_EVERY = 0.12
# Until GROWTH_END, Gaussians are added every GROWTH_SHARE of progress, at least FEWEST_BETWEEN
# steps apart, since fewer tell too little of where they are needed, at most MOST_BETWEEN apart.
GROWTH_END, GROWTH_SHARE, FEWEST_BETWEEN, MOST_BETWEEN = 0.55, 0.13, 25, 100
# Early steps are quick because pictures are small: shares of the steps that are made (OF_STEPS) and
# of the time that is over by then (OF_TIME), with straight lines between.
OF_STEPS, OF_TIME = (0.0, 0.5, 0.86, 1.0), (0.0, 0.2, 0.6, 1.0)
# Positions move by at most about POSITION_RATE pixels a step, times POSITION_END at the end.
POSITION_RATE, POSITION_END = 0.32, 0.01
# A fit that goes on with fitted Gaussians begins here: pictures have all of their size.
CONTINUED = 0.6
# Step lengths (Adam) of log scales, quaternions, opacity logits, colours and higher harmonics.
RATES = (0.02, 0.004, 0.05, 0.01, 5e-4)
# From REST_BEGINS (progress) on, step lengths of all but positions fall to the share REST:
# otherwise each step undoes a part of what steps on other photographs gained.
REST, REST_BEGINS = 0.1, 0.75
# Validation photographs: one of VALIDATION_EVERY, at most MOST_VALIDATION, are not fitted until
# VALIDATION_ENDS (progress), so that they tell how well the others predict them.
VALIDATION_EVERY, VALIDATION_ENDS, MOST_VALIDATION = 8, 0.75, 5
# At these parts of the progress, all at the full size, a fit for a time asks whether validation
# photographs gained LEAST_STAGE_GAIN [dB] since the last time. Before it made the share GAINS_UNTIL
# of the steps to convergence it gains, whatever a few photographs say.
GAIN_CHECKS, LEAST_STAGE_GAIN, GAINS_UNTIL = (0.6, 0.65, 0.7), 0.025, 0.25
# Dropout: without recorded depth, each step ignores a random share of the Gaussians, progress times
# DROPOUT / number of photographs, at most MOST_DROPOUT. Otherwise Gaussians behind others would
# get no gradient from few viewing directions. After "DropGaussian" (Park et al. 2025).
DROPOUT, MOST_DROPOUT = 1.2, 0.5
# With fewer than FEW photographs, all opacities shrink by FADING at each step; gradients restore
# those that photographs need. The others vanish, above all floaters close to the cameras. After
# "Binocular-Guided 3D Gaussian Splatting" (Han et al. 2024).
FEW, FADING = 10, 0.003
# The backward pass skips blocks of 16 pixels to which a Gaussian adds less light than this in all:
# a tenth less time for the same pictures.
FAINT = 0.01
# Weight in the loss of the bending of surfaces, for views without recorded depth.
SMOOTH = 0.1
# Reduced photographs are kept for later steps if all of them together take fewer bytes.
KEPT_BYTES = 2**30
# Cameras that are not fitted take the pose corrections of those near them only if validation
# photographs gain at least this on average by doing so [dB].
LEAST_GAIN = 0.1
# The progress at which refined poses are checked, beside the end.
POSE_CHECKS = (0.3, 0.6)
# Greatest exposure [log] that a start from elsewhere tells of a photograph.
MOST_GAIN = 0.7
# Where Gaussians are added, those at least so wide are split, smaller ones are cloned [px].
WIDE = 2.0
# A start that was fitted before is judged by so many photographs.
JUDGES = 10
# Gaussians in a photograph's free space lose this share of their opacity at each step on it.
FLOATER_FADE = 0.3


class Fit:
    """A fit in progress."""

    def __init__(
        self,
        start: Gaussians,
        views: Sequence[FitView],
        *,
        options: FitOptions | None = None,
        seed: int = 0,
        begin: float = 0.0,
        surface: NDArray[np.float32] | None = None,
        splatter: type[Splat] = Splat,
        backdrop: bool = True,
    ) -> None:
        """Prepare a fit; ``start`` is left as it is.

        Args:
            seed: of the order of photographs and of where Gaussians are added.
            begin: progress at which the fit begins, above 0 where ``start`` was fitted to the same
                photographs before; there are no validation photographs then.
            surface: (N, 3) points on surfaces: nothing may float before them, see free_space.
            backdrop: put another colour behind the Gaussians in each step, without recorded depth:
                only opaque surfaces match photographs then, while over black a photograph's dark
                parts could be fitted by stopping less light.
        """
        self.start, self.seed, self.splatter = start, seed, splatter
        self.views, self.options = list(views), options or FitOptions()
        self.frame, self.rng = start.frame, np.random.default_rng(seed)
        width = pixel_width(start.values[:, :LOG_SCALE], self.views)
        self.population = Population(start.values.copy(), width)
        self.recorded = all(view.depth is not None for view in self.views)
        self.backdrop = backdrop and not self.recorded
        self.undimmed = self.backdrop and not begin and all(v.depth is None for v in self.views)
        self.converged_after = converged_steps(len(self.views), recorded=self.recorded)
        self.cameras = CameraCorrections(
            np.array([view.cam_from_local for view in self.views]),
            depth=float(np.median(width)) * float(np.median([v.K[0, 0] for v in self.views])),
            with_poses=self.options.poses and self.recorded,
            exposure=self.options.exposure,
        )
        self.near = 0.02 * self.cameras.depth
        self.surface, self.begin = surface, begin
        # Of all calls of ``run`` together.
        self.steps, self.seconds = 0, 0.0
        self._stop, self._last_psnr = threading.Event(), -np.inf
        # Pictures of the validation photographs, by their numbers, before these joined the fit.
        self.predicted: dict[int, Picture] = {}
        # The limit of Gaussians does not count those of an earlier fit.
        self._begun_with = len(start.values) if begin else 0
        rows = () if begin else validation_rows(len(self.views))
        # What is masked everywhere tells nothing.
        self._validation = tuple(row for row in rows if _shows(self.views[row]))
        self._checks = tuple(share for share in POSE_CHECKS if share > begin)
        # Recorded depth fixes Gaussians along the ray, as photographs from more directions would.
        self._dropout = 0.0 if self.recorded else min(MOST_DROPOUT, DROPOUT / len(self.views))
        self._fading = len(self.views) < FEW and not self.recorded
        # See ``free_depth``; None without points.
        self._free = [
            None if surface is None else free_depth(surface, self._lens(view, view.cam_from_local))
            for view in self.views
        ]
        self._grown = (0, begin)
        self._order: list[int] = []
        self._reduced: dict[int, tuple[int, ReducedView]] = {}
        self._compared: list[ReducedView] | None = None
        self._errors: list[float] = []
        # PSNR of one validation photograph for each call of ``validation_psnr``.
        self._validation_psnr: list[float] = []

    @property
    def gaussians(self) -> Gaussians:
        """As fitted so far."""
        return Gaussians(self.population.values, frame=self.frame)

    def stop(self) -> None:
        """Stop ``run``, and that of fits made by ``again``, after the step at work."""
        self._stop.set()

    @property
    def stopped(self) -> bool:
        """Whether ``stop`` was called."""
        return self._stop.is_set()

    def again(self, number: int, options: FitOptions, *, backdrop: bool | None = None) -> Fit:
        """A new fit from the same start at the poses of this one, which has ended or not begun.

        Random choices differ by its ``number``; a ``backdrop`` of None is this one's.
        """
        poses = self.cameras.poses()
        views = [replace(v, cam_from_local=p) for v, p in zip(self.views, poses, strict=True)]
        kept = options.replaced(poses=False)
        seed = self.seed + number
        fit = Fit(
            self.start, views, options=kept, seed=seed, surface=self.surface,
            splatter=self.splatter, backdrop=self.backdrop if backdrop is None else backdrop,
        )  # fmt: skip
        fit._stop = self._stop
        return fit

    def run(
        self,
        *,
        clock: Callable[[], float] = time.perf_counter,
        report: Callable[[float], object] = lambda share: None,
        until: float = 1.0,
    ) -> None:
        """Fit for the time or the number of steps that the options give, or until it converged.

        In a fit for a time, what is left until validation photographs join is skipped when they
        stop gaining. ``stop`` ends it after the step at work. ``report`` is called now and then,
        and at the end, with the share that is done; a trial ends at the progress ``until``, with
        its validation photographs left out, and may be run on.
        """
        limit, began = self.options.limit, clock() - self.seconds
        most = np.inf if self.begin else self.converged_after
        if limit is None:
            most = min(self.options.steps or 0, most)
        skipped, checks = 0.0, list(GAIN_CHECKS)
        while not self.stopped:
            self.seconds = clock() - began
            over = self.steps / most if most else 1.0
            if not self.begin:
                over = float(np.interp(over, OF_STEPS, OF_TIME))
            if limit is not None:
                over = max(over, self.seconds / max(limit, 1e-9)) + skipped
            if over >= until:
                break
            if limit is not None and self._validation and checks and over >= checks[0]:
                checks = [share for share in checks if share > over]
                if not self._gains():
                    skipped, checks = skipped + max(VALIDATION_ENDS - over, 0), []
                    continue
            self.step(self.begin + (1 - self.begin) * over)
            if self.steps % 50 == 0:
                report(over)
        if until < 1:
            return
        if self._validation:
            self._add_validation()
        self._check_poses()
        self._reduced = {}
        report(1.0)

    @property
    def psnr(self) -> float:
        """PSNR of the last 50 steps' photographs, each before its step, at its size then [dB].

        Where surfaces are not opaque yet, the random colour behind them lowers it.
        """
        return _psnr(float(np.mean(self._errors[-50:])) if self._errors else 1.0)

    def validation_psnr(self) -> float | None:
        """Mean PSNR of the validation photographs [dB]; None without any.

        While they are left out, each call renders only one of them again, to save time.
        """
        if self._validation:
            row = self._validation[len(self._validation_psnr) % len(self._validation)]
            shown = self._picture(row, self.cameras.given[row])
            self._validation_psnr.append(-self._error(row, shown))
            return float(np.mean(self._validation_psnr[-len(self._validation) :]))
        return self.psnr_of(self.predicted) if self.predicted else None

    def _gains(self) -> bool:
        """Whether validation photographs gained since the last call."""
        if self.steps < GAINS_UNTIL * self.converged_after:
            return True
        before, self._last_psnr = self._last_psnr, self.left_out_psnr()
        # What cannot be measured is no reason to end.
        return not self._last_psnr < before + LEAST_STAGE_GAIN

    def left_out_psnr(self) -> float:
        """Mean PSNR of all validation photographs, rendered now [dB]; NaN without any."""
        rows = self._validation
        return self.psnr_of({row: self._picture(row, self.cameras.given[row]) for row in rows})

    def psnr_of(self, pictures: Mapping[int, Picture]) -> float:
        """Mean PSNR of rendered pictures against their photographs, by their numbers [dB]."""
        return -float(np.mean([self._error(row, shown) for row, shown in pictures.items()]))

    def shown_psnr(self) -> float:
        """Mean PSNR of some of the photographs, as the Gaussians show them now [dB]."""
        shown = [row for row, view in enumerate(self.views) if _shows(view)]
        rows = shown[:: max(-(-len(shown) // JUDGES), 1)]
        return self.psnr_of({row: self._picture(row, self.cameras.pose(row)) for row in rows})

    def step(self, share: float) -> None:
        """Make one step, on one photograph, at a progress of ``share``."""
        self.steps += 1
        if self._checks and share >= self._checks[0]:
            self._checks = self._checks[1:]
            self._check_poses()
        if share >= VALIDATION_ENDS and self._validation:
            self._add_validation()
        if not self._order:
            given = [row for row in range(len(self.views)) if row not in self._validation]
            self._order = self.rng.permutation(given).tolist()
        number = self._order.pop()
        view = self._at_size(number, share)
        degree = min(2, int(share / DEGREE_EVERY))
        lens = Lens.of(self.cameras.pose(number), view.K, size=view.size, near=self.near)
        some = Sample(self.population.values, self._dropout * share, rng=self.rng)
        picture = self.splatter(some.values, lens, degree=degree, faint=FAINT)
        gradient = self._loss_gradient(number, picture, view)
        rows, d_camera = picture.backward(gradient)
        seen = some.back(picture.seen, rows)
        self.cameras.step(number, d_camera, share=share)
        used = SH + 3 * (degree + 1) ** 2
        in_threads(
            loss.adam_rows, len(seen), seen, rows[:, :used],
            self.population.values, self.population.moments, _rates(share),
            self.population.footprint, self.steps,
        )  # fmt: skip
        if self._fading:
            self.population.fade(FADING)
        free = self._free[number]
        if free is not None:
            floating = floaters(self.population.values, lens, free, rows=seen)
            self.population.fade(FLOATER_FADE, seen[floating])
        # Gradients by the centres in the picture; half a picture is 1, see FitOptions.
        pull = np.hypot(rows[:, VALUES] * lens.width, rows[:, VALUES + 1] * lens.height)
        self.population.pull[seen] += pull * (0.5 / (lens.width * lens.height))
        self.population.pulls[seen] += 1
        since = self.steps - self._grown[0]
        periods = int(share / GROWTH_SHARE) - int(self._grown[1] / GROWTH_SHARE)
        due = since >= FEWEST_BETWEEN and periods > 0
        if due or since >= MOST_BETWEEN:
            self._grown = (self.steps, share)
            if share < self.begin + (1 - self.begin) * GROWTH_END:
                most = self._most_gaussians(share)
                self.population.grow(self.options.growth, most, wide=WIDE, rng=self.rng)
            self.population.remove_faint()

    def _lens(self, view: FitView, pose: NDArray[np.float64]) -> Lens:
        height, width = view.rgb.shape[:2]
        return Lens.of(pose, view.K, size=(width, height), near=self.near)

    def _most_gaussians(self, share: float) -> int:
        """Limit of the number of Gaussians at a progress of ``share``."""
        steps: float = self.options.steps or self.converged_after
        if self.options.limit is not None:
            over = (share - self.begin) / (1 - self.begin)
            made = over if self.begin else float(np.interp(over, OF_TIME, OF_STEPS))
            steps = self.steps / made
        if not self.begin:
            steps = min(steps, self.converged_after)
        most = most_gaussians(int(steps), len(self.views), recorded=self.recorded)
        return min(self._begun_with + most, self.options.most_gaussians)

    def _check_poses(self) -> None:
        """Restore the given poses unless refined ones predict neighbouring photographs better."""
        if self.cameras.with_poses:
            if self._compared is None:
                self._compared = comparable(self.views)
            before = prediction_error(self._compared, self.cameras.given)
            after = prediction_error(self._compared, self.cameras.poses())
            if not after < before * (1 - LEAST_BETTER):
                self.cameras.give_back()

    def _add_validation(self) -> None:
        """Render the validation photographs, then add them to the fit.

        They also decide whether other cameras take the pose corrections of their neighbours.
        """
        rows, cameras = self._validation, self.cameras
        self.predicted = {row: self._picture(row, cameras.given[row]) for row in rows}
        if cameras.with_poses:
            near = {row: self._picture(row, cameras.like_neighbours(row, but=rows)) for row in rows}
            gain = [
                self._error(row, self.predicted[row]) - self._error(row, near[row]) for row in rows
            ]
            if np.mean(gain) > LEAST_GAIN:
                cameras.spread, self.predicted = True, near
        cameras.start_like_neighbours(rows)
        known = self._exposures()
        for row in rows:
            cameras.log_gains[row] = np.log(known.at(cameras.given[row]))
        cameras.log_gains -= cameras.log_gains.mean(axis=0)
        self._validation = ()

    def _picture(self, number: int, pose: NDArray[np.float64]) -> Picture:
        lens = self._lens(self.views[number], pose)
        gain = self._exposures().at(pose)
        values, free = self.population.values, self._free[number]
        if free is not None:
            values = values[~floaters(values, lens, free)]
        return Picture.of(self.splatter(values, lens), gain=gain, backdrop=self.undimmed)

    def _exposures(self) -> Exposures:
        """Exposures of the photographs that are fitted, without the validation photographs."""
        given = [row for row in range(len(self.views)) if row not in self._validation]
        gains = self.cameras.log_gains[given]
        return Exposures(self.cameras.given[given], gains - gains.mean(axis=0), self.cameras.depth)

    def compare_exposures(self) -> None:
        """Set the photographs' exposures to those at which the start shows them best."""
        if not self.cameras.exposure:
            return
        found = np.zeros((len(self.views), 3))
        for row, view in enumerate(self.views):
            small = reduce_view(view, _reduction(view, 0.0))
            lens = Lens.of(self.cameras.given[row], small.K, size=small.size, near=self.near)
            shown = Picture.of(self.splatter(self.population.values, lens))
            where = shown.solid & (small.weight > 0)
            pairs = shown.rgb[where] * small.target[:, where].T
            squares = np.square(shown.rgb[where]).sum(axis=0)
            if squares.all() and pairs.any(axis=0).all():
                found[row] = np.log(pairs.sum(axis=0) / squares)
        gains = found - found.mean(axis=0)
        self.cameras.log_gains[:] = np.clip(gains, -MOST_GAIN, MOST_GAIN)

    def _error(self, number: int, picture: Picture) -> float:
        """Negative PSNR of a rendered picture against its photograph [dB]."""
        view = self.views[number]
        off = picture.rgb - view.rgb / np.float32(255)
        off = off if view.mask is None else off[view.mask]
        return 10 * float(np.log10(np.square(off).mean()))

    def _at_size(self, number: int, share: float) -> ReducedView:
        factor = _reduction(self.views[number], share)
        if number in self._reduced and self._reduced[number][0] == factor:
            return self._reduced[number][1]
        view = reduce_view(self.views[number], factor)
        if len(self.views) * view.nbytes < KEPT_BYTES:
            self._reduced[number] = factor, view
        return view

    def _loss_gradient(self, number: int, picture: Splat, view: ReducedView) -> NDArray[np.float32]:
        """(5, H, W) gradient of the loss, times the number of pixels to avoid tiny numbers."""
        options, pixels = self.options, view.weight.size
        gain, alpha = self.cameras.gain(number), picture.image[4]
        # With recorded depth, a backdrop costs 0.3 dB in cameras far from all photographs (demo
        # room).
        behind = np.zeros((3, 1, 1), np.float32)
        if view.depth is None and self.backdrop:
            behind = self.rng.random((3, 1, 1), np.float32)
        lit = picture.image[:3] * gain[:, None, None]
        shown = lit + (1 - alpha) * behind
        # SSIM compares windows: masked pixels take the rendered colour as their target, so that
        # they add nothing to the loss of pixels near them.
        masked = self.views[number].mask is not None
        target = np.where(view.weight > 0, view.target, shown) if masked else view.target
        gradient = np.zeros_like(picture.image)
        in_threads(loss.loss_gradient, 3, shown, target, view.weight, options.ssim, gradient)
        gradient *= pixels
        error = ((shown - target) ** 2 * view.weight).mean() / max(view.weight.mean(), 1e-6)
        self._errors.append(float(error))
        self.cameras.step_gain(number, (gradient[:3] * lit).sum(axis=(1, 2)) / pixels)
        gradient[4] = -(gradient[:3] * behind).sum(axis=0)
        gradient[:3] *= gain[:, None, None]
        add_depth(picture.image, view, gradient, weight=options.depth)
        if view.depth is None:
            add_bending(picture.image, view.target, gradient, weight=SMOOTH)
        return gradient


def validation_rows(views: int) -> tuple[int, ...]:
    """Numbers of the validation photographs among ``views`` photographs, evenly spread."""
    count = min(views // VALIDATION_EVERY, MOST_VALIDATION)
    return tuple((2 * k + 1) * views // (2 * count) for k in range(count))


def _reduction(view: FitView, share: float) -> int:
    """By how much a photograph's size is divided at a progress of ``share``."""
    factor = next(size for begins, size in reversed(SIZES) if share >= begins)
    pixels = view.rgb.size // 3
    if pixels < SMALL:
        return max(factor // 2, 1)
    while pixels > LARGE and share < LAST:
        factor, pixels = 2 * factor, pixels // 4
    return factor


def _shows(view: FitView) -> bool:
    return view.mask is None or bool(view.mask.any())


def _psnr(error: float) -> float:
    return -10 * float(np.log10(max(error, 1e-10)))


def _rates(share: float) -> NDArray[np.float32]:
    scale, turn, opacity, color, harmonic = RATES
    rates = np.empty(VALUES, np.float32)
    rates[:LOG_SCALE] = POSITION_RATE * POSITION_END**share
    rates[LOG_SCALE:QUATERNION] = scale
    rates[QUATERNION:LOGIT] = turn
    rates[LOGIT] = opacity
    rates[SH : SH + 3] = color
    rates[SH + 3 :] = harmonic
    rates[LOG_SCALE:] *= REST ** max(0.0, (share - REST_BEGINS) / (1 - REST_BEGINS))
    return rates


# A backdrop is another random colour behind the Gaussians at each step, see Fit. With it, an object
# in 12 photographs gains 3 dB, and a toy in 8 loses 0.8 to 2.4. Two trials tell: the first part
# (progress) of fits of so many steps, one with it and one over black.
TRIAL_STEPS, TRIAL_ENDS = 500, 0.2
# There are trials for at most so many photographs, and in fits that may take at least so long [s].
FEW_PHOTOGRAPHS, TRIAL_SECONDS = 16, 15.0
# The fit goes without where photographs that the trials left out are better by more than this [dB].
CLEARLY_BETTER = 0.3
# More fits than this gain nothing measurable.
MOST_FITS = 6
# No further fit is made when the last one raised the PSNR of validation photographs by less [dB].
LEAST_FURTHER_GAIN = 0.05
# A further fit begins only if at least this share of the first one's time, or steps, and of its
# Gaussians is left.
LEAST_SHARE = 0.5


def with_chosen_backdrop(fit: Fit) -> tuple[Fit, str]:
    """A fit that has not begun, or the better of two trials of it, to be run on; and why."""
    few, limit = len(fit.views) <= FEW_PHOTOGRAPHS, fit.options.limit
    long = (fit.options.steps or 0) >= TRIAL_STEPS if limit is None else limit >= TRIAL_SECONDS
    if fit.begin or fit.recorded or not (few and long and validation_rows(len(fit.views))):
        return fit, ""
    options = fit.options.replaced(seconds=None, steps=TRIAL_STEPS)
    trials = [fit.again(0, options, backdrop=backdrop) for backdrop in (True, False)]
    for trial in trials:
        trial.run(until=TRIAL_ENDS)
    if fit.stopped:
        return trials[0], ""
    random, black = (trial.left_out_psnr() for trial in trials)
    over_black = black > random + CLEARLY_BETTER
    chosen, behind = trials[over_black], "black" if over_black else "random colours"
    chosen.options = fit.options
    return chosen, (
        f"{behind} behind the Gaussians (trials with left-out photographs: random {random:.2f} dB, "
        f"black {black:.2f} dB)"
    )


def run_fits(
    first: Fit,
    *,
    clock: Callable[[], float] = time.perf_counter,
    report: Callable[[Fit, float], object] = lambda fit, share: None,
) -> list[Fit]:
    """Run a fit; if it converges before its time or its steps are over, run further ones.

    No more are made when the time, the steps or the Gaussians that the options allow are used up,
    when there are ``MOST_FITS``, or when the last one raised the PSNR of validation photographs by
    less than ``LEAST_FURTHER_GAIN``. A fit that continues an earlier one (``Fit.begin`` above 0) is
    run alone. ``report`` gets the fit at work and the share of the whole time, or steps.

    Returns the fits to average, the first one first: one that lowered that PSNR is left out.
    """
    options, began = first.options, clock() - first.seconds
    timed = options.limit is not None
    # In seconds, or in steps where these are given.
    budget = options.limit if options.limit is not None else float(options.steps or 0)
    made, kept = [first], [first]

    def used() -> float:
        return clock() - began if timed else sum(fit.steps for fit in made)

    def tell(share: float) -> None:
        report(made[-1], min(used() / budget, 1.0) if budget else 1.0)

    first.run(clock=clock, report=tell)
    taken = used()
    while len(made) < MOST_FITS and not (first.begin or first.stopped):
        left = budget - used()
        if left < LEAST_SHARE * taken or left <= 0:
            break
        room = options.most_gaussians - sum(len(fit.population) for fit in kept)
        if room < max(LEAST_SHARE * len(first.population), len(first.start)):
            break
        # The rest is shared evenly by as many fits as fit into it, by time and by Gaussians.
        fits_left = min(round(left / taken), room // max(len(first.population), len(first.start)))
        part = left / max(fits_left, 1)
        length = {"seconds": part} if timed else {"steps": round(part)}
        more = options.replaced(most_gaussians=room, **length)
        fit = first.again(len(made), more)
        made.append(fit)
        fit.run(clock=clock, report=tell)
        gain = _gain(kept, fit)
        # Without validation photographs, a fit that was stopped early would only blur the others.
        if gain > 0 if gain is not None else not fit.stopped:
            kept.append(fit)
        if gain is not None and gain < LEAST_FURTHER_GAIN:
            break
    report(made[-1], 1.0)
    return kept


def _gain(fits: list[Fit], another: Fit) -> float | None:
    """Gain in PSNR of validation photographs by another fit [dB]; None if there are none."""
    if not another.predicted:
        return None
    before = {row: mean_picture([fit.predicted[row] for fit in fits]) for row in another.predicted}
    after = {
        row: mean_picture([*(fit.predicted[row] for fit in fits), shown])
        for row, shown in another.predicted.items()
    }
    return another.psnr_of(after) - another.psnr_of(before)
