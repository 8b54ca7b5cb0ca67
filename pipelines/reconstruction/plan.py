"""A run before its first round: its context, targets, schedule, depth source and identity."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.runs.identity import array_digest, fingerprint
from gvtools.settings import changes
from gvtools.view_selection import evenly_spread
from pipelines.console import Console
from pipelines.reconstruction.voxel_edge import automatic_voxel

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gvtools.completers.base import Completer
    from gvtools.depth.source import DepthSource
    from gvtools.runs.poses import RunPoses
    from gvtools.scenes.scene import Scene
    from pipelines.reconstruction.scan import PlacedScan
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.reconstruction.targets import Targets


# Processor seconds: of a view's plane sweep whole and as a fit needs it, of a view with recorded
# depth, of a megapixel that is lifted, of a target; and what a run takes whatever it does [s].
SWEPT, SWEPT_SMALL, RECORDED, LIFTED, COMPLETED, START = 2.2, 0.7, 0.5, 1.0, 2.0, 4.0
# A fit whose length is not given takes at most so long if no photographs can be left out to tell
# whether it gains [s].
UNVALIDATED_SECONDS = 30.0
# From this share of sparse points that the context's views alone would not give, the run says so:
# fox without every eighth view 0.01, one in eight alone 0.82.
TOLD_FROM = 0.1


@dataclass(frozen=True, eq=False)
class Plan:
    """A run before its first round.

    Attributes:
        scene: the project.
        settings: as the user gave them.
        config: with everything derived in its place; see ``derived``.
        context: names of the context views.
        targets: the cameras to complete.
        schedule: per round (from 1) the rows of the targets.
        source: where depth comes from.
        source_reason: why from there, in words.
        completer: of the whole run, under its effort policy.
        ignored: settings of stereo that this source does not look at.
        weights: files of networks that decide the result.
        evidence: the scene as it enters the memory, where that is smaller; None for ``scene``.
        poses: refined ones, which ``posed`` takes instead of the project's.
        scan: that the memory starts from, placed.
    """

    scene: Scene
    settings: RunSettings
    config: RunSettings
    context: tuple[str, ...]
    targets: Targets
    schedule: tuple[tuple[int, ...], ...]
    source: DepthSource
    source_reason: str
    completer: Completer
    ignored: tuple[str, ...] = ()
    weights: tuple[Path, ...] = ()
    evidence: Scene | None = None
    poses: RunPoses | None = None
    scan: PlacedScan | None = None

    @property
    def derived(self) -> dict[str, Any]:
        """What the run's settings leave open, by dotted key: voxel edge, rounds, device, ..."""
        return changes(self.settings, self.config)

    @property
    def posed(self) -> Plan:
        """The plan with refined poses."""
        from pipelines.reconstruction.poses import applied

        return self if self.poses is None else applied(self.poses, self)


def make_plan(
    scene: Scene,
    settings: RunSettings,
    *,
    say: Callable[[str], None] | None = None,
    round_0: Path | None = None,
) -> Plan:
    """Resolve selections, depth source, poses, voxel edge and schedule.

    Args:
        scene: the project.
        settings: as the user gave them.
        say: is told what is computed meanwhile.
        round_0: folder of round 0 of the run that is gone on with: its poses are taken. Refining
            them again may differ in the last digits, by the order in which threads add.
    """
    from gvtools.appearance.fit import validation_rows
    from gvtools.completers.base import create
    from gvtools.depth.choice import choose_source
    from gvtools.depth.source import RecordedDepth
    from gvtools.errors import OptionError, ProjectError
    from gvtools.runs.poses import with_poses
    from gvtools.scenes.reduced import reduced
    from gvtools.scenes.selection import select
    from pipelines.reconstruction import poses
    from pipelines.reconstruction.scan import check_scan
    from pipelines.reconstruction.targets import resolve_targets
    from pipelines.reconstruction.tuning import check_tuning

    errors = [finding.message for finding in scene.findings if finding.level == "error"]
    if errors:
        raise ProjectError(
            f"{scene.root}: {errors[0]}"
            + (f" (and {len(errors) - 1} more; see 'gvtools check')" if len(errors) > 1 else "")
        )
    check_scan(settings.scan)
    config = _on_device(settings)
    if config.protocol == "paper" and config.completer != "geoverse":
        raise OptionError(
            f"protocol paper with completer {config.completer!r}; expected geoverse; leave one out"
        )
    scene = reduced(scene, config.max_side)
    completer = config.effort.applied(create(config.completer, **config.completer_options))
    # By name: a project may list its views in any order, and merging depends on theirs.
    context = tuple(sorted(select(scene.names, config.context)))
    if config.tune.wanted:
        check_tuning(completer, context)
    targets = resolve_targets(
        scene,
        context,
        config.targets,
        allow_overlap=config.allow_overlap,
        max_side=config.max_side,
    )
    scene = _allowed_points(scene, context, config.points, say=say)
    chosen = choose_source(
        scene, context, config.depth, stereo=config.stereo, foundation=config.da3
    )
    recorded = (
        scene.kind != "colmap"
        and isinstance(chosen.source, RecordedDepth)
        and all(scene[name].has_depth for name in context)
    )
    found = None
    if round_0 is not None:
        found = poses.saved(round_0, context, targets.cameras)
    elif config.refine.poses:
        found = poses.refined(scene, context, targets.cameras, recorded=recorded, say=say)
    if found is not None and found.by_features and not recorded:
        # Depth is computed at the poses that the memory is built with.
        if config.stereo.align is None:
            config = config.replaced(stereo=config.stereo.replaced(align=False))
        again = choose_source(
            with_poses(scene, context, found.context), context, config.depth,
            stereo=config.stereo, foundation=config.da3,
        )  # fmt: skip
        chosen = replace(again, ignored=chosen.ignored)
    if config.voxel is None:
        posed = scene if found is None else with_poses(scene, context, found.context)
        config = _with_voxel(config, posed, context, source=chosen.source, say=say)
    if (config.refine.seconds, config.refine.steps) == (None, None) and not validation_rows(
        len(context)
    ):
        config = config.replaced(refine=config.refine.replaced(seconds=UNVALIDATED_SECONDS))
    schedule = make_schedule(len(targets.cameras), config.views_per_round, config.rounds)
    config = config.replaced(rounds=len(schedule))
    weights = [*getattr(chosen.source, "files", ()), *completer.files]
    return Plan(
        scene,
        settings,
        config,
        context,
        targets,
        schedule,
        chosen.source,
        chosen.reason,
        completer,
        chosen.ignored,
        tuple(weights),
        poses=found,
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
    from pipelines.reconstruction.voxel_probe import at_scale, sufficient_scale

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
    """The device of the projection: "cuda" takes the torch back end there, "cpu" no other.

    "auto" is CUDA where the torch back end was chosen, may choose, and finds such a device.
    """
    from gvtools.appearance.splat.gsplat_splatter import gsplat_installed
    from gvtools.errors import OptionError
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
            "device cuda: gsplat, which fits Gaussians there, is not installed; expected it; pip "
            "install gvtools[cuda], or use --refine 0 or --device cpu"
        )
    return with_values(config, {"splat.backend": "torch", "splat.device": "cuda"})


def _cuda() -> bool:
    import torch

    return torch.cuda.is_available()


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


def run_identity(plan: Plan, reading: Mapping[str, Any]) -> dict[str, Any]:
    """What decides a run's result, JSON-ready; a resumed run must have the same.

    Args:
        plan: the run.
        reading: how the user said the project is to be read, JSON-ready.
    """
    scene, targets = plan.scene, plan.targets
    files = [file for name in plan.context for file in scene[name].files]
    files += [file for view in targets.truth if view for file in view.files]
    cameras = (scene.subset(plan.context).cameras, targets.cameras)
    points = scene.points
    return {
        "project": scene.address,
        "reading": dict(reading),
        "fingerprint": fingerprint([*files, *targets.files, *plan.config.scan.files()]),
        "cameras": array_digest(
            array for c in cameras for array in (c.K, c.cam_from_world, c.width, c.height)
        ),
        # Depth is sought and checked by the sparse points and their tracks.
        "points": None
        if points is None
        else array_digest((points.positions, points.point_index, points.view_index, points.xy)),
        "pixels": array_digest(_sample_pixels(plan)),
        "weights": fingerprint(plan.weights),
        "settings": plan.settings.to_dict(),
        "derived": plan.derived,
        "context": list(plan.context),
        "targets": list(targets.cameras.names),
        "targets_kind": targets.kind,
        "targets_project": targets.project,
        "schedule": [list(rows) for rows in plan.schedule],
    }


def _sample_pixels(plan: Plan) -> Iterator[NDArray[np.generic] | None]:
    """Some context views as they are read: units, registration and masks show in the pixels."""
    for name in evenly_spread(plan.context):
        frame = plan.scene[name].load()
        yield from (frame.rgb, frame.depth, frame.mask)


def expected_seconds(plan: Plan) -> float:
    """About how long a run takes, to a factor of two, without a network's time."""
    from numba import get_num_threads

    config = plan.config
    sizes = plan.scene.subset(plan.context).cameras
    megapixels = float((sizes.width * sizes.height).sum()) / 1e6
    if plan.source.name == "plane-sweep":
        fit = config.refine.wanted and config.depth == "auto"
        # A fit that is not used was swept for at a small size before.
        depth = SWEPT + SWEPT_SMALL if fit else SWEPT
        work = depth * len(plan.context) + LIFTED * megapixels
    else:
        work = RECORDED * len(plan.context) + LIFTED * megapixels
    work += COMPLETED * sum(len(rows) for rows in plan.schedule)
    limit = config.refine.limit if config.refine.wanted else 0.0
    return (
        START
        + work / get_num_threads()
        + (0.05 * (config.refine.steps or 0) if limit is None else limit)
    )


def _told(seconds: float) -> str:
    """A rough time in words."""
    return f"{seconds / 60:.0f} min" if seconds >= 100 else f"{max(round(seconds, -1), 10):.0f} s"


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
    tuning = f" (tuned for {config.tune.length})" if config.tune.wanted else ""
    console.line(
        f"depth {plan.source.name} ({plan.source_reason}), voxel {config.voxel:g}, completer "
        f"{config.completer}{tuning}, "
        f"{len(plan.schedule)} rounds of at most {config.views_per_round} targets, seed "
        f"{config.seed}"
    )
    console.line(f"it takes at most about {_told(expected_seconds(plan))}")
    if scheduled < len(targets.cameras):
        console.warn(
            f"{len(targets.cameras) - scheduled} of {len(targets.cameras)} targets are in no "
            "round; raise --rounds or --views-per-round"
        )
    for note in plan.completer.notes:
        console.warn(note)
    if plan.ignored:
        console.warn(
            f"{', '.join(plan.ignored)} changes nothing: no plane sweep computes depth here, but "
            f"{plan.source.name}"
        )
    for finding in plan.scene.findings:
        if finding.level == "warning":
            console.warn(finding.message)
