"""Before the first round: Gaussians are fitted to the context's photographs.

The fit comes before the memory, because it refines poses that odometry told further, which the
memory is then built with, and because it gives photographs their depth.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.blending import Blend, best_blend
from gvtools.appearance.exposures import Exposures
from gvtools.appearance.fit import CONTINUED, Fit
from gvtools.appearance.fit_options import FitOptions, converged_steps
from gvtools.appearance.fits import LEAST_SHARE, MOST_FITS, run_fits
from gvtools.appearance.picture import Picture, mean_picture
from gvtools.appearance.splat.gsplat_splatter import GsplatSplat, splatter_on
from gvtools.depth.fitted_depth import FittedDepth
from gvtools.depth.source import MixedDepth, RecordedDepth, is_recorded
from gvtools.errors import GvError, MemoryFileError, OptionError
from gvtools.memory.projection import project
from gvtools.runs.poses import RunPoses
from gvtools.scenes.reduced import reduced
from gvtools.untrusted import load_arrays
from pipelines.reconstruction import poses as run_poses
from pipelines.reconstruction.fit_inputs import (
    SWEPT_SIDE,
    Sweep,
    first_gaussians,
    fit_views,
    known_surface,
)
from pipelines.reconstruction.fit_validation import FitValidation, validate_fit
from pipelines.reconstruction.voxel_edge import grid_frame

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan

# Progress is printed at this interval [s].
SAY_EVERY = 5.0
# Least tolerance of the blend with recorded depth. In targets far from all views Gaussians are
# smeared and the memory is right; validation photographs are too near to other views to show it.
WITH_DEPTH = 0.4
# A warning tells of a fit of fewer steps for each photograph. With 50, 100 and 600 steps, 44
# photographs have 18.8, 21.1 and 29.1 dB in held-out pictures, and 27.3 without a fit.
SHORT = 7.5
# A fit whose validation photographs stopped gaining makes this share of its steps or more.
SKIPPED = 0.9


@dataclass(frozen=True, eq=False)
class Fitted:
    """The results of fitting that a run uses.

    Attributes:
        appearance: the fitted Gaussians.
        poses: refined poses of context and targets; None where they are as given.
        spread: whether targets take the pose corrections of the context views near them.
        predicted: pictures of validation photographs as rendered before these joined, by view.
        steps: of the first fit, including those of an earlier fit that it continued.
        sweep: depth that the fit was held to; not kept in files.
        validation: how it compares to the memory's own colours; not kept in files.
    """

    appearance: Appearance
    poses: RunPoses | None = None
    spread: bool = False
    predicted: Mapping[str, Picture] = field(default_factory=dict)
    steps: int = 0
    sweep: Sweep | None = None
    validation: FitValidation | None = None

    def save(self, path: Path) -> None:
        """Write it, without what is not kept, into one file."""
        arrays = {**self.appearance.arrays(), "spread": self.spread, "steps": self.steps}
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
            return cls(appearance, RunPoses.load(path), bool(spread), steps=int(steps))
        except (TypeError, ValueError, OverflowError) as error:
            raise MemoryFileError(f"{path}: no readable fit ({error})") from None

    def on(self, device: str) -> Fitted:
        """The same, drawn on a device, "cpu" or "cuda"."""
        return replace(self, appearance=replace(self.appearance, splatter=splatter_on(device)))

    def applied(self, plan: Plan) -> Plan:
        """The plan with refined poses, and the Gaussians' depth where views have none.

        A source of depth that the user named is kept.
        """
        if self.poses is not None:
            plan = run_poses.applied(self.poses, plan)
        scene, source = plan.scene, plan.source
        if isinstance(source, RecordedDepth) or plan.config.depth != "auto":
            return plan
        fitted = FittedDepth(self.appearance, self.sweep)
        some = any(is_recorded(source, scene[name]) for name in plan.context)
        evidence = scene if some else reduced(scene, SWEPT_SIDE)
        sizes = (_sizes(each, plan.context) for each in (scene, evidence))
        factor = float(np.median(np.divide(*sizes)))
        assert plan.config.voxel is not None
        return replace(
            plan,
            source=MixedDepth(RecordedDepth(plan.context), fitted) if some else fitted,
            evidence=evidence,
            config=plan.config.replaced(voxel=plan.config.voxel * factor),
        )

    def with_best_blend(self, plan: Plan, memory: SpatialMemory) -> Fitted:
        """The same with the blend that predicts the validation photographs best.

        Without recorded depth only the Gaussians' colours are used: the memory's depth comes from
        the Gaussians, and its detail lowers structural similarity.

        Args:
            plan: after ``applied``.
            memory: of the context.
        """
        if not (_recorded(plan) and self.predicted):
            return self
        blend = best_blend(self._samples(plan, memory), least_tolerance=WITH_DEPTH)
        return replace(self, appearance=replace(self.appearance, blend=blend))

    def _samples(
        self, plan: Plan, memory: SpatialMemory
    ) -> Iterator[tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_], NDArray[Any]]]:
        for name, picture in self.predicted.items():
            view = plan.scene[name]
            frame = view.load()
            options = plan.config.splat
            guidance = project(memory, view.camera, options=options, without=name)
            where = guidance.valid[0] & ~guidance.scanned[0] & picture.solid
            if frame.mask is not None:
                where &= frame.mask
            yield picture.rgb, guidance.rgb[0], where, frame.rgb / np.float32(255)


def fit_appearance(plan: Plan, console: Console, *, earlier: Fitted | None = None) -> Fitted | None:
    """Fit Gaussians to a run's context; None if that is impossible, with a warning that says why.

    Args:
        plan: of the run.
        console: prints progress.
        earlier: fits of this run: the first is continued, or further ones added if it converged.
    """
    began = time.perf_counter()
    plan = _posed(plan, earlier)
    sweep = Sweep.of(plan, begins=earlier is None)
    if earlier is None or _converged(plan, earlier):
        fit = _new_fit(plan, console, earlier, sweep=sweep)
    else:
        fit = _continued_fit(plan, earlier, console, sweep=sweep)
    if fit is None:
        return None
    limit = fit.options.limit
    if limit is not None:
        left = max(limit - (time.perf_counter() - began), limit / 2)
        fit.options = fit.options.replaced(seconds=left)
    if fit.splatter is GsplatSplat:
        console.line("fitting: on the CUDA device, by gsplat")
    fits: Sequence[Fit] = _run(fit, console)
    if earlier is not None and not fit.begin:
        fits = _worth_adding(fits, earlier)
    found = replace(_fitted(fits, plan, earlier), sweep=sweep)
    if earlier is None:
        validation = (
            validate_fit(found.predicted, plan, sweep) if found.predicted and sweep else None
        )
        if validation is not None:
            console.line(f"colours: {validation}")
            if not validation.fit_is_used:
                console.warn("the fit is not used: give it more time by --refine")
                return None
            found = replace(found, validation=validation)
        else:
            _warn_of_few_steps(found, plan, console)
    return found


def _warn_of_few_steps(fitted: Fitted, plan: Plan, console: Console) -> None:
    """Say where a fit to photographs is so short that a run without one shows more.

    Recorded depth keeps surfaces where they are, however short the fit.
    """
    needed = round(SHORT * len(plan.context))
    if not _recorded(plan) and fitted.steps < needed:
        console.warn(
            f"{fitted.steps} steps of a fit to {len(plan.context)} photographs; expected at least "
            f"{needed}; pictures may be worse than without a fit; give more --refine seconds, or "
            "--refine 0 for none"
        )


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
    try:
        start = first_gaussians(plan, views, frame)
    except GvError as error:
        console.warn(f"no Gaussians are fitted: {error}")
        return None
    surface = known_surface(start, views) if earlier is None else earlier.appearance.surface
    return Fit(
        start, views, options=options, seed=seed, surface=surface,
        splatter=splatter_on(plan.config.device),
    )  # fmt: skip


def _options(plan: Plan) -> FitOptions:
    """Options of a fit, which leaves poses that features told."""
    by_features = plan.poses is not None and plan.poses.by_features
    options = plan.config.refine
    return options.replaced(poses=options.poses and not by_features)


def _converged(plan: Plan, earlier: Fitted) -> bool:
    """Whether an earlier fit has converged: further steps would gain less than another fit."""
    needed = converged_steps(len(plan.context), recorded=_recorded(plan))
    return earlier.steps >= SKIPPED * needed


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


def _first_blend(plan: Plan) -> Blend:
    """The blend before validation photographs choose one; Gaussians alone without depth."""
    return Blend() if _recorded(plan) else Blend(share=0.0)


def _posed(plan: Plan, earlier: Fitted | None) -> Plan:
    """The plan with the poses of an earlier fit."""
    if earlier is None or earlier.poses is None:
        return plan
    return run_poses.applied(earlier.poses, plan)


@contextmanager
def _stopped_by_ctrl_c(fit: Fit, console: Console) -> Iterator[None]:
    """Ctrl-C ends the fit and keeps what is fitted; the second time it ends the run, as ever.

    Where nothing can be told of it, or somebody else takes it, it does what it always did.
    """
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


def _run(first: Fit, console: Console) -> list[Fit]:
    """Run a fit and further ones, and print progress."""
    began, told = time.perf_counter(), 0.0

    def say(fit: Fit, share: float) -> None:
        nonlocal told
        now = time.perf_counter() - began
        if now - told >= SAY_EVERY or share >= 1:
            told = now
            psnr = fit.validation_psnr()
            left_out = "" if psnr is None else f", left-out photographs {psnr:.2f} dB"
            console.line(
                f"fitting: {share:.0%}, {now:.0f} s, step {fit.steps}, "
                f"{len(fit.population):,} Gaussians, {fit.psnr:.2f} dB{left_out}"
            )

    with _stopped_by_ctrl_c(first, console):
        fits = run_fits(first, report=say)
    if first.cameras.with_poses:
        console.line(f"fitting: {first.cameras.summary()}")
    if len(fits) > 1:
        console.line(f"fitting: the mean of {len(fits)} fits")
    return fits


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
    blend = _first_blend(plan) if earlier is None else earlier.appearance.blend
    log_gains = cameras.log_gains - cameras.log_gains.mean(axis=0)
    exposures = Exposures(cameras.poses(), log_gains, cameras.depth)
    found = Fitted(
        Appearance(
            sets[0], first.near, blend, first.splatter, tuple(sets[1:]), exposures, first.surface
        ),
        predicted={
            plan.context[row]: mean_picture([fit.predicted[row] for fit in fits])
            for row in first.predicted
        },
        steps=steps,
    )
    if not cameras.with_poses:
        return (
            found if earlier is None else replace(found, poses=earlier.poses, spread=earlier.spread)
        )
    given = frame.cam_from_local(plan.targets.cameras.cam_from_world)
    targets = np.array([cameras.corrected(pose) for pose in given]).reshape(-1, 4, 4)
    poses = RunPoses(frame.cam_from_world(cameras.poses()), frame.cam_from_world(targets))
    return replace(found, poses=poses, spread=cameras.spread)


def _sizes(scene: Scene, names: Sequence[str]) -> NDArray[np.int64]:
    """Longer sides of the pictures."""
    cameras = scene.subset(names).cameras
    return np.maximum(cameras.width, cameras.height)
