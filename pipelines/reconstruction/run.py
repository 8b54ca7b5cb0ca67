"""Runs: prepare, fit, fuse and complete round by round, and what is left of them in a folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from gvtools.depth.stereo.plane_sweep import KERNELS as SWEEP_KERNELS
from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.images import FIGURES, view_figures
from gvtools.evaluation.statistics import mean_known
from gvtools.files import folder_replaced_when_written, only_in, recover_folder, write_json
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.spatial_memory import SpatialMemory, TiledMemory
from gvtools.prefetch import prefetch
from gvtools.runs.context_depth import DepthCache
from gvtools.runs.folder import RunDirectory, changed_keys, folder_lock
from gvtools.runs.layout import (
    APPEARANCE,
    MEMORY,
    METRICS,
    POINTS,
    POSES,
    REPORT,
    TILES_AT_WORK,
    round_folder,
    saved_memory,
)
from gvtools.runs.run import Run, load_run
from gvtools.runs.target_files import TargetFiles, read_target
from gvtools.scenes.layout import is_address
from gvtools.scenes.project import open_recorded
from gvtools.settings import dotted, with_values
from gvtools.untrusted import read_json
from pipelines.console import Console
from pipelines.reconstruction.fitting import Fitted, fit_appearance
from pipelines.reconstruction.plan import Plan, describe, run_identity
from pipelines.reconstruction.prepare import make_plan, placed_scan, tuned
from pipelines.reconstruction.rounds import RoundTargets, complete_round, fuse_context, load_context
from pipelines.reconstruction.settings import RunSettings
from pipelines.reconstruction.voxel import grid_frame

if TYPE_CHECKING:
    from gvtools.completers.base import ContextView
    from gvtools.kernels import KernelSet
    from gvtools.scenes.scene import Frame, Scene, View


# Figures of the table that closes a run.
TABLE = ("psnr", "psnr_valid", "psnr_generated", "ssim", "depth_rel_valid", "depth_rel_generated")
# Below this coverage a run warns.
HARDLY_KNOWN = 0.1
NO_LPIPS = "lpips is null here: gvtools evaluate measures it, where its weights are"
# In run.json: what each call was given, the first one first.
REFINED = "refined"
# Draws what a finished run shows, given its plan and its folder; returns the names of the files.
Draw = Callable[[Plan, RunDirectory], Sequence[str]]


def compile_kernels(
    config: RunSettings, console: Console, *, more: Sequence[KernelSet] = ()
) -> None:
    """Compile what numba's cache lacks, side by side, so that no round is charged with it."""
    from gvtools import kernels as compiler
    from gvtools.completers.base import completer_type
    from gvtools.depth import source as depth_source
    from gvtools.memory import spatial_memory as memory

    completer = completer_type(config.completer)
    sets = [memory.KERNELS, depth_source.KERNELS, *completer.kernels, *more]
    if completer.costly and config.effort.inpaint_below > 0:
        sets += completer_type("inpaint").kernels
    if config.refine.wanted:
        from gvtools.appearance.compile_kernels import kernel_sets

        sets += kernel_sets()
    missing = [kernels for kernels in sets if not kernels.cached]
    often = "once per installation"
    if compiler.cached_here_alone:
        often = (
            "for this command alone: neither the installation nor the home folder can be written; "
            "set NUMBA_CACHE_DIR to a folder that can"
        )
    began = perf_counter()
    if missing:
        names = ", ".join(kernels.name for kernels in missing)
        console.line(f"compiling kernels ({names}), {often}")
        compiler.compile_side_by_side(missing)
    memory.compile_kernels(config.splat.backend)
    if missing:
        console.line(f"kernels compiled in {perf_counter() - began:.0f} s")


def measure_run(
    plan: Plan, memory: SpatialMemory, directory: RunDirectory, *, console: Console
) -> dict[str, Any]:
    """Means over the targets that have a truth, and the figures of each view.

    All figures are of the completed picture: ``_valid`` on the pixels that observations support,
    ``_generated`` on all others that it fills, by a completer's hand in this round or an earlier
    one. ``coverage`` is the share that memory supports before the round, ``coverage_after`` after
    it.
    """
    views = _figures_of_targets(plan, directory)
    notes = [NO_LPIPS]
    if not any("psnr" in view for view in views):
        notes.append("no target has a true picture, so there are no image figures")
    means = (*FIGURES, "coverage", "coverage_after")
    summary: dict[str, Any] = {
        **{name: mean_known([view.get(name) for view in views]) for name in means},
        "targets": len(views),
        "observations": len(memory),
        "voxels": memory.voxels,
        "views": views,
        "notes": notes,
    }
    if views:
        keys = ["name", "round", "coverage", "coverage_after", *TABLE]
        body = [[view.get(key) for key in keys] for view in views]
        mean = ["mean", None, *(summary[key] for key in keys[2:])]
        console.table(["target", "round", "coverage", "after", *TABLE], [*body, mean])
        if summary["coverage"] < HARDLY_KNOWN:
            console.warn(
                f"before its round the memory knows {summary['coverage']:.1%} of a target's pixels "
                "on average: nearly all of it is the completer's; are targets where photographs "
                "look? 'gvtools check' tells whether pictures, poses and depth contradict each "
                "other"
            )
    return summary


def _figures_of_targets(plan: Plan, directory: RunDirectory) -> list[dict[str, Any]]:
    """Name, round, coverage and, where there is a true picture, figures of each target."""
    views: list[dict[str, Any]] = []
    reports = directory.reports()
    # Reports stand in the order of the rows, one entry a target.
    shown = [
        (number, entry, plan.targets.truth[row])
        for number, rows in enumerate(plan.schedule, start=1)
        for row, entry in zip(
            rows, reports[number]["views"] if number < len(reports) else [], strict=False
        )
    ]

    def read(item: tuple[int, dict[str, Any], View | None]) -> tuple[TargetFiles, Frame] | None:
        number, entry, truth = item
        if truth is None:
            return None
        return read_target(directory.round_path(number), entry), truth.load()

    for (number, entry, _), files in zip(shown, prefetch(read, shown), strict=True):
        figures = {key: entry[key] for key in ("name", "coverage", "coverage_after")}
        figures["round"] = number
        if files is not None:
            target, truth = files
            figures |= view_figures(
                target.picture,
                truth,
                observed=target.observed,
                generated=target.generated,
                depth=target.depth,
            )
        views.append(figures)
    return views


def reconstruct(
    scene: Scene,
    config: RunSettings,
    out: Path,
    *,
    console: Console,
    resume: bool = False,
    dry_run: bool = False,
    reading: Mapping[str, Any] | None = None,
    draw: Draw | None = None,
) -> Path:
    """Fuse the context, then project, complete and fuse the targets round by round.

    Args:
        resume: continue after the last complete round.
        dry_run: say what would be done, and write nothing.
        reading: how the user said the project is to be read, JSON-ready; part of what a resumed
            run must share with its beginning.

    Returns:
        The run's folder.
    """
    directory = RunDirectory(out)
    directory.refuse_foreign()
    swept = () if any(view.has_depth for view in scene) else (SWEEP_KERNELS,)
    compile_kernels(config, console, more=swept)
    begun = directory.round_path(0) if resume and directory.reports() else None
    plan = make_plan(scene, config, say=console.line, round_0=begun)
    describe(plan, console)
    identity = run_identity(plan, reading or {})
    if dry_run:
        exists = directory.check(identity, resume=resume)
        state = "the run in it was left as it is" if exists else "no run was started in it"
        console.line(f"dry run: {out}: {state}")
        return out
    directory.check(identity, resume=resume)
    plan = plan.posed
    if begun is None:
        # Before the folder is made: a scan that is refused leaves none.
        plan = replace(plan, scan=placed_scan(plan, console))
    with directory.open_or_resume(identity, resume=resume) as done:
        if done:
            fitted = saved_fit(plan, directory)
        else:
            fitted = fit_appearance(plan, console) if plan.config.refine.wanted else None
        drawn = complete_run(plan, directory, done, fitted=fitted, console=console, draw=draw)
        say_results(directory, drawn, console)
    return out


def complete_run(
    plan: Plan,
    directory: RunDirectory,
    done: int = 0,
    *,
    fitted: Fitted | None,
    console: Console,
    draw: Draw | None,
) -> Sequence[str]:
    """The rounds from number ``done`` on, and the end products."""
    if fitted is not None:
        plan = fitted.apply(plan)
    memory = (
        _last_memory(plan, directory, done, console=console)
        if done
        else _empty_memory(plan, directory.path / TILES_AT_WORK)
    )
    context: list[ContextView] | None = None
    with RoundTargets(plan, memory, None if fitted is None else fitted.appearance) as targets:
        for number in range(done, len(plan.schedule) + 1):
            if number and context is None:
                cache = DepthCache(
                    plan.evidence or plan.scene, plan.context, plan.source,
                    folder=directory.round_path(0),
                )  # fmt: skip
                context = load_context(plan, cache)
                if plan.config.tune.wanted:
                    plan = tuned(plan, cache, directory, console=console)
            with directory.writing_round(number) as folder:
                if number:
                    report = complete_round(
                        plan, targets, number, context=context or [], folder=folder,
                        console=console,
                    )  # fmt: skip
                else:
                    report = fuse_context(plan, memory, folder, console=console)
                memory.save(folder / MEMORY)
                if plan.poses is not None and number == 0:
                    plan.poses.save(folder / POSES)
                if fitted is not None and number == 0:
                    fitted = fitted.with_best_blend(plan, memory)
                    fitted.save(folder / APPEARANCE)
                    targets.appearance = fitted.appearance
                    report["colours"] = str(fitted.appearance.blend)
                    console.line(f"colours: {report['colours']}")
                write_json(folder / REPORT, report)
            console.line(_round_line(report))
    export_memory_ply(memory, directory.path / POINTS)
    metrics = measure_run(plan, memory, directory, console=console)
    directory.finish(len(plan.schedule), metrics)
    drawn = draw(plan, directory) if draw else ()
    memory.close()
    return drawn


def saved_fit(plan: Plan, directory: RunDirectory) -> Fitted | None:
    """Gaussians that a resumed run's round 0 left; None where there are none."""
    saved = directory.round_path(0) / APPEARANCE
    return Fitted.load(saved).on(plan.config.device) if saved.exists() else None


def _empty_memory(plan: Plan, scratch: Path) -> SpatialMemory:
    assert plan.config.voxel is not None
    frame = grid_frame(plan.scene, plan.context)
    options = plan.config.memory
    place: dict[str, Any] = {"origin": frame.origin, "axes": frame.axes, "options": options}
    if options.budget is None:
        return SpatialMemory(plan.config.voxel, **place)
    return TiledMemory(plan.config.voxel, **place, scratch=scratch)


def _last_memory(
    plan: Plan, directory: RunDirectory, done: int, *, console: Console
) -> SpatialMemory:
    """The memory after the last of ``done`` complete rounds."""
    console.line(f"resuming after round {done - 1}")
    saved, budget = directory.last_memory(done), plan.config.memory.budget
    memory: SpatialMemory
    if budget is None and not saved.is_dir():
        memory = SpatialMemory.load(saved)
    else:
        scratch = directory.path / TILES_AT_WORK
        memory = TiledMemory.load(saved, budget=budget, scratch=scratch)
    # A finished run's memory holds every round, also one whose folder was removed since.
    for later in [number for number in reversed(memory.rounds) if number >= done]:
        memory.forget(round=later)
    return memory


def _round_line(report: dict[str, Any]) -> str:
    text = (
        f"round {report['round']}: {report['points']:,} observations in {report['voxels']:,} "
        f"voxels (+{report['added']:,} added, {report['merged']:,} merged, "
        f"{report['rejected']:,} rejected)"
    )
    if report["coverage_before"] is not None:
        text += f", coverage {report['coverage_before']:.1%} -> {report['coverage_after']:.1%}"
    return f"{text}, {report['seconds']['total']:.1f} s"


def say_results(directory: RunDirectory, drawn: Sequence[str], console: Console) -> None:
    """Say how the memory of a finished run grew, and where its files are."""
    from gvtools.runs.context_depth import off_scale
    from viz.plots.rounds import growth_text

    reports = directory.reports()
    console.line(growth_text(reports))
    flagged = off_scale(reports[0].get("depth", ()))
    if flagged:
        console.warn(f"{flagged}; figures in {directory.round_path(0) / REPORT}")
    files = ", ".join(
        [saved_memory(directory.path).name, "memory.ply", *drawn, "metrics.json", "round_*/"]
    )
    console.line(f"results in {directory.path}: {files}")


def refine(
    path: Path,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    project: Path | None = None,
    console: Console,
    draw: Draw | None = None,
) -> Path:
    """Fit a run's Gaussians further, and make all of its rounds again with them.

    The new run is written beside the earlier one, which need not be finished, and which it replaces
    when it is complete. ``project`` is where the run's project lies now, if it was moved.
    """
    # A link stays one: what it leads to is replaced.
    place = path.resolve()
    recover_folder(place)
    run = load_run(path, project=project)
    plan, identity = _reopened(run, console)
    asked = {"seconds": seconds} if steps is None else {"steps": steps}
    options = plan.config.refine.replaced(**{"seconds": None, "steps": None, **asked})
    plan = replace(plan, config=plan.config.replaced(refine=options))
    compile_kernels(plan.config, console)
    describe(plan, console)
    saved = round_folder(run.path, 0) / APPEARANCE
    earlier = Fitted.load(saved) if run.rounds and saved.exists() else None
    if earlier is None:
        console.line(f"{run.path}: holds no fitted Gaussians; the fit begins anew")
    with folder_lock(place), folder_replaced_when_written(place) as folder:
        plan = plan.posed
        plan = replace(plan, scan=placed_scan(plan, console))
        fitted = fit_appearance(plan, console, earlier=earlier)
        if fitted is None:
            raise ProjectError(
                f"{path}: no Gaussians can be fitted to its context that show more than the "
                "memory; expected photographs with sparse points or recorded depth, and time for "
                "a fit; the run is as it was"
            )
        directory = RunDirectory(folder)
        history = [*run.record.get(REFINED, []), asked]
        with directory.open_or_resume({**identity, REFINED: history}, resume=False):
            drawn = complete_run(plan, directory, fitted=fitted, console=console, draw=draw)
        before, after = _figures(path), _figures(folder)
        others = only_in(path, folder)
    say_results(RunDirectory(path), drawn, console)
    if before.get("psnr") and after.get("psnr"):
        console.line(f"refined: PSNR {before['psnr']:.2f} -> {after['psnr']:.2f} dB")
    if others:
        console.warn(f"{', '.join(others)} in {path}: kept, of the run before it was refined")
    return path


def _reopened(run: Run, console: Console) -> tuple[Plan, Mapping[str, Any]]:
    """The plan of a run and its identity."""
    record = run.record
    try:
        settings = with_values(RunSettings(), dotted(record["settings"]))
    except OptionError as error:
        raise ProjectError(
            f"{run.path}: settings of another version ({error}); run reconstruct again"
        ) from None
    project, reading = record["project"], record["reading"]
    place = run.project or Path(reading["root"] if is_address(project) else project)
    if not place.exists():
        raise ProjectError(f"{run.path}: its project {place} is gone; say by --project where it is")
    scene = open_recorded(project, reading, moved=run.project)
    begun = round_folder(run.path, 0) if run.rounds else None
    plan = make_plan(scene, settings, say=console.line, round_0=begun)
    identity = run_identity(plan, reading)
    # Those come from the record, with defaults for what later versions added.
    changed = [key for key in changed_keys(identity, record) if key != "settings"]
    if run.project is not None and "project" in changed:
        changed.remove("project")
    if changed:
        raise ProjectError(
            f"{run.path}: its project {scene.root} is not as it was when the run was made "
            f"({', '.join(changed)} differ); expected it unchanged; run reconstruct again"
        )
    return plan, identity


def _figures(path: Path) -> Mapping[str, Any]:
    """The means of a run's metrics.json; none where the run is not finished."""
    try:
        figures = read_json(path / METRICS)
    except (OSError, ValueError):
        return {}
    return figures if isinstance(figures, dict) else {}
