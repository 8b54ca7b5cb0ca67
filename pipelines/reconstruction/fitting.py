"""Fit of Gaussians to a run's context, before its memory is built.

It gives photographs their depth and colours, and is used only where it predicts photographs that it
left out no worse than the memory does.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance, Blend, Picture, best_blend, mean_picture
from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.fit import (
    CONTINUED,
    LEAST_SHARE,
    MOST_FITS,
    Fit,
    run_fits,
    validation_rows,
    with_chosen_backdrop,
)
from gvtools.appearance.fit_options import FitOptions, converged_steps
from gvtools.appearance.splat.gsplat_splatter import GsplatSplat, splatter_on
from gvtools.depth.choice import is_estimated
from gvtools.depth.shown import FittedDepth
from gvtools.depth.source import MixedDepth, RecordedDepth, is_recorded
from gvtools.errors import DegenerateError, GvError, MemoryFileError, OptionError
from gvtools.memory.projection import project
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.poses.refinement import FitView
from gvtools.prefetch import prefetch
from gvtools.runs.poses import RunPoses
from gvtools.scenes.images import resize_nearest
from gvtools.scenes.resized import reduced
from gvtools.scenes.scene import Frame, View
from gvtools.splat_files import holds_splats
from gvtools.untrusted import load_arrays
from pipelines.reconstruction.fit_start import (
    GIVEN,
    SWEPT_SIDE,
    Sweep,
    first_gaussians,
    given_start,
    known_surface,
)
from pipelines.reconstruction.voxel import grid_frame

if TYPE_CHECKING:
    from gvtools.memory.store.local_frame import LocalFrame
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan

# After a fit photographs enter the memory at least so large. Where validation photographs can tell
# how much of the memory's detail the pictures take, they are as large as MEMORY_SHARE of the fit's
# time allows, at most all of them together MOST_MEGAPIXELS; a megapixel takes MEGAPIXEL_SECONDS of
# one core. After 40 s lego gains 0.9 dB by it, the fox 1.3, others 0.1 to 1.1.
MEMORY_SHARE, MOST_MEGAPIXELS, MEGAPIXEL_SECONDS = 0.15, 20.0, 2.0
# A fit is left out where the memory is better by more than MARGIN [dB], three times that from LONG
# steps on: benchmarks/README.md, "Short fits".
MARGIN, LONG = 0.75, 300
# Progress is printed at this interval [s].
SAY_EVERY = 5.0
# Least tolerance of the blend with recorded depth. In targets far from all views Gaussians are
# smeared and the memory is right; validation photographs are too near to other views to show it.
WITH_DEPTH = 0.4
# Without, after SEEN steps a photograph, validation photographs gain about twice as much by the
# memory's colours as held-out ones: the Gaussians that give the memory its depth have seen them by
# then. The greatest share and tolerance. Before, held-out ones gain as they tell, up to 4 dB.
SEEN, MOST_SHARE, MOST_TOLERANCE = 15, 0.5, 0.2
# Where exposures differ by more [log, standard deviation], the memory's colours are patchy.
EVEN = 0.05
# Where no validation tells, and depth is not all recorded, a fit that its clock ends after fewer
# steps for each photograph, and fewer than ENOUGH in all, is not used. With 50, 100 and 600 steps,
# 44 photographs have 18.8, 21.1 and 29.1 dB in held-out pictures, and 27.3 without a fit; 175 of a
# room have 32.1 dB with 409 steps, and 29.8 without.
SHORT, ENOUGH = 7.5, 400
# A fit whose validation photographs stopped gaining makes this share of its steps or more.
SKIPPED = 0.9


def fit_views(
    plan: Plan, frame: LocalFrame, console: Console, *, sweep: Sweep | None = None
) -> list[FitView]:
    """The context's photographs, with recorded or estimated depth; poses in ``frame``."""
    views = [plan.scene[name] for name in plan.context]
    poses = frame.cam_from_local(plan.scene.subset(plan.context).cameras.cam_from_world)
    frames = prefetch(lambda view: view.load(), views)
    return [
        FitView(
            loaded.rgb, view.camera.K[0], pose, loaded.mask,
            loaded.depth if is_recorded(plan.source, view) else None,
            _estimate(plan, view, loaded, sweep=sweep, console=console),
        )
        for view, pose, loaded in zip(views, poses, frames, strict=True)
    ]  # fmt: skip


def _estimate(
    plan: Plan, view: View, frame: Frame, *, sweep: Sweep | None, console: Console
) -> NDArray[np.float32] | None:
    """(H, W) estimated depth, scene units: by a network if that is the run's source, or a sweep."""
    if is_estimated(plan.source, view):
        try:
            return plan.source.depth(plan.scene, view, frame).depth
        except DegenerateError as error:
            console.warn(f"{view.name} is fitted without an estimate of its depth: {error}")
            return None
    if sweep is None or not sweep.covers(view):
        return None
    depth = sweep.depth(view)
    return None if depth is None else resize_nearest(depth, *frame.rgb.shape[1::-1])


@dataclass(frozen=True)
class FitValidation:
    """PSNR of the validation photographs where a memory made without them covers them.

    The Gaussians' pictures are compared at full size, so that blur counts; the memory at the size
    of its sweep, since a run without a fit sweeps larger pictures, of which it shows as much.
    Elsewhere, mostly at borders, both guess, and differ by 2 dB from fit to fit.
    """

    gaussians: float  # of the Gaussians' pictures [dB]
    memory: float  # of the memory's own colours [dB]
    steps: int  # of the fit

    @property
    def fit_is_used(self) -> bool:
        """Whether the memory is not clearly better."""
        return self.memory <= self.gaussians + MARGIN * (3 if self.steps >= LONG else 1)

    def __str__(self) -> str:
        fit, own = f"{self.gaussians:.2f} dB", f"{self.memory:.2f} dB"
        if self.fit_is_used:
            return f"Gaussians (validation photographs: {fit}, the memory's own colours {own})"
        return f"the memory's own (validation photographs: {own}, Gaussians {fit})"


def validate_fit(fitted: Fitted, plan: Plan) -> FitValidation | None:
    """Predict the validation photographs both ways.

    None without such photographs or a sweep, or where that memory shows nothing of them.
    """
    predicted, sweep = fitted.predicted, fitted.sweep
    if not predicted or sweep is None:
        return None
    assert plan.config.voxel is not None
    scene, place = sweep.scene, grid_frame(plan.scene, plan.context)
    size = float(np.mean([plan.scene[n].camera.K[0, 0, 0] for n in predicted]))
    factor = size / float(np.mean([scene[n].camera.K[0, 0, 0] for n in predicted]))
    memory = SpatialMemory(
        plan.config.voxel * factor, origin=place.origin, axes=place.axes, options=plan.config.memory
    )
    for name in plan.context:
        view = scene[name]
        if name in predicted or not sweep.covers(view):
            continue
        found = sweep.map_of(view)
        if found is None:
            continue
        frame = view.load()
        memory.observe(
            frame.rgb, found.depth, view.camera, round=0, mask=frame.mask,
            confidence=found.confidence, options=plan.config.back_projection,
        )  # fmt: skip
    squares, pixels = np.zeros(2), np.zeros(2)
    for name, picture in predicted.items():
        view, photograph = scene[name], plan.scene[name].load()
        guidance = project(memory, view.camera, options=plan.config.splat)
        known = guidance.valid[0]
        whole = resize_nearest(known, *photograph.rgb.shape[1::-1])
        both = (picture.rgb, photograph, whole), (guidance.rgb[0], view.load(), known)
        for row, (rgb, frame, where) in enumerate(both):
            where = where if frame.mask is None else where & frame.mask
            off = rgb[where] - frame.rgb[where] / np.float32(255)
            squares[row] += float(np.square(off).sum()) / 3
            pixels[row] += where.sum()
    memory.close()
    if not pixels.all():
        return None
    gaussians, own = -10 * np.log10(np.maximum(squares / pixels, 1e-10))
    return FitValidation(float(gaussians), float(own), fitted.steps)


@dataclass(frozen=True, eq=False)
class Fitted:
    """The results of fitting that a run uses."""

    appearance: Appearance  # the fitted Gaussians
    # Refined poses of context and targets; None where they are as given.
    poses: RunPoses | None = None
    spread: bool = False  # whether targets take the pose corrections of the context views near them
    # Pictures of validation photographs as rendered before these joined, by view; not kept in
    # files.
    predicted: Mapping[str, Picture] = field(default_factory=dict)
    steps: int = 0  # of the first fit, including those of an earlier fit that it continued
    sweep: Sweep | None = None  # depth that the fit was held to; not kept in files
    # How it compares to the memory's own colours; not kept in files.
    validation: FitValidation | None = None
    side: int = SWEPT_SIDE  # longer side of the photographs that enter the memory [px]

    def save(self, path: Path) -> None:
        """Write it, without what is not kept, into one file."""
        arrays = {**self.appearance.arrays(), "spread": self.spread, "steps": self.steps}
        arrays["side"] = self.side
        if self.poses is not None:
            arrays |= self.poses.arrays
        with path.open("wb") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> Fitted:
        """Read what ``save`` wrote."""
        appearance = Appearance.load(path)
        data = load_arrays(path)
        spread, steps = data.get("spread", False), data.get("steps", 0)
        try:
            side = int(data.get("side", SWEPT_SIDE))  # earlier versions knew one
            return cls(appearance, RunPoses.load(path), bool(spread), steps=int(steps), side=side)
        except (TypeError, ValueError, OverflowError) as error:
            raise MemoryFileError(f"{path}: no readable fit ({error})") from None

    def on(self, device: str) -> Fitted:
        """The same, drawn on a device, "cpu" or "cuda"."""
        return replace(self, appearance=replace(self.appearance, splatter=splatter_on(device)))

    def apply(self, plan: Plan) -> Plan:
        """The plan with refined poses, and the Gaussians' depth where views have none.

        A source of depth that the user named is kept.
        """
        if self.poses is not None:
            plan = plan.at(self.poses)
        scene, source = plan.scene, plan.source
        if isinstance(source, RecordedDepth) or plan.config.depth != "auto":
            return plan
        fitted = FittedDepth(self.appearance, self.sweep)
        some = any(is_recorded(source, scene[name]) for name in plan.context)
        evidence = scene if some else reduced(scene, self.side)
        cameras = [each.subset(plan.context).cameras for each in (scene, evidence)]
        sides = [np.maximum(each.width, each.height) for each in cameras]
        factor = float(np.median(np.divide(*sides)))
        assert plan.config.voxel is not None
        return replace(
            plan,
            source=MixedDepth(RecordedDepth(plan.context), fitted) if some else fitted,
            evidence=evidence,
            config=plan.config.replaced(voxel=plan.config.voxel * factor),
        )

    def with_best_blend(self, plan: Plan, memory: SpatialMemory) -> Fitted:
        """The same with the blend that predicts the validation photographs best.

        Without recorded depth, photographs of uneven exposure keep the Gaussians' colours.
        """
        if not self.predicted:
            return self
        samples = self._samples(plan, memory)
        exposures = self.appearance.exposures
        if _recorded(plan):
            blend = best_blend(samples, tolerances=(WITH_DEPTH, np.inf))
        elif exposures is not None and exposures.log_gains.std() > EVEN:
            return self
        elif self.steps >= SEEN * len(plan.context):
            blend = best_blend(samples, most_share=MOST_SHARE, tolerances=(0.0, MOST_TOLERANCE))
        else:
            blend = best_blend(samples)
        if blend is None:
            return self
        return replace(self, appearance=replace(self.appearance, blend=blend))

    def _samples(
        self, plan: Plan, memory: SpatialMemory
    ) -> Iterator[tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_], NDArray[Any]]]:
        for name, picture in self.predicted.items():
            view = plan.scene[name]
            frame = view.load()
            options = plan.config.splat
            shown = project(memory, view.camera, options=options, without=name)
            where = shown.valid[0] & ~shown.scanned[0] & ~shown.generated[0] & picture.solid
            if frame.mask is not None:
                where &= frame.mask
            yield picture.rgb, shown.rgb[0], where, frame.rgb / np.float32(255)


def fit_appearance(plan: Plan, console: Console, *, earlier: Fitted | None = None) -> Fitted | None:
    """Fit Gaussians to a run's context; None if that is impossible, with a warning that says why.

    Of ``earlier`` fits the first is continued, or further ones are added if it converged.
    """
    began = time.perf_counter()
    if earlier is not None and earlier.poses is not None:
        plan = plan.at(earlier.poses)
    sweep = Sweep.of(plan, begins=earlier is None)
    # Of an earlier fit that has converged, further steps would gain less than another fit.
    needed = converged_steps(len(plan.context), recorded=_recorded(plan))
    if earlier is None or earlier.steps >= SKIPPED * needed:
        fit = _new_fit(plan, console, earlier, sweep=sweep)
    else:
        fit = _continued_fit(plan, earlier, console, sweep=sweep)
    if fit is None:
        return None
    with _stopped_by_ctrl_c(fit, console):
        fit, why = (fit, "") if earlier is not None else with_chosen_backdrop(fit)
        if why:
            console.line(f"fitting: {why}")
        limit = fit.options.limit
        side, seconds = _memory_side(plan, fit, earlier)
        if limit is not None:
            left = max(limit - (time.perf_counter() - began) - seconds, limit / 2)
            fit.options = fit.options.replaced(seconds=left + fit.seconds)
        if fit.splatter is GsplatSplat:
            console.line("fitting: on the CUDA device, by gsplat")
        # Splats that are given may be better than what there is time for.
        given = fit.shown_psnr() if fit.begin and earlier is None else -np.inf
        exposures = fit.cameras.log_gains.copy()
        fits: Sequence[Fit] = run_fits(fit, report=_progress(console))
    if np.isfinite(given) and (found := fit.shown_psnr()) < given:
        console.line(
            f"fitting: the given Gaussians are kept: {given:.2f} dB in photographs, {found:.2f} "
            "after the fit; give more time by --refine"
        )
        fit.population.values, fit.cameras.log_gains[:] = fit.start.values, exposures
        fit.cameras.give_back()
    if fit.cameras.with_poses:
        console.line(f"fitting: {fit.cameras.summary()}")
    if len(fits) > 1:
        console.line(f"fitting: the mean of {len(fits)} fits")
    if earlier is not None and not fit.begin:
        fits = _worth_adding(fits, earlier)
    fitted = replace(_fitted(fits, plan, earlier), sweep=sweep, side=side)
    return fitted if earlier is not None else _judged(fitted, plan, console)


def _judged(fitted: Fitted, plan: Plan, console: Console) -> Fitted | None:
    """A first fit, with what validation tells; None where it is not used, with a warning."""
    validation = validate_fit(fitted, plan)
    if validation is not None:
        console.line(f"colours: {validation}")
        if not validation.fit_is_used:
            console.warn("the fit is not used: give it more time by --refine")
            return None
        fitted = replace(fitted, validation=validation)
    enough = min(round(SHORT * len(plan.context)), ENOUGH)
    # Recorded depth keeps surfaces.
    better = validation is not None and validation.gaussians > validation.memory
    if not (_recorded(plan) or better) and fitted.steps < enough:
        few = (
            f"{fitted.steps} steps of a fit to {len(plan.context)} photographs; expected at least "
            f"{enough}"
        )
        asked = plan.config.refine
        begun = asked.init is not None and holds_splats(Path(asked.init))
        if validation is None and not begun and fitted.steps != asked.steps:
            console.warn(f"the fit is not used: {few}; give it more time by --refine")
            return None
        console.warn(
            f"{few}; pictures may be worse than without a fit; give more --refine seconds, or "
            "--refine 0 for none"
        )
    return fitted


def _memory_side(plan: Plan, fit: Fit, earlier: Fitted | None) -> tuple[int, float]:
    """Longer side of photographs in the memory [px], and what it takes beyond SWEPT_SIDE [s]."""
    cameras, limit = plan.scene.subset(plan.context).cameras, plan.config.refine.limit
    if earlier is not None:
        return earlier.side, 0.0
    own = any(is_recorded(plan.source, plan.scene[name]) for name in plan.context)
    judged = not fit.begin and validation_rows(len(plan.context))
    if own or plan.config.depth != "auto" or not judged:
        return SWEPT_SIDE, 0.0
    each, most = MEGAPIXEL_SECONDS / get_num_threads(), MOST_MEGAPIXELS
    if limit is not None:
        most = min(most, MEMORY_SHARE * limit / each)
    longest = max(cameras.width.max(), cameras.height.max())
    pixels = 1e-6 * float((cameras.width * cameras.height).sum())
    least = min(SWEPT_SIDE / longest, 1.0)
    scale = min(max((most / pixels) ** 0.5, least), 1.0)
    return max(round(scale * longest), 1), each * pixels * (scale**2 - least**2)


def _worth_adding(fits: Sequence[Fit], earlier: Fitted) -> Sequence[Fit]:
    """The new fits that are long enough to be averaged with earlier ones."""
    least = round(LEAST_SHARE * fits[0].converged_after)
    long = [fit for fit in fits if fit.steps >= least]
    if not long:
        raise OptionError(
            f"{fits[0].steps} steps of another fit; expected {least}, since this run's fit has "
            "converged; give more --seconds or --steps; the run is as it was"
        )
    return long[: MOST_FITS - len(earlier.appearance.fits)]


def _new_fit(
    plan: Plan, console: Console, earlier: Fitted | None, *, sweep: Sweep | None
) -> Fit | None:
    """A new fit; after an earlier one, at its poses and with another random seed."""
    if plan.scene.subset(plan.context).cameras.K[:, 0, 1].any():
        console.warn("no Gaussians are fitted: cameras with skew; undistort the photographs first")
        return None
    frame = grid_frame(plan.scene, plan.context)
    options, seed = _options(plan), plan.config.seed
    if earlier is not None:
        if len(earlier.appearance.fits) >= MOST_FITS:
            raise OptionError(
                f"{MOST_FITS} fits that have converged; expected fewer, since more gain nothing; "
                "the run is as it was"
            )
        frame = earlier.appearance.gaussians.frame
        options, seed = options.replaced(poses=False), seed + len(earlier.appearance.fits)
    views = fit_views(plan, frame, console, sweep=sweep)
    given = None if earlier is not None else given_start(plan, frame, console)
    try:
        start = first_gaussians(plan, views, frame)
    except GvError as error:
        if given is None:
            console.warn(f"no Gaussians are fitted: {error}")
            return None
        start = given.gaussians
    surface = known_surface(start, views) if earlier is None else earlier.appearance.surface
    if given is not None:
        start = given.gaussians
    fit = Fit(
        start, views, options=options, seed=seed, surface=surface,
        begin=GIVEN if given is not None and given.fitted else 0.0,
        splatter=splatter_on(plan.config.device),
    )  # fmt: skip
    if given is not None and given.fitted:
        fit.compare_exposures()
    return fit


def _options(plan: Plan) -> FitOptions:
    """The fit's options; poses that features determined are not refined again."""
    by_features = plan.poses is not None and plan.poses.by_features
    options = plan.config.refine
    return options.replaced(poses=options.poses and not by_features)


def _continued_fit(plan: Plan, earlier: Fitted, console: Console, *, sweep: Sweep | None) -> Fit:
    start = earlier.appearance.gaussians
    views, seed = fit_views(plan, start.frame, console, sweep=sweep), plan.config.seed
    fit = Fit(
        start, views, options=_options(plan), seed=seed, begin=CONTINUED,
        surface=earlier.appearance.surface, splatter=splatter_on(plan.config.device),
    )  # fmt: skip
    fit.cameras.spread = earlier.spread
    if earlier.appearance.exposures is not None:
        fit.cameras.log_gains[:] = earlier.appearance.exposures.log_gains
    return fit


def _recorded(plan: Plan) -> bool:
    """Whether the run takes recorded depth for all of its context."""
    return all(is_recorded(plan.source, plan.scene[name]) for name in plan.context)


@contextmanager
def _stopped_by_ctrl_c(fit: Fit, console: Console) -> Iterator[None]:
    """Ctrl-C ends the fit and keeps what is fitted; the second time it ends the run, as ever."""
    before = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if console.quiet or not main or before is not signal.default_int_handler:
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        fit.stop()
        signal.signal(signal.SIGINT, before)
        console.line("fitting: ended by Ctrl-C; the run goes on with it; again to end the run")

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _progress(console: Console) -> Callable[[Fit, float], None]:
    """Prints progress now and then."""
    began, told, steps = time.perf_counter(), 0.0, -1

    def say(fit: Fit, share: float) -> None:
        nonlocal told, steps
        now = time.perf_counter() - began
        if fit.steps != steps and (now - told >= SAY_EVERY or share >= 1):
            told, steps = now, fit.steps
            psnr = fit.validation_psnr()
            left_out = "" if psnr is None else f", left-out photographs {psnr:.2f} dB"
            console.line(
                f"fitting: {share:.0%}, {now:.0f} s, step {fit.steps}, "
                f"{len(fit.population):,} Gaussians, {fit.psnr:.2f} dB{left_out}"
            )

    return say


def _fitted(fits: Sequence[Fit], plan: Plan, earlier: Fitted | None) -> Fitted:
    """The results of fits that have ended, joined with those of an earlier one."""
    first = fits[0]
    cameras, frame = first.cameras, first.frame
    sets, steps = [fit.gaussians for fit in fits], first.steps
    if earlier is not None:
        if first.begin:
            sets, steps = [*sets, *earlier.appearance.others], steps + earlier.steps
        else:
            sets, steps = [*earlier.appearance.fits, *sets], earlier.steps
    # Until validation photographs choose one; Gaussians alone without recorded depth.
    blend = Blend() if _recorded(plan) else Blend(share=0.0)
    if earlier is not None:
        blend = earlier.appearance.blend
        if first.begin and not _recorded(plan) and steps >= SEEN * len(plan.context):
            blend = Blend(min(blend.share, MOST_SHARE), min(blend.tolerance, MOST_TOLERANCE))
    log_gains = cameras.log_gains - cameras.log_gains.mean(axis=0)
    exposures = Exposures(cameras.poses(), log_gains, cameras.depth)
    fitted = Fitted(
        Appearance(
            sets[0],
            first.near,
            blend,
            first.splatter,
            tuple(sets[1:]),
            exposures,
            first.surface,
            first.undimmed if earlier is None else earlier.appearance.backdrop,
        ),
        predicted={
            plan.context[row]: mean_picture([fit.predicted[row] for fit in fits])
            for row in first.predicted
        },
        steps=steps,
    )
    if not cameras.with_poses:
        if earlier is None:
            return fitted
        return replace(fitted, poses=earlier.poses, spread=earlier.spread)
    given = frame.cam_from_local(plan.targets.cameras.cam_from_world)
    targets = np.array([cameras.corrected(pose) for pose in given]).reshape(-1, 4, 4)
    poses = RunPoses(
        frame.cam_from_world(cameras.poses()),
        frame.cam_from_world(targets),
        depth=cameras.depth if cameras.spread else 0.0,
    )
    return replace(fitted, poses=poses, spread=cameras.spread)
