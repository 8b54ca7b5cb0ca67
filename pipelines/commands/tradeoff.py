"""``gvtools tradeoff``: how speed trades for accuracy on a user's own scene."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError
from pipelines.commands.arguments import SceneArguments

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan
    from pipelines.reconstruction.settings import RunSettings

SUMMARY = "try profiles and single settings on held-out views, and say what to choose"
EXAMPLES = (
    "gvtools tradeoff scan/ --out runs/tradeoff --budget 60",
    "gvtools tradeoff colmap/ --out runs/quick --budget 5m --targets every:8+4",
)
SPLIT = {"context": "every:2", "targets": "every:2+1"}
# Of a sweep [s]; with a budget of a run, the time of so many runs.
LIMIT, RUNS = 900.0, 5
UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


class TradeoffArguments(SceneArguments):
    """The command's arguments."""

    positional = ("project",)

    project: Path
    """COLMAP, posed RGB-D, transforms.json or spec:NAME:SCENE. [PROJECT]"""
    out: Path
    """Of the results. [DIR]"""
    budget: str | None = None
    """Of a run: 60, 5m, 2h; default: none. [TIME]"""
    context: str | None = None
    """Views that are given (every:2). [SPEC]"""
    targets: str | None = None
    """Views that are held out and completed (every:2+1). [SPEC]"""
    config: Path | None = None
    """Settings to start from. [FILE]"""
    set: tuple[str, ...] = ()
    """One setting; repeatable. [KEY=VALUE]"""
    limit: str | None = None
    """Of the whole sweep: trials that would not fit are left out and named (five times --budget, at
    most 15m, its default). [TIME]"""


def run(args: TradeoffArguments, console: Console) -> None:
    """Sweep, and write table, front and the recommended profile."""
    from gvtools.files import write_json
    from gvtools.runs.folder import folder_lock
    from gvtools.settings import changes
    from pipelines.reconstruction.plan import run_identity
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.scoring.tradeoff import (
        Trials,
        changed,
        planned_trials,
        run_trials,
        write_results,
    )

    if args.out.exists() and not args.out.is_dir():
        raise OptionError(f"--out {args.out}: is a file; give a folder")
    budget = None if args.budget is None else parse_seconds("--budget", args.budget)
    limit = min(LIMIT, LIMIT if budget is None else RUNS * budget)
    if args.limit is not None:
        limit = parse_seconds("--limit", args.limit)
    config = _within(asked_for(args), budget)
    scene, plan = _planned(args, config, console)
    config = config.replaced(voxel=plan.config.voxel, memory=plan.config.memory)
    planned = planned_trials(
        plan,
        {
            name: changes(config, _within(asked_for(args, name), budget))
            for name in config.presets["profile"]
        },
        budget=budget,
    )
    with folder_lock(args.out):
        identity = run_identity(plan, args.reading())
        folder = args.out / "trials"
        folder.mkdir(exist_ok=True)
        runs = Trials(scene, config, folder=folder, identity=identity)
        trials = run_trials(planned, runs, limit=limit, console=console)
        chosen = write_results(
            trials,
            args.out,
            title=f"{scene.root.name}: {len(plan.targets.cameras.names)} held-out views",
            budget=budget,
            console=console,
        )
        file = args.out / "profile.json"
        if chosen is None:
            file.unlink(missing_ok=True)
            return
        # Everything but which views are given and which are completed.
        profile = changes(RunSettings(), changed(config, chosen.settings))
        write_json(file, {k: profile[k] for k in profile if k not in ("context", "targets")})
        console.line(f"gvtools reconstruct ... --config {file}; more results in {args.out}")


def _within(config: RunSettings, budget: float | None) -> RunSettings:
    """The settings with a fit that leaves half of the budget to the rest of a run."""
    limit = config.refine.limit
    if budget is None or limit is None or limit <= budget / 2:
        return config
    return config.replaced(refine=config.refine.replaced(seconds=budget / 2))


def _planned(args: TradeoffArguments, config: RunSettings, console: Console) -> tuple[Scene, Plan]:
    """The scene, and the plan of the run that the sweep starts from."""
    from pipelines.reconstruction.prepare import make_plan

    if config.rounds is not None:
        raise OptionError(
            f"rounds {config.rounds}: a sweep completes all views that it holds out; give fewer "
            "--targets instead"
        )
    scene = args.open_scene(args.project)
    plan = make_plan(scene, config, say=console.line)
    if any(view is None for view in plan.targets.truth) or plan.targets.project is not None:
        raise OptionError(
            f"targets {config.targets}: no views of the project; expected a selection of them, "
            "since a trial is measured against their photographs"
        )
    return scene, plan


def asked_for(args: TradeoffArguments, profile: str | None = None) -> RunSettings:
    """The run that the arguments ask for, or would with another profile.

    A profile finds its own voxel edge, unless one is given.
    """
    from gvtools.settings import changes, with_file, with_texts, with_values
    from pipelines.reconstruction.settings import RunSettings

    config = RunSettings()
    if args.config:
        config = with_file(config, args.config, presets={"profile": profile} if profile else None)
    elif profile is not None:
        config = with_values(config, {"profile": profile})
    named = [text for text in args.set if text.partition("=")[0].strip() == "profile"]
    texts: Sequence[str] = (
        args.set if profile is None else [text for text in args.set if text not in named]
    )
    config = with_texts(config, texts)
    split = {**SPLIT, **changes(RunSettings(), config)}
    return config.replaced(
        context=args.context or split["context"], targets=args.targets or split["targets"]
    )


def parse_seconds(option: str, text: str) -> float:
    """Of ``60``, ``5m`` or ``2h``."""
    found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*([A-Za-z]*)\s*", text)
    if not found or found[2].lower() not in UNITS or not float(found[1]) > 0:
        raise OptionError(f"{option} {text!r}; expected seconds (60), 5m or 2h")
    return float(found[1]) * UNITS[found[2].lower()]
