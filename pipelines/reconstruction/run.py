"""A run: plan, rounds of fuse, project and complete, and what is left of them in a folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.files import write_json
from gvtools.runs.folder import RunDirectory
from gvtools.runs.layout import (
    APPEARANCE,
    MEMORY,
    POINTS,
    POSES,
    REPORT,
    TILES_AT_WORK,
    saved_memory,
)
from pipelines.console import Console
from pipelines.reconstruction.compile_kernels import compile_kernels
from pipelines.reconstruction.plan import Plan, describe, make_plan, run_identity
from pipelines.reconstruction.scan import placed_scan

if TYPE_CHECKING:
    from gvtools.completers.base import ContextView
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import Scene
    from pipelines.reconstruction.fitting import Fitted
    from pipelines.reconstruction.settings import RunSettings

# Draws what a finished run shows, given its plan and its folder; returns the names of the files.
Draw = Callable[[Plan, RunDirectory], Sequence[str]]


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
        scene: the project.
        config: what to compute.
        out: the run's folder.
        console: where progress and figures go.
        resume: continue after the last complete round.
        dry_run: say what would be done, and write nothing.
        reading: how the user said the project is to be read, JSON-ready; part of what a resumed
            run must share with its beginning.
        draw: writes pictures and pages of the finished run; None writes none.

    Returns:
        The run's folder.
    """
    compile_kernels(config, console)
    directory = RunDirectory(out)
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
        fitted = _fitted(plan, directory, done, console=console)
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
    """The rounds from number ``done`` on, and the end products.

    Args:
        plan: with the cameras that were fitted to.
        directory: of the run, open.
        done: how many rounds are complete.
        fitted: Gaussians of the run; None leaves the memory's own colours.
        console: where progress and figures go.
        draw: see ``reconstruct``.

    Returns:
        The names of the files that ``draw`` wrote.
    """
    if fitted is not None:
        plan = fitted.applied(plan)
    memory = (
        _last_memory(plan, directory, done, console=console)
        if done
        else _empty_memory(plan, directory.path / TILES_AT_WORK)
    )
    _run_rounds(plan, memory, directory, done=done, fitted=fitted, console=console)
    drawn = _finish(plan, memory, directory, console=console, draw=draw)
    memory.close()
    return drawn


def _fitted(plan: Plan, directory: RunDirectory, done: int, *, console: Console) -> Fitted | None:
    """Gaussians fitted now or by the attempt that is resumed; None where there are none."""
    from pipelines.reconstruction.fitting import fit_appearance

    if done:
        return saved_fit(plan, directory)
    return fit_appearance(plan, console) if plan.config.refine.wanted else None


def saved_fit(plan: Plan, directory: RunDirectory) -> Fitted | None:
    """Gaussians that a resumed run's round 0 left; None where there are none.

    None are there where none were wanted or could be fitted; ``gvtools refine`` adds them.
    """
    from pipelines.reconstruction.fitting import Fitted

    saved = directory.round_path(0) / APPEARANCE
    return Fitted.load(saved).on(plan.config.device) if saved.exists() else None


def _empty_memory(plan: Plan, scratch: Path) -> SpatialMemory:
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.memory.tiled_memory import TiledMemory
    from pipelines.reconstruction.voxel_edge import grid_frame

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
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.memory.tiled_memory import TiledMemory

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


def _run_rounds(
    plan: Plan,
    memory: SpatialMemory,
    directory: RunDirectory,
    *,
    done: int,
    fitted: Fitted | None,
    console: Console,
) -> None:
    """The rounds from number ``done`` on."""
    from pipelines.reconstruction.depth_cache import DepthCache
    from pipelines.reconstruction.round_targets import RoundTargets
    from pipelines.reconstruction.rounds import load_context
    from pipelines.reconstruction.run_round import run_round
    from pipelines.reconstruction.tuning import tuned

    context: list[ContextView] | None = None
    with RoundTargets(plan, memory, None if fitted is None else fitted.appearance) as targets:
        for number in range(done, len(plan.schedule) + 1):
            if number and context is None:
                scene = plan.evidence or plan.scene
                cache = DepthCache(scene, plan.context, plan.source, folder=directory.round_path(0))
                context = load_context(scene, plan.context, cache)
                if plan.config.tune.wanted:
                    plan = tuned(plan, cache, directory, console=console)
            with directory.writing_round(number) as folder:
                report = run_round(
                    plan, targets, number, context=context or [], folder=folder, console=console
                )
                memory.save(folder / MEMORY)
                if plan.poses is not None and number == 0:
                    plan.poses.save(folder / POSES)
                if fitted is not None and number == 0:
                    fitted = fitted.with_best_blend(plan, memory)
                    fitted.save(folder / APPEARANCE)
                    targets.appearance = fitted.appearance
                    report["colours"] = str(fitted.validation or fitted.appearance.blend)
                    if fitted.validation is None:
                        console.line(f"colours: {report['colours']}")
                write_json(folder / REPORT, report)
            console.line(_round_line(report))


def _round_line(report: dict[str, Any]) -> str:
    text = (
        f"round {report['round']}: {report['points']:,} observations in {report['voxels']:,} "
        f"voxels (+{report['added']:,} added, {report['merged']:,} merged, "
        f"{report['rejected']:,} rejected)"
    )
    if report["coverage_before"] is not None:
        text += f", coverage {report['coverage_before']:.1%} -> {report['coverage_after']:.1%}"
    return f"{text}, {report['seconds']['total']:.1f} s"


def _finish(
    plan: Plan,
    memory: SpatialMemory,
    directory: RunDirectory,
    *,
    console: Console,
    draw: Draw | None,
) -> Sequence[str]:
    """The run's end products, all derived from the last round's memory; see ``complete_run``."""
    from gvtools.memory.io.ply import export_memory_ply
    from pipelines.reconstruction.measure import measure_run

    export_memory_ply(memory, directory.path / POINTS)
    metrics = measure_run(plan, memory, directory, console=console)
    directory.finish(len(plan.schedule), metrics)
    return draw(plan, directory) if draw else ()


def say_results(directory: RunDirectory, drawn: Sequence[str], console: Console) -> None:
    """Say how the memory of a finished run grew, and where its files are."""
    from gvtools.runs.context_depth import off_scale
    from viz.plots.growth import growth_text

    reports = directory.reports()
    console.line(growth_text(reports))
    flagged = off_scale(reports[0].get("depth", ()))
    if flagged:
        console.warn(f"{flagged}; figures in {directory.round_path(0) / REPORT}")
    files = ", ".join(
        [saved_memory(directory.path).name, "memory.ply", *drawn, "metrics.json", "round_*/"]
    )
    console.line(f"results in {directory.path}: {files}")
