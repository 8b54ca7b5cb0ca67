"""``gvtools tradeoff``: how speed trades for accuracy on a user's own scene."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from pipelines.console import Console
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.tradeoff.outcome import Outcome
    from pipelines.tradeoff.search import Search

SUMMARY = "try a run's settings on held-out views: what each gives and takes, and what to choose"
EXAMPLES = (
    "gvtools tradeoff scan/ --out runs/tradeoff --budget 60",
    "gvtools tradeoff colmap/ --out runs/small --budget 200MB --targets every:8+4",
)
UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
BYTES = {"kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 2.0**10, "mib": 2.0**20, "gib": 2.0**30}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    from pipelines.commands.scene_arguments import add_scene_arguments

    parser.add_argument("project", type=Path, help="COLMAP, posed RGB-D or transforms.json")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="of the results")
    parser.add_argument(
        "--budget",
        metavar="AMOUNT",
        help="of a run: seconds (60, 5m, 2h) or bytes of memory (200MB, 1GiB); default: none",
    )
    parser.add_argument(
        "--context", default="every:2", metavar="SPEC", help="views that are given (%(default)s)"
    )
    parser.add_argument(
        "--targets",
        default="every:2+1",
        metavar="SPEC",
        help="views that are held out and completed (%(default)s)",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings to start from")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="one setting; repeatable"
    )
    parser.add_argument(
        "--limit",
        default="15m",
        metavar="TIME",
        help="of the whole sweep: trials that would not fit are left out and named (%(default)s)",
    )
    add_scene_arguments(parser)


def run(args: argparse.Namespace, console: Console) -> None:
    """Sweep, and write table, front, marginal values and the recommended profile.

    Raises:
        GvError: a project or settings that cannot be run, or a budget that is none.
    """
    from gvtools.runs.folder_lock import held_folder
    from gvtools.runs.identity import run_identity
    from gvtools.settings import changes
    from pipelines.commands.scene_arguments import open_scene, reading_of
    from pipelines.reconstruction.plan import make_plan
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.tradeoff.search import Search
    from pipelines.tradeoff.search_axes import knobs_of
    from pipelines.tradeoff.trial import Trials, applied

    if args.out.exists() and not args.out.is_dir():
        raise OptionError(f"--out {args.out}: is a file; give a folder")
    kind, budget = parse_budget(args.budget)
    limit_kind, limit = parse_budget(args.limit)
    if limit_kind != "seconds" or limit is None:
        raise OptionError(f"--limit {args.limit}; expected a time, such as 900 or 15m")
    config = asked_for(args)
    if config.rounds is not None:
        raise OptionError(
            f"rounds {config.rounds}: a sweep completes all views that it holds out; give fewer "
            "--targets instead"
        )
    scene = open_scene(args.project, args)
    plan = make_plan(scene, config, say=console.line)
    if any(view is None for view in plan.targets.truth) or plan.targets.project is not None:
        raise OptionError(
            f"--targets {args.targets}: no views of the project; expected a selection of them, "
            "since a trial is measured against their pictures"
        )
    config = config.replaced(voxel=plan.config.voxel, memory=plan.config.memory)
    with held_folder(args.out):
        identity = run_identity(plan, reading_of(args))
        trials = Trials(scene, config, plan.targets.cameras.names, args.out / "trials", identity)
        trials.folder.mkdir(exist_ok=True)

        def fits(outcome: Outcome) -> bool:
            if budget is None:
                return True
            spent = outcome.bytes if kind == "bytes" else outcome.seconds(len(trials.names))
            return spent <= budget

        search = Search(
            knobs_of(plan),
            trials.outcome,
            len(trials.names),
            limit=limit,
            say=console.line,
            kept=trials.kept,
            of_bytes=kind == "bytes",
        )
        profiles = [
            (f"profile {name}", changes(config, asked_for(args, name))) for name in config.profiles
        ]
        search.sweep(profiles, fits)

        def profile(outcome: Outcome) -> Mapping[str, Any]:
            """Everything but which views are given and which are completed."""
            changed = changes(RunSettings(), applied(config, outcome.settings))
            return {key: changed[key] for key in changed if key not in ("context", "targets")}

        _write(search, args.out, scene.root.name, identity, kind, budget, fits, profile, console)


def asked_for(args: argparse.Namespace, profile: str | None = None) -> RunSettings:
    """The run that the arguments ask for, or would with another profile.

    A profile finds its own voxel edge, unless one is given.
    """
    from gvtools.settings import with_file, with_profile, with_texts
    from pipelines.reconstruction.settings import RunSettings

    config = RunSettings()
    if args.config:
        config = with_file(config, args.config, profile=profile)
    elif profile is not None:
        config = with_profile(config, profile)
    named = [text for text in args.set if text.partition("=")[0].strip() == "profile"]
    texts = args.set if profile is None else [text for text in args.set if text not in named]
    config = with_texts(config, texts)
    return config.replaced(context=args.context, targets=args.targets)


def parse_budget(text: str | None) -> tuple[str, float | None]:
    """("seconds" or "bytes", amount) of ``60``, ``5m``, ``200MB``; None without a text.

    Raises:
        OptionError: another unit, or nothing above 0.
    """
    if text is None:
        return "seconds", None
    found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*([A-Za-z]*)\s*", text)
    unit = found[2].lower() if found else "?"
    if not found or (unit not in UNITS and unit not in BYTES) or not float(found[1]) > 0:
        raise OptionError(f"{text!r}; expected seconds (60, 5m, 2h) or bytes (200MB, 1GiB)")
    if unit in BYTES:
        return "bytes", float(found[1]) * BYTES[unit]
    return "seconds", float(found[1]) * UNITS[unit]


def _write(
    search: Search,
    out: Path,
    name: str,
    identity: Mapping[str, Any],
    kind: str,
    budget: float | None,
    fits: Callable[[Outcome], bool],
    profile: Callable[[Outcome], Mapping[str, Any]],
    console: Console,
) -> None:
    from gvtools.evaluation.tables import csv_text, markdown
    from gvtools.files import replaced_when_written, write_text
    from pipelines.console import write_json
    from pipelines.tradeoff.outcome import front
    from pipelines.tradeoff.points import project_of, trial_point
    from pipelines.tradeoff.search import EQUAL, marginal_values
    from pipelines.tradeoff.search_axes import delivers_less
    from pipelines.tradeoff.tables import front_table, marginal_table, trial_table
    from viz.plots.pareto import draw_pareto

    whole = search.whole()
    chosen = search.recommended(fits)
    best = front([entry.outcome for entry in whole], search.seconds)
    marginal = marginal_values(search)
    trials, edge, effects = (
        trial_table(search),
        front_table(search, best),
        marginal_table(marginal),
    )
    write_text(out / "trials.csv", csv_text(trials))
    write_text(out / "front.csv", csv_text(edge))
    points = [trial_point(entry.label, entry.outcome, search.targets) for entry in whole]
    drawn = [points[at] for at, entry in enumerate(whole) if entry.outcome in best]
    with replaced_when_written(out / "front.png") as temporary:
        draw_pareto(
            points,
            front=sorted(drawn, key=lambda point: point["seconds"]),
            recommended=None
            if chosen is None
            else trial_point(chosen.label, chosen.outcome, search.targets),
            budget=budget if kind == "seconds" else None,
            title=f"{name}: {search.targets} held-out views",
        ).savefig(temporary, format="png", dpi=120)
    write_json(
        out / "tradeoff.json",
        {
            **project_of(identity),
            "targets": search.targets,
            "budget": budget,
            "budget_of": kind,
            "trials": [
                {"label": entry.label, "share": entry.share, **entry.outcome.to_json()}
                for entry in search.tried
            ],
            "front": [outcome.to_json() for outcome in best],
            "marginal": marginal,
            "recommended": None if chosen is None else chosen.outcome.to_json(),
            "refused": search.refused,
            "left_out": search.left_out,
        },
    )
    console.line(markdown(effects))
    console.line(markdown(edge))
    if search.left_out:
        console.warn(
            f"{len(search.left_out)} trials were left out for --limit: "
            f"{', '.join(search.left_out[:4])}; the same command with a longer one goes on"
        )
    if chosen is None:
        (out / "profile.json").unlink(missing_ok=True)
        cheapest = min((entry.outcome for entry in whole), key=search.cost)
        console.warn(
            f"no trial is within the budget; the cheapest takes {search.seconds(cheapest):.1f} s "
            f"and {cheapest.bytes / 2**20:.0f} MiB; no profile.json is written"
        )
        return
    write_json(out / "profile.json", profile(chosen.outcome))
    on = "" if chosen.share == 1 else f" on {chosen.share:.0%} of the targets"
    console.line(
        f"recommended: {chosen.outcome.psnr:.2f} dB{on} in "
        f"{chosen.outcome.seconds(search.targets):.1f} s, {chosen.outcome.bytes / 2**20:.0f} MiB; "
        f"gvtools reconstruct ... --config {out / 'profile.json'}"
    )
    if delivers_less(search.knobs, chosen.outcome.settings):
        console.warn("within the budget the pictures are smaller than what was asked for")
    better = max(whole, key=lambda entry: entry.outcome.psnr)
    if fits(better.outcome) and better.outcome.psnr > chosen.outcome.psnr + EQUAL:
        console.line(
            f"smaller pictures, enlarged again, are measured to be nearer to the true ones "
            f"({better.outcome.psnr:.2f} dB in {better.outcome.seconds(search.targets):.1f} s): "
            f"max_side={better.outcome.settings.get('max_side')}"
        )
    console.line(f"results in {out}: front.png, front.csv, trials.csv, tradeoff.json, profile.json")
