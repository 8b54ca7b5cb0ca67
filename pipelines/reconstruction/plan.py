"""A run before its first round: what is given, what is completed when, and from which depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.console import Console
from pipelines.reconstruction.voxel_edge import automatic_voxel

if TYPE_CHECKING:
    from gvtools.depth.source import DepthSource
    from gvtools.scenes.scene import Scene
    from pipelines.config import RunConfig
    from pipelines.reconstruction.targets import Targets


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
        source_reason: why from there, in words.
        ignored: settings of stereo that this source does not look at.
        weights: files of networks that decide the result.
        notes: what the completer has the user told.
    """

    scene: Scene
    config: RunConfig
    context: tuple[str, ...]
    targets: Targets
    schedule: tuple[tuple[int, ...], ...]
    source: DepthSource
    source_reason: str
    ignored: tuple[str, ...] = ()
    weights: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()


def make_plan(scene: Scene, config: RunConfig, *, say: Callable[[str], None] | None = None) -> Plan:
    """Resolve selections, depth source, voxel edge and schedule.

    Args:
        scene: the project.
        config: as the user gave it.
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
    config = _on_device(config)
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
        config = at_scale(replace(config, voxel=edge), config.fusion.voxel_scale)
        if config.fusion.voxel_loss is not None:
            recorded = [name for name in context if is_recorded(chosen.source, scene[name])]
            scale = sufficient_scale(
                scene, recorded, config=config, loss=config.fusion.voxel_loss, say=say
            )
            config = at_scale(config, scale)
    schedule = make_schedule(len(targets.cameras), config.views_per_round, config.rounds)
    config = replace(config, rounds=len(schedule))
    weights = [*getattr(chosen.source, "files", ()), *getattr(completer, "files", ())]
    return Plan(
        scene,
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


def _on_device(config: RunConfig) -> RunConfig:
    """The projection on the run's device: "cuda" takes the torch back end there, "cpu" no other."""
    from gvtools.errors import OptionError

    splat = config.splat
    if config.device == "cpu" and splat.device != "cpu":
        return replace(config, splat=splat.replaced(device="cpu"))
    if config.device != "cuda":
        return config
    if splat.backend in ("nearest", "open3d"):
        raise OptionError(
            f"device cuda with splat.backend {splat.backend}, which computes on the CPU; expected "
            "torch; leave one of them out"
        )
    import torch

    if not torch.cuda.is_available():
        raise OptionError(
            f"device cuda: torch {torch.__version__} finds no CUDA device; expected one; use "
            "--device cpu, or install a CUDA build of torch"
        )
    return replace(config, splat=splat.replaced(backend="torch", device="cuda"))


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
