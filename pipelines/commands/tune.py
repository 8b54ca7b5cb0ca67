"""``gvtools train tune``: a model's weights tuned to one scene, by hold-outs of its context."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError
from pipelines.commands.arguments import RootArguments

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.commands.train import TrainArguments
    from pipelines.console import Console
    from pipelines.reconstruction.settings import RunSettings

NAME = "tune"
# Of the stages; tuning does not look at them.
STAGE_OPTIONS = ("stage", "resume", "until", "set", "sheets")


class TuneArguments(RootArguments):
    """What ``tune`` takes beside --init, --out, --device and --json."""

    title = (
        "tune: CONFIG tune trains the denoisers to predict views of one scene from each other. "
        "Some of the views judge; the tuned weights are kept if they predict these better than "
        "before. --init is the model that ships unless given, and --out a folder for --set "
        "completer.weights=DIR"
    )

    scene: Path | None = None
    """As reconstruct takes it. [PROJECT]"""
    context: str = "all"
    """Views that may be looked at. [SPEC]"""
    depth: str = "auto"
    """Of the views, as of reconstruct. [SOURCE]"""
    minutes: float = 10.0
    """How long. [min]"""
    steps: int | None = None
    """Steps instead of a time: the same result each time. [N]"""
    seed: int = 0
    """Of everything random. [N]"""


def run_tune(args: TrainArguments, console: Console) -> None:
    """Tune, and write the weights."""
    from gvtools.completers.geoverse.completer import SHIPPED
    from gvtools.files import check_parent, write_json
    from gvtools.scenes.project import open_project
    from pipelines.tuning.tune import check_tunable, tune

    if args.scene is None:
        raise OptionError("train tune needs --scene PROJECT, the scene that is tuned to")
    config = _checked(args)
    weights = args.init or SHIPPED
    check_tunable(weights)
    if args.json_ is not None:
        check_parent(args.json_)
    if args.out.exists() and not (args.out.is_dir() and not any(args.out.iterdir())):
        raise OptionError(f"--out {args.out}: holds something already; give a new folder")
    with tempfile.TemporaryDirectory() as folder:
        project = open_project(args.scene, root=args.root)
        scene = context_of(project, config, Path(folder), console=console)
        tuning = tune(
            scene,
            weights,
            args.out,
            options=config.tune,
            completer={"device": args.device},
            seed=config.seed,
            say=console.line,
        )
    console.line(f"gvtools reconstruct ... --completer geoverse --set completer.weights={args.out}")
    if args.json_ is not None:
        write_json(args.json_, tuning.to_dict())


def _checked(args: TrainArguments) -> RunSettings:
    """Settings of a run that would read the scene likewise."""
    from gvtools.settings import with_values
    from pipelines.reconstruction.settings import RunSettings

    for name in STAGE_OPTIONS:
        if name in args.model_fields_set:
            raise OptionError(f"train tune does not look at {args.key(name)}; leave it out")
    if {"minutes", "steps"} <= args.model_fields_set:
        raise OptionError("--minutes and --steps: expected one of them; leave the other out")
    given = {"tune.minutes": args.minutes, "tune.steps": args.steps, "context": args.context,
             "depth": args.depth, "seed": args.seed}  # fmt: skip
    config = with_values(RunSettings(), given)
    if not config.tune.wanted:
        raise OptionError("no minutes and no steps: nothing to do; give --minutes or --steps")
    return config


def context_of(scene: Scene, config: RunSettings, folder: Path, *, console: Console) -> Scene:
    """A scene's context with the depth and the poses that a run without a fit would take.

    Targets of ``config`` are not looked at; computed depth goes into ``folder``.
    """
    from gvtools.runs.context_depth import DepthCache
    from gvtools.settings import with_values
    from pipelines.reconstruction.prepare import make_plan, with_depth

    # The context stands for the targets, and an edge that nothing is fused with is not sought.
    reading = {"completer": "none", "voxel": 1.0, "allow_overlap": True, "tune.minutes": 0.0}
    reading |= {"tune.steps": None, "targets": config.context}
    plan = make_plan(scene, with_values(config, reading), say=console.line).posed
    console.line(
        f"{scene.root}: {len(plan.context)} context views; depth {plan.source.name} "
        f"({plan.source_reason})"
    )
    cache = DepthCache(plan.scene, plan.context, plan.source, folder=folder)
    return with_depth(plan.scene, plan.context, cache)
