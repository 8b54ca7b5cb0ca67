"""A run before its first round: what is given, what is completed when, and from which depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.console import Console
from pipelines.reconstruction.voxel_edge import automatic_voxel

if TYPE_CHECKING:
    from gvtools.depth.source import DepthSource
    from gvtools.scenes.scene import Scene
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.reconstruction.targets import Targets


@dataclass(frozen=True, eq=False)
class Plan:
    """A run before its first round.

    Attributes:
        scene: the project.
        settings: as the user gave them.
        config: with everything derived in its place; see ``derived``.
        context: names of the given views.
        targets: the cameras to complete.
        schedule: per round (from 1) the rows of the targets.
        source: where depth comes from.
        source_reason: why from there, in words.
        ignored: settings of stereo that this source does not look at.
        weights: files of networks that decide the result.
        notes: what the completer has the user told.
    """

    scene: Scene
    settings: RunSettings
    config: RunSettings
    context: tuple[str, ...]
    targets: Targets
    schedule: tuple[tuple[int, ...], ...]
    source: DepthSource
    source_reason: str
    ignored: tuple[str, ...] = ()
    weights: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def derived(self) -> dict[str, Any]:
        """What the run's settings leave open, by dotted key: voxel edge, rounds, device, ..."""
        from gvtools.settings import changes

        return changes(self.settings, self.config)


def make_plan(
    scene: Scene, settings: RunSettings, *, say: Callable[[str], None] | None = None
) -> Plan:
    """Resolve selections, depth source, voxel edge and schedule.

    Args:
        scene: the project.
        settings: as the user gave them.
        say: is told what is computed meanwhile.

    Raises:
        GvError: settings that the project cannot serve.
    """
    from gvtools.completers.base import create
    from gvtools.depth.choice import choose_source
    from gvtools.depth.source import is_recorded
    from gvtools.errors import ProjectError
    from gvtools.scenes.reduced import reduced
    from gvtools.scenes.selection import select
    from pipelines.reconstruction.targets import resolve_targets
    from pipelines.reconstruction.voxel_probe import at_scale, sufficient_scale

    errors = [finding.message for finding in scene.findings if finding.level == "error"]
    if errors:
        raise ProjectError(
            f"{scene.root}: {errors[0]}"
            + (f" (and {len(errors) - 1} more; see 'gvtools check')" if len(errors) > 1 else "")
        )
    config = _on_device(settings)
    scene = reduced(scene, config.max_side)
    completer = create(config.completer, **config.completer_options)
    # By name: a project may list its views in any order, and merging depends on theirs.
    context = tuple(sorted(select(scene.names, config.context)))
    targets = resolve_targets(
        scene,
        context,
        config.targets,
        allow_overlap=config.allow_overlap,
        max_side=config.max_side,
    )
    chosen = choose_source(
        scene, context, config.depth, stereo=config.stereo, foundation=config.da3
    )
    if config.voxel is None:
        edge = automatic_voxel(
            scene, context, chosen.source, percentile=config.fusion.voxel_percentile, say=say
        )
        # Not rounded: it has to follow the world's scale.
        config = at_scale(config.replaced(voxel=edge), config.fusion.voxel_scale)
        if config.fusion.max_psnr_drop_db is not None:
            recorded = [name for name in context if is_recorded(chosen.source, scene[name])]
            scale = sufficient_scale(
                scene, recorded, config=config, loss=config.fusion.max_psnr_drop_db, say=say
            )
            config = at_scale(config, scale)
    schedule = make_schedule(len(targets.cameras), config.views_per_round, config.rounds)
    config = config.replaced(rounds=len(schedule))
    weights = [*getattr(chosen.source, "files", ()), *getattr(completer, "files", ())]
    return Plan(
        scene,
        settings,
        config,
        context,
        targets,
        schedule,
        chosen.source,
        chosen.reason,
        chosen.ignored,
        tuple(weights),
        tuple(getattr(completer, "notes", ())),
    )


def _on_device(config: RunSettings) -> RunSettings:
    """The device of the projection: "cuda" takes the torch back end there, "cpu" no other.

    "auto" is CUDA where the torch back end was chosen, may choose, and finds such a device.
    """
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
        f"depth {plan.source.name} ({plan.source_reason}), voxel {config.voxel:g}, completer "
        f"{config.completer}, "
        f"{len(plan.schedule)} rounds of at most {config.views_per_round} targets, seed "
        f"{config.seed}"
    )
    if scheduled < len(targets.cameras):
        console.warn(
            f"{len(targets.cameras) - scheduled} of {len(targets.cameras)} targets are in no "
            "round; raise --rounds or --views-per-round"
        )
    for note in plan.notes:
        console.warn(note)
    if plan.ignored:
        console.warn(
            f"{', '.join(plan.ignored)} changes nothing: no plane sweep computes depth here, but "
            f"{plan.source.name}"
        )
    for finding in plan.scene.findings:
        if finding.level == "warning":
            console.warn(finding.message)
