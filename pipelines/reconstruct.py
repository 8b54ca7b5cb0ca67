"""gvtools reconstruct: fuse, project, complete, fuse back, round by round."""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.console import Console, write_json

if TYPE_CHECKING:
    from gvtools.completers.base import ContextView
    from gvtools.depth.source import DepthSource
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import Scene
    from pipelines.config import RunConfig
    from pipelines.targets import Targets

SUMMARY = "grow a memory from a posed project, round by round"
EXAMPLES = (
    "gvtools reconstruct scan/ --context every:2 --targets every:2+1 --out runs/scan",
    "gvtools reconstruct colmap/ --targets orbit:24 --completer inpaint --out runs/orbit",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``reconstruct``."""
    parser.add_argument("project", type=Path, help="COLMAP, posed RGB-D or transforms.json")
    add_run_arguments(parser, out_required=True)


def add_run_arguments(parser: argparse.ArgumentParser, *, out_required: bool) -> None:
    """What ``reconstruct`` and ``demo`` share."""
    from pipelines.scene_arguments import add_scene_arguments

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
    parser.add_argument("--depth", metavar="SOURCE", help="auto, sensor or colmap (default auto)")
    parser.add_argument("--completer", metavar="NAME", help="default inpaint")
    parser.add_argument("--profile", metavar="NAME", help="fast, balanced or accurate")
    parser.add_argument("--voxel", metavar="EDGE", help="auto, or scene units")
    parser.add_argument("--device", metavar="NAME", help="auto, cpu or cuda (default auto)")
    parser.add_argument("--seed", type=int, metavar="N", help="of everything random (default 0)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings as JSON")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="one setting; repeatable"
    )
    parser.add_argument(
        "--allow-overlap", action="store_true", help="let views be context and target"
    )
    parser.add_argument("--resume", action="store_true", help="continue after the last whole round")
    parser.add_argument("--dry-run", action="store_true", help="say what would be done, and stop")
    add_scene_arguments(parser)


def run(args: argparse.Namespace, console: Console) -> None:
    """Run ``gvtools reconstruct``."""
    from pipelines.scene_arguments import open_scene

    config = config_from(args)
    reconstruct(
        open_scene(args.project, args),
        config,
        args.out,
        console=console,
        resume=args.resume,
        dry_run=args.dry_run,
    )


def config_from(args: argparse.Namespace) -> RunConfig:
    """Defaults, then --config, then --profile, then the options, then --set."""
    from pipelines import config as settings

    config = settings.RunConfig()
    if args.config:
        config = settings.with_file(config, args.config)
    if args.profile:
        config = settings.with_profile(config, args.profile)
    names = ("context", "targets", "views_per_round", "rounds", "depth", "completer", "voxel",
             "device", "seed")  # fmt: skip
    for name in names:
        value = getattr(args, name)
        if value is not None:
            config = settings.with_setting(config, name, value)
    if args.allow_overlap:
        config = replace(config, allow_overlap=True)
    return settings.with_settings(config, args.set)


@dataclass(frozen=True, eq=False)
class Plan:
    """A run before its first round.

    Attributes:
        scene: the project.
        config: with everything derived filled in.
        context: names of the given views.
        targets: the cameras to complete.
        schedule: per round (from 1) the rows of the targets.
        source: where depth comes from.
    """

    scene: Scene
    config: RunConfig
    context: tuple[str, ...]
    targets: Targets
    schedule: tuple[tuple[int, ...], ...]
    source: DepthSource


def reconstruct(
    scene: Scene,
    config: RunConfig,
    out: Path,
    *,
    console: Console,
    resume: bool = False,
    dry_run: bool = False,
) -> Path:
    """The main job; returns the run's folder.

    Raises:
        GvError: wrong input or options; nothing of an earlier run is lost.
    """
    plan = make_plan(scene, config)
    describe(plan, console)
    if dry_run:
        console.line(f"dry run: nothing was written to {out}")
        return out
    from pipelines.run_directory import RunDirectory, fingerprint

    directory = RunDirectory(out)
    files = [file for name in plan.context for file in scene[name].files]
    files += [file for view in plan.targets.truth if view for file in view.files]
    identity = {
        "project": str(scene.root.resolve()),
        "fingerprint": fingerprint([*files, *plan.targets.files]),
        "cameras": _camera_digest(plan),
        "config": plan.config.to_dict(),
        "context": list(plan.context),
        "targets": list(plan.targets.cameras.names),
        "schedule": [list(rows) for rows in plan.schedule],
    }
    done = directory.start(identity, resume=resume)
    memory = _start_memory(plan)
    if done:
        from gvtools.memory.spatial_memory import SpatialMemory

        console.line(f"resuming after round {done - 1}")
        kept = directory.round_memory(done - 1)
        memory = SpatialMemory.load(kept if kept.exists() else out / "memory.npz")
        # A finished run's memory holds every round, also one whose folder was removed since.
        for later in [number for number in reversed(memory.rounds) if number >= done]:
            memory.forget(round=later)
    context: list[ContextView] | None = None
    for number in range(done, len(plan.schedule) + 1):
        if number and context is None:
            from pipelines.rounds import load_context

            context = load_context(scene, plan.context, plan.source)
        with directory.writing_round(number) as folder:
            report = _round(plan, memory, number, context or [], folder, console)
            memory.save(folder / "memory.npz")
            write_json(folder / "report.json", report)
        console.line(_round_line(report))
    _finish(plan, memory, directory, console)
    return out


def _camera_digest(plan: Plan) -> str:
    """A digest of the intrinsics, poses and sizes of context and targets."""
    import hashlib

    digest = hashlib.sha256()
    for cameras in (plan.scene.subset(plan.context).cameras, plan.targets.cameras):
        for array in (cameras.K, cameras.cam_from_world, cameras.width, cameras.height):
            digest.update(array.tobytes())
    return digest.hexdigest()


def make_plan(scene: Scene, config: RunConfig) -> Plan:
    """Resolve selections, depth source, voxel edge and schedule."""
    from gvtools.completers.base import create
    from gvtools.depth.source import choose_source
    from gvtools.errors import OptionError, ProjectError
    from gvtools.scenes.selection import select
    from pipelines.targets import resolve_targets

    errors = [finding.message for finding in scene.findings if finding.level == "error"]
    if errors:
        raise ProjectError(
            f"{scene.root}: {errors[0]}"
            + (f" (and {len(errors) - 1} more; see 'gvtools check')" if len(errors) > 1 else "")
        )
    if config.views_per_round < 1 or (config.rounds is not None and config.rounds < 0):
        raise OptionError(
            f"views per round {config.views_per_round}, rounds {config.rounds}; expected at least "
            "1 and 0"
        )
    if config.device not in ("auto", "cpu", "cuda"):
        raise OptionError(f"device {config.device!r}; expected auto, cpu or cuda")
    if config.voxel is not None and not 0 < config.voxel < float("inf"):
        raise OptionError(f"voxel edge {config.voxel}; expected auto or a positive length")
    if config.device == "cuda":
        config = replace(config, splat=replace(config.splat, backend="torch", device="cuda"))
    create(config.completer, **config.completer_options)
    context = select(scene.names, config.context)
    targets = resolve_targets(scene, context, config.targets, allow_overlap=config.allow_overlap)
    source = choose_source(scene, context, config.depth)
    if config.voxel is None:
        edge = automatic_voxel(scene, context, source, percentile=config.fusion.voxel_percentile)
        edge *= config.fusion.voxel_scale
        config = replace(config, voxel=float(f"{edge:.3g}"))
    schedule = make_schedule(len(targets.cameras), config.views_per_round, config.rounds)
    config = replace(config, rounds=len(schedule))
    return Plan(scene, config, context, targets, schedule, source)


def make_schedule(
    targets: int, views_per_round: int, rounds: int | None
) -> tuple[tuple[int, ...], ...]:
    """Rows of the targets for each round, in order.

    Without ``rounds``, as many as it takes. With more rounds than full rounds need, the targets
    are spread evenly over them; what does not fit into them stays out, and is reported.
    """
    if rounds is None:
        rounds = -(-targets // views_per_round)
    rounds = min(rounds, targets)
    if not rounds:
        return ()
    used = min(targets, rounds * views_per_round)
    cuts = [i * used // rounds for i in range(rounds + 1)]
    return tuple(tuple(range(a, b)) for a, b in pairwise(cuts))


def automatic_voxel(
    scene: Scene, context: Sequence[str], source: DepthSource, *, percentile: float
) -> float:
    """A percentile of the pixel footprints z / f of the context's depth, scene units."""
    import numpy as np

    names = [name for name in context if scene[name].has_depth]
    footprints = []
    for name in names[:: max(1, len(names) // 8)][:8]:
        view = scene[name]
        depth = source.depth(scene, view, view.load()).depth
        known = depth[depth > 0]
        if known.size:
            focal = float(np.sqrt(view.camera.K[0, 0, 0] * view.camera.K[0, 1, 1]))
            footprints.append(float(np.percentile(known, percentile)) / focal)
    from gvtools.errors import ProjectError

    if not footprints:
        raise ProjectError(f"{scene.root}: the context's depth maps are empty; see 'gvtools check'")
    return float(np.median(footprints))


def describe(plan: Plan, console: Console) -> None:
    """Say what the run reads and will do."""
    config, targets = plan.config, plan.targets
    sizes = sorted(set(zip(targets.cameras.width.tolist(), targets.cameras.height.tolist(),
                           strict=True)))  # fmt: skip
    scheduled = sum(len(rows) for rows in plan.schedule)
    console.line(
        f"{plan.scene.root} ({plan.scene.kind}): {len(plan.scene)} views; context "
        f"{len(plan.context)}, targets {len(targets.cameras)} ({targets.kind}, "
        f"{', '.join(f'{w}x{h}' for w, h in sizes)})"
    )
    console.line(
        f"depth {plan.source.name}, voxel {config.voxel:g}, completer {config.completer}, "
        f"{len(plan.schedule)} rounds of at most {config.views_per_round} targets, seed "
        f"{config.seed}"
    )
    if scheduled < len(targets.cameras):
        console.warn(
            f"{len(targets.cameras) - scheduled} of {len(targets.cameras)} targets are in no "
            "round; raise --rounds or --views-per-round"
        )
    for finding in plan.scene.findings:
        if finding.level == "warning":
            console.warn(finding.message)


def _start_memory(plan: Plan) -> SpatialMemory:
    import numpy as np

    from gvtools.memory.spatial_memory import SpatialMemory

    centers = plan.scene.subset(plan.context).cameras.centers
    # A whole number keeps the world frame's decimals as they are.
    origin = np.rint(centers.mean(axis=0))
    assert plan.config.voxel is not None
    return SpatialMemory(plan.config.voxel, origin=origin, options=plan.config.memory)


def _round(
    plan: Plan,
    memory: SpatialMemory,
    number: int,
    context: list[ContextView],
    folder: Path,
    console: Console,
) -> dict[str, Any]:
    from gvtools.completers.base import create
    from pipelines import rounds
    from pipelines.round_files import target_stems, write_target

    clock = rounds.Clock()
    start = time.perf_counter()
    voxels = memory.voxels
    views: list[dict[str, Any]] = []
    before = after = None
    dropped: dict[str, int] = {}
    if number == 0:
        total, dropped = rounds.observe_context(
            plan.scene, plan.context, source=plan.source, memory=memory, config=plan.config,
            clock=clock, progress=console.track,
        )  # fmt: skip
    else:
        cameras = plan.targets.cameras[list(plan.schedule[number - 1])]
        with clock.stage("project"):
            known = [memory.project(camera, options=plan.config.splat) for camera in cameras]
        before = _mean([guidance.coverage for guidance in known])
        results, total = rounds.complete_targets(
            cameras, number, memory=memory,
            completer=create(plan.config.completer, **plan.config.completer_options),
            context=context, config=plan.config, clock=clock, progress=console.track,
        )  # fmt: skip
        with clock.stage("project"):
            grown = [memory.project(camera, options=plan.config.splat) for camera in cameras]
        after = _mean([guidance.coverage for guidance in grown])
        stems = target_stems(plan.targets.cameras.names)
        rows = plan.schedule[number - 1]
        for row, result, guidance in zip(rows, results, grown, strict=True):
            write_target(folder, stems[row], result, guidance)
            added = {"stem": stems[row], "coverage_after": guidance.coverage}
            views.append({**result.report, **added})
    generated = int(memory.generated.sum())
    return {
        "round": number,
        "points": len(memory),
        "voxels": memory.voxels,
        "voxels_added": memory.voxels - voxels,
        "observed": len(memory) - generated,
        "generated": generated,
        "added": total.added,
        "merged": total.merged,
        "rejected": total.rejected,
        "fuse": asdict(total),
        "dropped": dropped,
        "coverage_before": before,
        "coverage_after": after,
        "seconds": {**clock.seconds, "total": time.perf_counter() - start},
        "bytes": memory.nbytes,
        "views": views,
    }


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _round_line(report: dict[str, Any]) -> str:
    text = (
        f"round {report['round']}: {report['points']:,} observations in {report['voxels']:,} "
        f"voxels (+{report['added']:,} added, {report['merged']:,} merged, "
        f"{report['rejected']:,} rejected)"
    )
    if report["coverage_before"] is not None:
        text += f", coverage {report['coverage_before']:.1%} -> {report['coverage_after']:.1%}"
    return f"{text}, {report['seconds']['total']:.1f} s"


def _finish(plan: Plan, memory: SpatialMemory, directory: Any, console: Console) -> None:
    """The run's end products, all derived from the last round's memory."""
    from gvtools.files import replaced_when_written
    from gvtools.memory.ply import export_memory_ply
    from pipelines.measure import measure_run
    from viz.growth import draw_growth, growth_text

    out = directory.path
    last = directory.round_memory(len(plan.schedule))
    if last.exists():
        with replaced_when_written(out / "memory.npz") as temporary:
            shutil.copyfile(last, temporary)
    export_memory_ply(memory, out / "memory.ply")
    reports = directory.reports()
    with replaced_when_written(out / "growth.png") as temporary:
        draw_growth(reports, title=plan.scene.root.name).savefig(temporary, format="png", dpi=120)
    metrics = measure_run(plan, memory, directory, console)
    write_json(out / "metrics.json", metrics)
    last.unlink(missing_ok=True)
    console.line(growth_text(reports))
    console.line(f"results in {out}: memory.npz, memory.ply, growth.png, metrics.json, round_*/")
