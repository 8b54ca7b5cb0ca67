"""``gvtools benchmark``, ``tradeoff`` and ``fleet``: sweeps over scenes, methods and settings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from gvtools.errors import OptionError, ProjectError
from gvtools.files import write_json
from gvtools.settings import changes
from gvtools.specs import unknown
from gvtools.untrusted import read_json
from pipelines.commands.arguments import LpipsArguments, SceneArguments
from pipelines.commands.reconstruct import run_settings
from pipelines.options import Arguments

if TYPE_CHECKING:
    from gvtools.evaluation.published import Benchmark
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console
    from pipelines.fleet.run import Threads
    from pipelines.reconstruction.plan import Plan
    from pipelines.reconstruction.settings import RunSettings
    from pipelines.scoring.benchmark import BenchmarkCell


class BenchmarkCommand(LpipsArguments):
    """Run a whole benchmark, and stand its means beside published rows."""

    examples = (
        "gvtools benchmark llff --root nerf_llff_data --views 3,6,9",
        "gvtools benchmark few-view --root projects --methods default,none,mine=renders",
    )
    positional = ("name",)

    name: str
    """llff, dtu, mipnerf360-few, few-view (projects of one's own), or the paper's: realestate10k,
    dl3dv, mipnerf360, scannetv2, dl3dv-steps, scannetv2-ablation. [NAME]"""
    root: Path
    """The data set as downloaded, or a folder of projects. [DIR]"""
    out: Path | None = None
    """Of the results (runs/benchmark-NAME); goes on there. [DIR]"""
    views: str | None = None
    """Numbers of context views (default: the benchmark's). [N,...]"""
    scenes: str | None = None
    """Default: all of the benchmark's. [NAME,...]"""
    methods: str = "default"
    """default, a profile, a completer, paper, NAME=FILE.json (settings) or NAME=DIR (pictures of
    another method). [NAME,...]"""
    seconds: float | None = Field(None, gt=0)
    """Of each fit of Gaussians (default: the method's). [S]"""

    def run(self, console: Console) -> None:
        from gvtools.evaluation.published import load_benchmark
        from gvtools.evaluation.tables import markdown
        from gvtools.runs.folder import folder_lock
        from pipelines.scoring.benchmark import measure_apart, measure_cells
        from pipelines.scoring.benchmark_results import PAGE, write_results

        benchmark = load_benchmark(self.name)
        cells = planned_cells(self, benchmark, console)
        out, title = cells[0].out, f"Benchmark {self.name}"

        def write() -> None:
            write_results(benchmark, cells, out, title=title)

        _refuse_others(out, self.name)
        with folder_lock(out):
            measure_cells(cells, console=console, measure=measure_apart, after=write)
            tables = write_results(benchmark, cells, out, title=title)
        for table in tables.values():
            console.line(markdown(table))
        console.line(f"results in {out}: {PAGE}, results.json, and tables as .csv, .md and .tex")
        _check_some_measured(cells, self.root)


def _refuse_others(out: Path, name: str) -> None:
    """Refuse a folder with the tables of another benchmark, which would be overwritten."""
    from pipelines.scoring.benchmark_results import RESULTS

    try:
        found = read_json(out / RESULTS)["benchmark"]
    except (OSError, ValueError, KeyError, TypeError):
        return
    if found != name:
        raise OptionError(
            f"{out}: holds the results of {found!r}, not {name!r}; give another --out"
        )


def _check_some_measured(cells: tuple[BenchmarkCell, ...], root: Path) -> None:
    """Refuse a benchmark without any figure, which a script would take for a success."""
    from pipelines.scoring.benchmark import MEASURED, read_cell

    results = [read_cell(cell) for cell in cells]
    if not any(result and result["status"] == MEASURED for result in results):
        first = next((result["reason"] for result in results if result), "no results")
        raise ProjectError(f"{root}: none of {len(cells)} measurements succeeded, first {first}")


def planned_cells(
    args: BenchmarkCommand, benchmark: Benchmark, console: Console
) -> tuple[BenchmarkCell, ...]:
    """Every scene, number of views and method, scene by scene."""
    from pipelines.scoring.benchmark import BenchmarkCell, parse_methods
    from pipelines.scoring.benchmark_scenes import scene_names

    root = args.root.resolve()
    methods = parse_methods(args.methods)
    for method in methods:
        method.config(seconds=args.seconds)
    lpips, no_lpips = args.open_lpips()
    if lpips is None:
        console.line(f"LPIPS is not measured: {no_lpips}")
    chosen = None if lpips is None else (args.lpips_net, args.lpips_weights)
    scenes = _chosen_scenes(args.scenes, scene_names(benchmark, root))
    out = args.out or Path("runs") / f"benchmark-{args.name}"
    return tuple(
        BenchmarkCell(
            benchmark=args.name,
            root=root,
            scene=scene,
            views=views,
            method=method,
            seconds=args.seconds,
            lpips=chosen,
            out=out.resolve(),
        )
        for scene in scenes
        for views in _chosen_views(args.views, benchmark)
        for method in methods
    )


def _chosen_views(text: str | None, benchmark: Benchmark) -> tuple[int, ...]:
    if text is None:
        return benchmark.views
    try:
        numbers = tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise OptionError(f"--views {text!r}; expected numbers with commas between them") from None
    for number in numbers:
        benchmark.at(number)
    return numbers


def _chosen_scenes(text: str | None, known: tuple[str, ...]) -> tuple[str, ...]:
    if text is None:
        return known
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    for name in names or [text]:
        if name not in known:
            raise OptionError(unknown("scene", name, known))
    return names


SPLIT = {"context": "every:2", "targets": "every:2+1"}
# Of a sweep [s]; with a budget of a run, the time of so many runs.
LIMIT, RUNS = 900.0, 5
UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


class TradeoffCommand(SceneArguments):
    """Try profiles and single settings on held-out views, and say what to choose."""

    examples = (
        "gvtools tradeoff scan/ --out runs/tradeoff --budget 60",
        "gvtools tradeoff colmap/ --out runs/quick --budget 5m --targets every:8+4",
    )
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

    def run(self, console: Console) -> None:
        from gvtools.runs.folder import folder_lock
        from pipelines.reconstruction.plan import run_identity
        from pipelines.reconstruction.settings import RunSettings
        from pipelines.scoring import tradeoff

        if self.out.exists() and not self.out.is_dir():
            raise OptionError(f"--out {self.out}: is a file; give a folder")
        budget = None if self.budget is None else parse_seconds("--budget", self.budget)
        limit = min(LIMIT, LIMIT if budget is None else RUNS * budget)
        if self.limit is not None:
            limit = parse_seconds("--limit", self.limit)
        config = _within(asked_for(self), budget)
        scene, plan = _planned(self, config, console)
        config = config.replaced(voxel=plan.config.voxel, memory=plan.config.memory)
        planned = tradeoff.planned_trials(
            plan,
            {
                name: changes(config, _within(asked_for(self, name), budget))
                for name in config.presets["profile"]
            },
            budget=budget,
        )
        with folder_lock(self.out):
            identity = run_identity(plan, self.reading())
            folder = self.out / "trials"
            folder.mkdir(exist_ok=True)
            runs = tradeoff.Trials(scene, config, folder=folder, identity=identity)
            trials = tradeoff.run_trials(planned, runs, limit=limit, console=console)
            chosen = tradeoff.write_results(
                trials,
                self.out,
                title=f"{scene.root.name}: {len(plan.targets.cameras.names)} held-out views",
                budget=budget,
                console=console,
            )
            file = self.out / "profile.json"
            if chosen is None:
                file.unlink(missing_ok=True)
                return
            # Everything but which views are given and which are completed.
            profile = changes(RunSettings(), tradeoff.changed(config, chosen.settings))
            write_json(file, {k: profile[k] for k in profile if k not in ("context", "targets")})
            console.line(f"gvtools reconstruct ... --config {file}; more results in {self.out}")


def _within(config: RunSettings, budget: float | None) -> RunSettings:
    """The settings with a fit that leaves half of the budget to the rest of a run."""
    limit = config.refine.limit
    if budget is None or limit is None or limit <= budget / 2:
        return config
    return config.replaced(refine=config.refine.replaced(seconds=budget / 2))


def _planned(args: TradeoffCommand, config: RunSettings, console: Console) -> tuple[Scene, Plan]:
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


def asked_for(args: TradeoffCommand, profile: str | None = None) -> RunSettings:
    """The run that the arguments ask for, or would with another profile.

    A profile finds its own voxel edge, unless one is given.
    """
    from pipelines.reconstruction.settings import RunSettings

    texts: Sequence[str] = args.set
    given = {} if profile is None else {"profile": profile}
    if given:
        texts = [text for text in texts if text.partition("=")[0].strip() != "profile"]
    config = run_settings(given, texts=texts, file=args.config)
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


class FleetCommand(Arguments):
    """Run commands over many scenes: on Ray, under Slurm, or on this machine."""

    examples = (
        "gvtools fleet scenes.yaml --address auto --out runs/fleet",
        "gvtools fleet scenes.yaml --engine slurm --out /shared/fleet",
        "gvtools fleet scenes.yaml --collect --out /shared/fleet",
    )
    positional = ("scenes",)

    scenes: Path
    """Stages and scenes. [SCENES.yaml]"""
    out: str
    """Of the results, a path or URL; goes on there. [FOLDER]"""
    engine: Literal["ray", "processes", "slurm"] = "ray"
    """What runs the commands."""
    address: str | None = None
    """Ray's cluster: auto (the one that runs here), HOST:PORT, or local, a new one on this machine
    (default local). [WHERE]"""
    collect: bool = False
    """Run nothing; gather the results that are there."""

    def run(self, console: Console) -> None:
        from gvtools.runs.folder import folder_lock
        from pipelines.fleet.run import Ray, report, run_fleet, this_machine, write_slurm
        from pipelines.fleet.spec import Task, is_url, read_list, tasks_of
        from pipelines.fleet.task import finished_record

        if self.engine != "ray":
            self.refuse(("address",), f"belongs to --engine ray, not {self.engine}")
        root = self.out.rstrip("/") if is_url(self.out) else str(Path(self.out).absolute())
        tasks = tasks_of(read_list(self.scenes), root, folder=self.scenes.absolute().parent)
        if self.engine == "slurm" and not self.collect:
            if is_url(root):
                raise OptionError(
                    f"--out {root}: expected a shared folder, which job scripts lie in"
                )
            script = write_slurm(tasks, Path(root))
            console.line(f"{len(tasks)} tasks; submit them with: bash {script}")
            console.line("then, when they have run: the same command with --collect")
            return
        # A second driver would begin the same commands; of a URL, the user has to take care.
        alone = nullcontext() if self.collect or is_url(root) else folder_lock(Path(root))
        with alone:
            left, finished = list[Task](), list[Task]()
            for task in () if self.collect else tasks:
                (left if finished_record(task) is None else finished).append(task)
            if left:
                pool: Threads | Ray = this_machine(left)
                if self.engine == "ray":
                    pool = Ray(left, address=self.address or "local", console=console)
                run_fleet(left, pool, finished=finished, console=console)
            elif not self.collect:
                console.line(f"all {len(tasks)} tasks were finished before")
            failed = report(tasks, root, console)
        if failed:
            first = failed[0]
            raise ProjectError(
                f"{self.out}: {len(failed)} of {len(tasks)} tasks are not done, first "
                f"{first['scene']} {first['stage']}: {first['reason']}; the same command tries "
                "them again"
            )
