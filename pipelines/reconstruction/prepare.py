"""Preparation of a run: choose views and depth, refine poses, place the scan, choose voxels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.completers.base import Completer, create
from gvtools.errors import DegenerateError, OptionError, ProjectError
from gvtools.prefetch import prefetch
from gvtools.runs.layout import POSES, TUNED
from gvtools.runs.poses import RunPoses, posed, with_poses
from gvtools.scenes.matching import natural
from gvtools.scenes.pixel_contradictions import COLORED, SWAPPED
from gvtools.scenes.resized import reduced
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.scenes.selection import select
from gvtools.view_selection import evenly_spread
from pipelines.console import Console
from pipelines.reconstruction.plan import PlacedScan, Plan, make_schedule, resolve_targets
from pipelines.reconstruction.voxel import grid_frame
from pipelines.tuning.options import FEWEST_VIEWS

if TYPE_CHECKING:
    from gvtools.depth.source import DepthSource
    from gvtools.runs.context_depth import DepthCache
    from gvtools.runs.folder import RunDirectory
    from gvtools.scans.points import Scan
    from gvtools.scans.registration import Placement, Surface
    from pipelines.reconstruction.settings import RunSettings

# A fit whose length is not given takes at most so long if no photographs can be left out to tell
# whether it gains [s].
UNVALIDATED_SECONDS = 30.0
# From this share of sparse points that the context's views alone would not give, the run says so:
# fox without every eighth view 0.01, one in eight alone 0.82.
TOLD_FROM = 0.1


def make_plan(
    scene: Scene, settings: RunSettings, *, say: Callable[[str], None] | None = None,
    round_0: Path | None = None,
) -> Plan:  # fmt: skip
    """Choose views, depth source, poses, voxel edge and schedule.

    Args:
        round_0: folder of round 0 of the run that is gone on with: its poses are taken. Refining
            them again may differ in the last digits, by the order in which threads add.
    """
    from gvtools.appearance.fit import validation_rows
    from gvtools.depth.choice import choose_source
    from gvtools.depth.source import RecordedDepth

    check_files(settings)
    config = _on_device(settings)
    _check(scene, config)
    scene = reduced(scene, config.max_side)
    completer = config.effort.wrap(create(config.completer, **config.completer_options))
    # By name: a project may list its views in any order, and merging depends on theirs.
    context = natural(select(scene.names, config.context))
    if config.tune.wanted:
        check_tuning(completer, context)
    targets = resolve_targets(
        scene, context, config.targets,
        allow_overlap=config.allow_overlap or config.lens.kind != "perspective",
        max_side=config.max_side,
    ).through(config.lens, captured=scene.subset(context).cameras)  # fmt: skip
    scene = _allowed_points(scene, context, config.points, say=say)
    own = config.completer_options.get("weights")
    if config.depth == "sensor-or-da3" and config.da3.weights is None and own is not None:
        config = config.replaced(da3=config.da3.replaced(weights=str(own)))
    chosen = choose_source(
        scene, context, config.depth, stereo=config.stereo, foundation=config.da3
    )
    recorded = (
        scene.kind != "colmap"
        and isinstance(chosen.source, RecordedDepth)
        and all(scene[name].has_depth for name in context)
    )
    poses = None
    if round_0 is not None:
        poses = saved_poses(round_0, context, targets.cameras)
    elif config.refine.poses:
        poses = refined_poses_of(scene, context, targets.cameras, recorded=recorded, say=say)
    at_poses = scene if poses is None else with_poses(scene, context, poses.context)
    if poses is not None and poses.by_features and not recorded:
        # Depth is computed at the poses that the memory is built with.
        if config.stereo.align is None:
            config = config.replaced(stereo=config.stereo.replaced(align=False))
        again = choose_source(
            at_poses, context, config.depth, stereo=config.stereo, foundation=config.da3
        )
        chosen = replace(again, ignored=chosen.ignored)
    if config.voxel is None:
        config = _with_voxel(config, at_poses, context, source=chosen.source, say=say)
    open_end = config.refine.seconds is None and config.refine.steps is None
    if open_end and not validation_rows(len(context)):
        config = config.replaced(refine=config.refine.replaced(seconds=UNVALIDATED_SECONDS))
    schedule = make_schedule(
        len(targets.cameras), config.views_per_round, config.rounds,
        faces=len(targets.rig.faces) if targets.rig else 1,
    )  # fmt: skip
    config = config.replaced(rounds=len(schedule))
    weights = (*getattr(chosen.source, "files", ()), *completer.files)
    return Plan(
        scene, settings, config, context, targets, schedule, chosen.source, chosen.reason,
        completer, chosen.ignored, weights, poses=poses,
    )  # fmt: skip


def _check(scene: Scene, config: RunSettings) -> None:
    """Refuse a project with errors, and a protocol that its completer does not have."""
    errors = [finding.message for finding in scene.findings if finding.level == "error"]
    if errors:
        more = f" (and {len(errors) - 1} more; see 'gvtools check')" if len(errors) > 1 else ""
        raise ProjectError(f"{scene.root}: {errors[0]}{more}")
    if config.protocol == "paper" and config.completer != "geoverse":
        raise OptionError(
            f"protocol paper with completer {config.completer!r}; expected geoverse; leave one out"
        )


def _allowed_points(
    scene: Scene, context: tuple[str, ...], which: str, *, say: Callable[[str], None] | None
) -> Scene:
    """The scene with the sparse points that the settings allow; tells what others give away."""
    from gvtools.scenes.resized import seen_by

    alone = seen_by(scene, context)
    if scene.points is None or alone.points is None or len(context) == len(scene.names):
        return scene
    count, told = len(scene.points.positions), len(alone.points.positions)
    if which == "context":
        return alone
    if say is not None and told < (1 - TOLD_FROM) * count:
        say(
            f"{count - told:,} of {count:,} sparse points were detected with the help of views "
            "outside the context: results on held-out views profit from them; leave them out by "
            "--set points=context"
        )
    return scene


def _with_voxel(
    config: RunSettings,
    scene: Scene,
    context: tuple[str, ...],
    *,
    source: DepthSource,
    say: Callable[[str], None] | None,
) -> RunSettings:
    """The settings with the automatic voxel edge."""
    from gvtools.depth.source import is_recorded
    from pipelines.reconstruction.voxel import at_scale, automatic_voxel, sufficient_scale

    fusion = config.fusion
    edge = automatic_voxel(scene, context, source, percentile=fusion.voxel_percentile, say=say)
    # Not rounded: it has to follow the world's scale.
    config = at_scale(config.replaced(voxel=edge), fusion.voxel_scale)
    if fusion.max_psnr_drop_db is None:
        return config
    recorded = [name for name in context if is_recorded(source, scene[name])]
    loss = fusion.max_psnr_drop_db
    return at_scale(config, sufficient_scale(scene, recorded, config=config, loss=loss, say=say))


def _on_device(config: RunSettings) -> RunSettings:
    """The device of the projection: "cuda" takes the torch back end there, "cpu" no other."""
    from gvtools.appearance.splat.gsplat_splatter import gsplat_installed
    from gvtools.settings import with_values

    splat, device = config.splat, str(config.device)
    if device == "cuda" and splat.backend in ("nearest", "open3d"):
        raise OptionError(
            f"device cuda with splat.backend {splat.backend}, which computes on the CPU; expected "
            "torch; leave one of them out"
        )
    if device == "auto":
        device = splat.device if splat.backend == "torch" else "cpu"
        if device == "auto":
            device = "cuda" if _cuda() else "cpu"
        return with_values(config, {"device": device, "splat.device": device})
    if device == "cpu":
        return with_values(config, {"splat.device": "cpu"})
    if not _cuda():
        import torch

        raise OptionError(
            f"device cuda: torch {torch.__version__} finds no CUDA device; expected one; use "
            "--device cpu, or install a CUDA build of torch"
        )
    if config.refine.wanted and not gsplat_installed():
        raise OptionError(
            "device cuda: fitting Gaussians needs gsplat, which is not installed; pip install "
            "'gvtools[cuda]', or use --refine 0 or --device cpu"
        )
    return with_values(config, {"splat.backend": "torch", "splat.device": "cuda"})


def _cuda() -> bool:
    import torch

    return torch.cuda.is_available()


def refined_poses_of(
    scene: Scene,
    context: Sequence[str],
    targets: Cameras,
    *,
    recorded: bool,
    say: Callable[[str], None] | None = None,
) -> RunPoses | None:
    """Poses on which the context agrees; None where the given ones stay.

    Targets move like the context near them, if that errs alike. Depth that is recorded tells the
    scale, and poses where features do not.
    """
    from gvtools.poses.bundle_adjustment import SIDE, adjusted_poses, can_adjust, tracks_of
    from gvtools.poses.refinement import FitView, refined_poses

    scene = reduced(scene, SIDE)
    # Lengths stay small there, also in a world whose origin is far away.
    frame = grid_frame(scene, context)
    views = [scene[name] for name in context]
    given = scene.subset(context).cameras
    given = posed(given, frame.cam_from_local(given.cam_from_world))
    tracks = tracks_of(scene, context, frame)
    exact = tracks is not None and tracks.exact(given)
    if not recorded and (exact or not can_adjust(given, tracks)):
        return None
    needed = views if recorded or tracks is None else []
    frames = list(prefetch(lambda view: view.load(), needed))
    adjusted = adjusted_poses(frames, given, tracks=tracks)
    if recorded:
        fitted = [
            FitView(loaded.rgb, view.camera.K[0], pose, loaded.mask, loaded.depth)
            for view, pose, loaded in zip(views, given.cam_from_world, frames, strict=True)
        ]
        poses = None if adjusted is None else adjusted.scaled(frames, given)
        result = (None if poses is None else refined_poses(fitted, poses)) or refined_poses(fitted)
    else:
        result = None if adjusted is None else adjusted.refined(given)
    if say is not None and (recorded or result is not None):
        same = "as given; no others agree better with neighbouring views"
        say(f"poses: {same if result is None else result}")
    if result is None:
        return None
    moved = [result.corrected(pose) for pose in frame.cam_from_local(targets.cam_from_world)]
    return RunPoses(
        frame.cam_from_world(result.poses),
        frame.cam_from_world(np.array(moved).reshape(-1, 4, 4)),
        result.by_features,
        result.depth if result.spread else 0.0,
    )


def saved_poses(round_0: Path, context: Sequence[str], targets: Cameras) -> RunPoses | None:
    """The refined poses of a run whose round 0 is complete; None where the given ones stayed."""
    path = round_0 / POSES
    poses = RunPoses.load(path) if path.exists() else None
    if poses is None or (len(poses.context), len(poses.targets)) != (len(context), len(targets)):
        return None
    return poses


# A scan's colours are compared with so many photographs, the nearest point in each square of so
# many pixels, from so many places on, and may be so many times as bright.
COMPARED, CELL, FEWEST_PLACES, BRIGHTER = 4, 8, 200, 2.0
# A scan is registered to recorded depth of at most so many views, and so many pixels of each.
VIEWS, PIXELS = 40, 5000


def check_files(config: RunSettings) -> None:
    """Refuse a scan or a start of a fit that cannot be read or placed, before it is needed."""
    from gvtools.scans.read import open_scan
    from gvtools.scans.registration import given_placement
    from gvtools.splat_files import holds_splats, read_splats

    scan, init = config.scan, config.refine.init
    if scan.placement != "estimate" and scan.file is None and init is None:
        raise OptionError(
            "scan.placement without a scan; expected --cloud or --init FILE beside it"
        )
    if scan.file is not None:
        open_scan(Path(scan.file))
    given_placement(scan.placement)
    if init is not None:
        if not config.refine.wanted:
            raise OptionError("--init without a fit; leave it out, or give --refine some seconds")
        path = Path(init)
        read_splats(path) if holds_splats(path) else open_scan(path)


def placed_scan(plan: Plan, console: Console) -> PlacedScan | None:
    """The run's scan, placed with the plan's cameras; None where there is none."""
    from gvtools.scans.read import read_scan
    from gvtools.scans.registration import Surface, given_placement, register

    options = plan.config.scan
    if options.file is None:
        return None
    scan = read_scan(Path(options.file))
    console.line(_scan_summary(scan))
    for note in scan.notes:
        console.warn(f"{scan.name}: {note}")
    given = given_placement(options.placement)
    centers = [station.center for station in scan.stations]
    known = None if any(center is None for center in centers) else np.array(centers)
    seen_from = None if known is None else known[scan.station]
    surface = Surface(scan.positions + scan.origin, seen_from)
    try:
        placement = register(
            surface, photographed(plan), least=options.min_fitness,
            metric=plan.scene.metric, seed=plan.config.seed, given=given,
        )  # fmt: skip
    except DegenerateError as error:
        if given is None:
            raise DegenerateError(f"{options.file}: {error} (--cloud-placement)") from None
        placement = given
    console.line(f"{scan.name}: placement {placement.summary()}")
    fit = max(placement.fitness or 0, placement.scan_fitness or 0)
    if placement.fitness is not None and fit < options.min_fitness:
        console.warn(
            f"{scan.name}: {fit:.0%} of the points fit what the photographs show, expected "
            f"{options.min_fitness:.0%} of the same places: is the matrix of another unit or frame?"
        )
    _check_reach(scan, placement, plan)
    placed = PlacedScan(scan, placement)
    _check_colors(placed, plan, console)
    return placed


def _check_reach(scan: Scan, placement: Placement, plan: Plan) -> None:
    """Refuse a scan that the memory cannot hold."""
    from gvtools.memory.store.voxel_index import MAX_VOXEL

    assert plan.config.voxel is not None
    reach = MAX_VOXEL * plan.config.voxel
    frame = grid_frame(plan.scene, plan.context)
    away = np.abs(frame.from_world(placement.apply(scan.positions + scan.origin))).max(axis=1)
    if away.min() > reach:
        raise DegenerateError(
            f"{scan.name}: all of its {len(scan):,} points lie beyond the {reach:.3g} scene units "
            f"that voxels of {plan.config.voxel:g} reach from the cameras; expected a scan around "
            "them; correct its placement (--cloud-placement)"
        )


def _check_colors(placed: PlacedScan, plan: Plan, console: Console) -> None:
    """Warn of colours that are not those that the photographs show in the same places."""
    scan, pairs = placed.scan, list[NDArray[np.float64]]()
    world = placed.placement.apply(scan.positions + scan.origin)
    for name in evenly_spread(plan.context, COMPARED) if scan.colored_by == "colour" else ():
        view = plan.scene[name]
        xy, z = (each[0] for each in view.camera.project(world))
        rgb = view.load().rgb
        inside = (z > 0) & (xy >= 0).all(axis=1) & (xy < rgb.shape[1::-1]).all(axis=1)
        nearest = np.flatnonzero(inside)[np.argsort(z[inside])]
        pixels = xy[nearest].astype(np.int64)
        first = np.unique(pixels // CELL, axis=0, return_index=True)[1]
        nearest, (x, y) = nearest[first], pixels[first].T
        pairs.append(np.stack([scan.colors[nearest], rgb[y, x]]).astype(np.float64))
    both = np.concatenate([np.zeros((2, 0, 3)), *pairs], axis=1)
    reds = np.subtract(both[..., 0], both[..., 2])
    if both.shape[1] < FEWEST_PLACES:
        return
    if reds.std(axis=1).min() > COLORED and np.corrcoef(reds)[0, 1] < SWAPPED:
        console.warn(f"{scan.name}: red and blue are the other way round than in the photographs")
    times = both[0].mean() / max(both[1].mean(), 1)
    if not 1 / BRIGHTER < times < BRIGHTER:
        console.warn(
            f"{scan.name}: its colours are {times:.2g} times as bright as the photographs in the "
            "same places; are they of another range than was read? Save them as bytes"
        )


def _scan_summary(scan: Scan) -> str:
    text = f"{scan.name}: {len(scan):,} of {scan.count:,} scanned points"
    if len(scan.stations) > 1:
        text += f" from {len(scan.stations)} stations"
    if scan.colored_by != "colour":
        text += f", grey by {scan.colored_by}"
    if scan.color_range:
        text += f", {scan.color_range}"
    dropped = ", ".join(f"{count:,} {reason}" for reason, count in scan.dropped.items())
    return f"{text} ({dropped})" if dropped else text


def photographed(plan: Plan) -> Surface:
    """What the context is known to show: recorded depth, else the project's sparse points."""
    from gvtools.scans.registration import Surface

    scene, positions, seen_from = plan.scene, list[NDArray[Any]](), list[NDArray[Any]]()
    rng = np.random.default_rng(plan.config.seed)
    for name in evenly_spread([n for n in plan.context if scene[n].has_depth], VIEWS):
        view = scene[name]
        frame = view.load()
        if frame.depth is None:
            continue
        usable = frame.depth > 0 if frame.mask is None else (frame.depth > 0) & frame.mask
        row, column = np.nonzero(usable)
        picked = rng.permutation(len(row))[:PIXELS]
        row, column = row[picked], column[picked]
        local = view.camera.rays()[row, column] * frame.depth[row, column, None]
        pose = view.camera.world_from_cam[0]
        positions.append(local @ pose[:3, :3].T + pose[:3, 3])
        seen_from.append(np.broadcast_to(pose[:3, 3], positions[-1].shape))
    if positions:
        return Surface(np.concatenate(positions), np.concatenate(seen_from))
    points = scene.points
    if points is None:
        raise DegenerateError("no recorded depth and no sparse points to place it by; give it")
    centers = scene.cameras.centers
    seen = np.full(points.positions.shape, np.nan)
    seen[points.point_index] = centers[points.view_index]
    known = np.isfinite(seen).all(axis=1)
    return Surface(points.positions[known], seen[known])


# In run.json: what the tuning came to.
TUNING = "tuning"


def check_tuning(completer: Completer, context: Sequence[str]) -> None:
    """Whether a completer can be tuned to so many context views."""
    from pipelines.tuning.tune import check_tunable

    if completer.weights is None:
        raise OptionError(
            f"tune: completer {completer.name} has no weights to tune; expected geoverse; add "
            "--completer geoverse, or leave --tune out"
        )
    check_tunable(completer.weights)
    if len(context) < FEWEST_VIEWS:
        raise OptionError(
            f"tune: {len(context)} context view(s); expected at least {FEWEST_VIEWS}, of which one "
            "judges; give more --context, or leave --tune out"
        )


def tuned(plan: Plan, cache: DepthCache, directory: RunDirectory, *, console: Console) -> Plan:
    """The plan with weights tuned to its context, now or by the attempt that is resumed."""
    from pipelines.tuning.tune import previous_tuning, tune

    weights, config = plan.completer.weights, plan.config
    assert weights is not None
    scene = with_depth(plan.evidence or plan.scene, plan.context, cache)
    out, options = directory.path / TUNED, {**config.completer_options}
    options.pop("weights", None)
    record = previous_tuning(scene, weights, out, options=config.tune, seed=config.seed)
    if record is None:
        console.line(f"tuning {weights} to the context, {config.tune.length}")
        record = tune(
            scene, weights, out, options=config.tune, completer=options, seed=config.seed,
            say=console.line,
        ).to_dict()  # fmt: skip
    else:
        console.line(f"weights tuned before: {out}")
    directory.add_to_record(TUNING, {name: record[name] for name in record if name != "inputs"})
    completer = create(config.completer, **options, weights=str(out))
    return replace(plan, completer=config.effort.wrap(completer))


def with_depth(scene: Scene, names: Sequence[str], cache: DepthCache) -> Scene:
    """The context alone, its views with the depth that a run gives them."""

    def load(view: View) -> Frame:
        frame = view.load()
        return replace(frame, depth=cache.depth(view, frame).depth)

    views = (scene[name] for name in names)
    known = [replace(v, load=partial(load, v), has_depth=cache.covers(v)) for v in views]
    return replace(scene, views=tuple(known), points=None)
