"""gvtools reconstruct: fuse, project, complete, fuse back, round by round."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.commands.help_settings import HelpSettings
from pipelines.console import Console, write_json
from pipelines.reconstruction.plan import Plan, describe, make_plan

if TYPE_CHECKING:
    from gvtools.completers.base import ContextView
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.runs.folder import RunDirectory
    from gvtools.scenes.scene import Scene
    from pipelines.reconstruction.settings import RunSettings

SUMMARY = "grow a memory from a posed project, round by round"
EXAMPLES = (
    "gvtools reconstruct scan/ --context every:2 --targets every:2+1 --out runs/scan",
    "gvtools reconstruct colmap/ --targets orbit:24 --completer inpaint --out runs/orbit",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``reconstruct``."""
    parser.add_argument("project", type=Path, help="COLMAP, posed RGB-D or transforms.json")
    add_run_arguments(parser, out_required=True)
    parser.add_argument(
        "--live", action="store_true", help="open the web viewer and follow the run"
    )


def add_run_arguments(parser: argparse.ArgumentParser, *, out_required: bool) -> None:
    """What ``reconstruct`` and ``demo`` share."""
    from pipelines.commands.scene_arguments import add_scene_arguments

    parser.add_argument("--out", type=Path, required=out_required, help="the run's folder")
    parser.add_argument("--context", metavar="SPEC", help="views that are given (default all)")
    parser.add_argument(
        "--targets",
        metavar="SPEC|FILE",
        help="cameras to complete: a selection, interpolate:N, orbit:N, spiral:N, a trajectory "
        "file or another project (default interpolate:12)",
    )
    parser.add_argument("--views-per-round", type=int, metavar="N", help="at most (default 6)")
    parser.add_argument("--rounds", type=int, metavar="N", help="default: as the targets need")
    parser.add_argument("--depth", metavar="SOURCE", help="auto, sensor, colmap, plane-sweep, da3")
    parser.add_argument(
        "--max-side", metavar="PIXELS", help="reduce larger pictures to it, or none (default 1600)"
    )
    parser.add_argument("--completer", metavar="NAME", help="default inpaint")
    parser.add_argument("--profile", metavar="NAME", help="fast, balanced or accurate")
    parser.add_argument("--voxel", metavar="EDGE", help="auto, or scene units")
    parser.add_argument(
        "--device", metavar="NAME", help="cpu, cuda (the torch back end), or auto: cpu"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="of everything random (default 0)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings as JSON")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="one setting; repeatable"
    )
    parser.add_argument(
        "--help-settings", action=HelpSettings, settings=_settings, help="list all settings"
    )
    parser.add_argument(
        "--allow-overlap", action="store_true", help="let views be context and target"
    )
    parser.add_argument("--resume", action="store_true", help="continue after the last whole round")
    parser.add_argument("--dry-run", action="store_true", help="say what would be done, and stop")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    add_scene_arguments(parser)


def _settings() -> RunSettings:
    from pipelines.reconstruction.settings import RunSettings

    return RunSettings()


def run(args: argparse.Namespace, console: Console) -> None:
    """Run ``gvtools reconstruct``."""
    from pipelines.commands.scene_arguments import open_scene, reading_of
    from pipelines.commands.view import live_viewer

    config = config_from(args)
    watched = args.live and not args.dry_run
    with live_viewer(args.out, console) if watched else nullcontext():
        reconstruct(
            open_scene(args.project, args),
            config,
            args.out,
            console=console,
            resume=args.resume,
            dry_run=args.dry_run,
            reading=reading_of(args),
        )
        copy_figures(args, args.out)


def copy_figures(args: argparse.Namespace, out: Path) -> None:
    """Write a run's metrics.json where ``--json`` wants it."""
    if args.json is not None and not args.dry_run:
        from gvtools.files import write_text

        write_text(args.json, (out / "metrics.json").read_text(encoding="utf-8"))


def config_from(args: argparse.Namespace) -> RunSettings:
    """Defaults, then the profile, then --config, then the options, then --set."""
    from gvtools.settings import with_file, with_profile, with_texts, with_values
    from pipelines.reconstruction.settings import RunSettings

    config = RunSettings()
    if args.config:
        config = with_file(config, args.config, profile=args.profile)
    elif args.profile:
        config = with_profile(config, args.profile)
    names = ("context", "targets", "views_per_round", "rounds", "max_side", "depth", "completer",
             "voxel", "device", "seed")  # fmt: skip
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.allow_overlap:
        given["allow_overlap"] = True
    return with_texts(with_values(config, given), args.set)


def reconstruct(
    scene: Scene,
    config: RunSettings,
    out: Path,
    *,
    console: Console,
    resume: bool = False,
    dry_run: bool = False,
    reading: Mapping[str, Any] | None = None,
    drawn: bool = True,
) -> Path:
    """The main job; returns the run's folder.

    Args:
        scene: the project.
        config: what to compute.
        out: the run's folder.
        console: where progress and figures go.
        resume: continue after the last whole round.
        dry_run: say what would be done, and write nothing.
        reading: how the user said the project is to be read, JSON-ready; part of what a resumed
            run must share with its beginning.
        drawn: False leaves growth.png and report.html out.

    Raises:
        GvError: wrong input or options; nothing of an earlier run is lost.
    """
    plan = make_plan(scene, config, say=console.line)
    describe(plan, console)
    from gvtools.runs.folder import RunDirectory
    from gvtools.runs.identity import run_identity

    directory = RunDirectory(out)
    identity = run_identity(plan, reading or {})
    if dry_run:
        there = directory.check(identity, resume=resume)
        state = "the run in it was left as it is" if there else "no run was started in it"
        console.line(f"dry run: {out}: {state}")
        return out
    with directory.taken_up(identity, resume=resume) as done:
        _run_rounds(plan, directory, done, console, drawn=drawn)
    return out


def _run_rounds(
    plan: Plan, directory: RunDirectory, done: int, console: Console, *, drawn: bool
) -> None:
    """The rounds from number ``done`` on, then the end products."""
    from pipelines.reconstruction.depth_cache import KeptDepth
    from pipelines.reconstruction.round_targets import RoundTargets
    from pipelines.reconstruction.rounds import load_context
    from pipelines.reconstruction.run_round import run_round

    memory = _start_memory(plan)
    if done:
        from gvtools.errors import ProjectError
        from gvtools.memory.spatial_memory import SpatialMemory

        console.line(f"resuming after round {done - 1}")
        saved = directory.round_memory(done - 1)
        last = saved if saved.exists() else directory.path / "memory.npz"
        if not last.exists():
            raise ProjectError(
                f"{directory.path}: the memory after round {done - 1} is gone, as with a later "
                "round's folder that was removed; start again with another --out"
            )
        memory = SpatialMemory.load(last)
        # A finished run's memory holds every round, also one whose folder was removed since.
        for later in [number for number in reversed(memory.rounds) if number >= done]:
            memory.forget(round=later)
    context: list[ContextView] | None = None
    with RoundTargets(plan, memory) as targets:
        for number in range(done, len(plan.schedule) + 1):
            if number and context is None:
                kept = KeptDepth(plan.scene, plan.context, plan.source, directory.round_path(0))
                context = load_context(plan.scene, plan.context, kept)
            with directory.writing_round(number) as folder:
                report = run_round(plan, targets, number, context or [], folder, console)
                memory.save(folder / "memory.npz")
                write_json(folder / "report.json", report)
            console.line(_round_line(report))
    _finish(plan, memory, directory, console, drawn=drawn)


def _start_memory(plan: Plan) -> SpatialMemory:
    from gvtools.memory.spatial_memory import SpatialMemory
    from pipelines.reconstruction.grid_frame import grid_frame

    assert plan.config.voxel is not None
    frame = grid_frame(plan.scene, plan.context)
    return SpatialMemory(
        plan.config.voxel, origin=frame.origin, axes=frame.axes, options=plan.config.memory
    )


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
    plan: Plan, memory: SpatialMemory, directory: RunDirectory, console: Console, *, drawn: bool
) -> None:
    """The run's end products, all derived from the last round's memory."""
    from gvtools.files import replaced_when_written
    from gvtools.memory.io.ply import export_memory_ply
    from pipelines.commands.report import write_report
    from pipelines.reconstruction.depth_cache import off_scale
    from pipelines.reconstruction.measure import measure_run
    from viz.plots.growth import draw_growth, growth_text

    out = directory.path
    last = directory.round_memory(len(plan.schedule))
    if last.exists():
        with replaced_when_written(out / "memory.npz") as temporary:
            shutil.copyfile(last, temporary)
    export_memory_ply(memory, out / "memory.ply")
    reports = directory.reports()
    metrics = measure_run(plan, memory, directory, console)
    write_json(out / "metrics.json", metrics)
    if drawn:
        figure = draw_growth(reports, title=plan.scene.root.name)
        with replaced_when_written(out / "growth.png") as temporary:
            figure.savefig(temporary, format="png", dpi=120)
        write_report(plan, out)
    last.unlink(missing_ok=True)
    console.line(growth_text(reports))
    flagged = off_scale(reports[0].get("depth", ()))
    if flagged:
        console.warn(f"{flagged}; figures in {directory.round_path(0) / 'report.json'}")
    console.line(
        f"results in {out}: memory.npz, memory.ply, report.html, growth.png, metrics.json, round_*/"
    )
