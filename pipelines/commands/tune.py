"""``gvtools train tune``: a model's weights tuned to one scene, by hold-outs of its context."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError
from pipelines.commands.arguments import add_root_argument

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console
    from pipelines.reconstruction.settings import RunSettings

NAME = "tune"
# Options of the stages that tuning does not look at, with their defaults.
STAGE_OPTIONS = {"stage": "all", "resume": False, "until": None, "set": [], "sheets": 250}
DEFAULT_MINUTES = 10.0


def add_tune_arguments(parser: argparse.ArgumentParser) -> None:
    """What ``tune`` takes beside --init, --out, --device and --json."""
    group = parser.add_argument_group(
        NAME,
        "CONFIG tune: train the denoisers to predict views of one scene from each other. "
        "Some of the views judge; the tuned weights are kept if they predict these better than "
        "before. --init is the model that ships unless given, and --out a folder for "
        "--set completer.weights=DIR",
    )
    group.add_argument("--scene", type=Path, metavar="PROJECT", help="as reconstruct takes it")
    add_root_argument(group)
    group.add_argument(
        "--context", metavar="SPEC", help="views that may be looked at (default all)"
    )
    group.add_argument("--depth", metavar="SOURCE", help="of the views, as of reconstruct (auto)")
    group.add_argument(
        "--minutes", type=float, metavar="M", help=f"how long (default {DEFAULT_MINUTES:g})"
    )
    group.add_argument(
        "--steps", type=int, metavar="N", help="steps instead of a time: the same result each time"
    )
    group.add_argument("--seed", type=int, metavar="N", help="of everything random (default 0)")


def refuse_tune_arguments(args: argparse.Namespace) -> None:
    """Refuse options of ``tune`` beside another training."""
    for name in ("scene", "root", "context", "depth", "minutes", "steps", "seed"):
        if getattr(args, name) is not None:
            raise OptionError(f"--{name} belongs to 'gvtools train tune'; leave it out")


def run_tune(args: argparse.Namespace, console: Console) -> None:
    """Tune, and write the weights."""
    from gvtools.completers.geoverse.completer import SHIPPED
    from gvtools.files import check_parent, write_json
    from gvtools.scenes.project import open_project
    from pipelines.tuning.tune import check_tunable, tune

    config = _checked(args)
    weights = args.init or SHIPPED
    check_tunable(weights)
    if args.json is not None:
        check_parent(args.json)
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
    if args.json is not None:
        write_json(args.json, tuning.to_dict())


def _checked(args: argparse.Namespace) -> RunSettings:
    """Settings of a run that would read the scene likewise."""
    from gvtools.settings import with_values
    from pipelines.reconstruction.settings import RunSettings

    for name, default in STAGE_OPTIONS.items():
        if getattr(args, name) != default:
            raise OptionError(f"train tune does not look at --{name}; leave it out")
    if args.scene is None:
        raise OptionError("train tune needs --scene PROJECT, the scene that is tuned to")
    if args.minutes is not None and args.steps is not None:
        raise OptionError("--minutes and --steps: expected one of them; leave the other out")
    given: dict[str, Any] = {
        "tune.minutes": DEFAULT_MINUTES if args.minutes is None else args.minutes,
        "tune.steps": args.steps,
        "context": args.context,
        "depth": args.depth,
        "seed": args.seed,
    }
    config = with_values(
        RunSettings(), {key: value for key, value in given.items() if value is not None}
    )
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
