"""The search for settings that suit a scene and a budget: trials, their front, a recommendation."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gvtools
from gvtools.depth.source import RecordedDepth
from gvtools.errors import GvError
from gvtools.evaluation.tables import Column, Table, csv_text, markdown
from gvtools.files import digest, replaced_when_written, write_json, write_text
from gvtools.runs.folder import RunDirectory
from gvtools.runs.layout import METRICS
from gvtools.scenes.scene import Scene
from gvtools.settings import with_values
from gvtools.untrusted import read_json
from pipelines.console import Console, Silent
from pipelines.reconstruction.run import reconstruct
from pipelines.reconstruction.settings import RunSettings
from pipelines.tuning.options import FEWEST_VIEWS, TuneOptions
from viz.plots.curves import draw_pareto

if TYPE_CHECKING:
    from pipelines.reconstruction.plan import Plan

Settings = Mapping[str, Any]
START = "start"
# Trials that differ by less are equally accurate, dB.
EQUAL = 0.02
COLUMNS = (
    Column("trial"),
    Column("a run", "s", "lower", 1),
    Column("memory", "MiB", "lower", 1),
    Column("observations", "", "lower", 0),
    Column("PSNR", "dB", "higher", 2),
    Column("SSIM", "", "higher", 4),
    Column("observed", "dB", "higher", 2),
    Column("generated", "dB", "higher", 2),
    Column("depth error", "median", "lower", 4),
)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What a run with some settings takes, and its means over the targets."""

    label: str  # "start", "profile NAME", or the setting that it changes
    settings: dict[str, Any]  # by which it differs from the start
    seconds: float
    bytes: float  # of the memory at the end
    observations: int
    psnr: float  # dB, as all three
    ssim: float | None = None
    psnr_valid: float | None = None
    psnr_generated: float | None = None
    depth_rel_valid: float | None = None

    def __str__(self) -> str:
        return f"{self.psnr:.2f} dB, {self.seconds:.1f} s, {self.bytes / 2**20:.0f} MiB"


def planned_trials(
    plan: Plan, profiles: Mapping[str, Settings], *, budget: float | None = None
) -> dict[str, Settings]:
    """Settings of each trial by its label, the start first; those that are like another are absent.

    Profiles hold the settings that make the start, a plan with a voxel edge, to each of them. Every
    trial completes pictures of the start's size. Fits longer than the budget [s] are not planned.
    """
    trials: dict[str, Settings] = {
        f"profile {name}": {key: value for key, value in settings.items() if key != "max_side"}
        for name, settings in profiles.items()
    }
    for key, values in _values(plan, budget or math.inf).items():
        for value in values:
            text = f"{value:.4g}" if isinstance(value, float) else str(value).lower()
            trials[f"{key} {text}"] = {key: value}
    differing: dict[str, Settings] = {START: {}}
    configs = [plan.config]
    for label, settings in trials.items():
        config = changed(plan.config, settings).replaced(profile=plan.config.profile)
        if config not in configs:
            configs.append(config)
            differing[label] = settings
    return differing


def _values(plan: Plan, budget: float) -> dict[str, tuple[Any, ...]]:
    """Values worth a trial, by the setting's name, cheapest first."""
    config = plan.config
    voxel, far = config.voxel, config.memory.voxels_per_footprint
    assert voxel is not None
    values: dict[str, tuple[Any, ...]] = {
        "voxel": (2 * voxel, voxel / 2),
        "memory.voxels_per_footprint": (2 * far or 1.0, 0.0),
        "memory.observations_per_voxel": (4, 12, 48),
        "memory.merge_angle_deg": (8.0, 2.0, 0.0),
        "splat.backend": ("nearest",),
        "splat.nearest_views": (4,),
        "completer": ("none", "inpaint", "geoverse"),
        "views_per_round": (3, 6, 12),
    }
    if config.refine.wanted:
        fits = (0.0, 20.0, 60.0, 180.0)
        values["refine.seconds"] = tuple(seconds for seconds in fits if seconds < budget)
    if config.completer != "none":
        values["fusion.min_confidence"] = (0.35, 0.08, 0.0)
    if config.completer == "geoverse":
        values |= {
            "completer.steps": (1, 3),
            "completer.image_size": (252,),
            "effort.inpaint_below": (0.1, 0.02, 0.0),
        }
    tunable = plan.completer.weights is not None and len(plan.context) >= FEWEST_VIEWS
    if tunable and config.tune.steps is None:
        values["tune.minutes"] = (0.0, 1.0, 4.0)
    if plan.source.name != RecordedDepth.name:
        values["savings.depth_from_memory"] = (0.8, 0.9, None)
    if plan.source.name == "plane-sweep":
        values |= {
            "stereo.planes": (32, None),
            "stereo.sources": (2, 4),
            "stereo.max_side": (320, 640),
            "stereo.iterations": (0, 1),
        }
    return values


def changed(config: RunSettings, settings: Settings) -> RunSettings:
    """A run's settings with a trial's; one that names another completer says all of its options."""
    if settings.get("completer", config.completer) != config.completer:
        # Another completer need not have weights to tune.
        config = config.replaced(completer_options={}, tune=TuneOptions())
    return with_values(config, settings)


@dataclass(eq=False)
class Trials:
    """Runs with changed settings, each made once and stored in a JSON file.

    The start's voxel edge is set and its targets are held out. Other pictures, masks, weights or
    units, by ``run_identity`` of the start, are other trials.
    """

    scene: Scene
    config: RunSettings  # of the start
    folder: Path
    identity: Mapping[str, Any]
    _warm: bool = False

    def make(self, label: str, settings: Settings) -> Trial:
        """Run with these settings."""
        if not self._warm:
            # Kernels are compiled and files are cached once.
            self._warm = True
            self._run(label, {"rounds": 1})
        trial = self._run(label, settings)
        write_json(self._file(settings), asdict(trial))
        return trial

    def stored(self, label: str, settings: Settings) -> Trial | None:
        """The outcome of an earlier run; None if there is none, or its file is damaged."""
        try:
            return Trial(**read_json(self._file(settings)) | {"label": label})
        except (OSError, ValueError, TypeError):
            return None

    def _file(self, settings: Settings) -> Path:
        name = digest([self.identity, dict(settings), gvtools.__version__])
        return self.folder / f"{name}.json"

    def _run(self, label: str, settings: Settings) -> Trial:
        out = self.folder / "running"
        shutil.rmtree(out, ignore_errors=True)
        start = time.perf_counter()
        try:
            reconstruct(self.scene, changed(self.config, settings), out, console=Silent())
            seconds = time.perf_counter() - start
            report = RunDirectory(out).reports()[-1]
            figures = read_json(out / METRICS)
        finally:
            shutil.rmtree(out, ignore_errors=True)
        if figures["psnr"] is None:
            raise GvError("no target has a true picture to compare with; hold views out")
        names = ("observations", "psnr", "ssim", "psnr_valid", "psnr_generated", "depth_rel_valid")
        return Trial(
            label=label,
            settings=dict(settings),
            seconds=seconds,
            bytes=float(report["bytes"]),
            **{name: figures[name] for name in names},
        )


def run_trials(
    planned: Mapping[str, Settings],
    runs: Trials,
    *,
    limit: float,
    console: Console,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Trial]:
    """Make the trials in their order; those of earlier sweeps take no time.

    The limit is of all trials but the start [s]; those that would not fit are left out and named.
    """
    trials: list[Trial] = []
    left_out: list[str] = []
    end = clock() + limit
    for label, settings in planned.items():
        trial = runs.stored(label, settings)
        if trial is None and trials:
            # A trial is expected to take as long as the start and its tuning, or the time of its
            # fit.
            tuning = 60 * settings.get("tune.minutes", 0.0)
            fit = settings.get("refine.seconds") or 0.0
            if clock() + max(trials[0].seconds + tuning, fit) > end:
                left_out.append(label)
                continue
        try:
            trial = trial or runs.make(label, settings)
        except GvError as error:
            # Without the start there is nothing to compare with.
            if not trials:
                raise
            console.line(f"{label}: refused, {error}")
            continue
        trials.append(trial)
        console.line(f"{label}: {trial}")
    if left_out:
        console.warn(
            f"{len(left_out)} trials were left out for --limit: {', '.join(left_out[:4])}; "
            "the same command with a longer one goes on"
        )
    return trials


def pareto_front(trials: Sequence[Trial]) -> list[Trial]:
    """Trials that no other beats in both time and PSNR, fastest first."""
    front: list[Trial] = []
    for trial in sorted(trials, key=lambda trial: (trial.seconds, -trial.psnr)):
        if not front or trial.psnr > front[-1].psnr:
            front.append(trial)
    return front


def recommended(trials: Sequence[Trial], budget: float | None) -> Trial | None:
    """The most accurate trial within the budget [s], of equal ones the fastest; or None."""
    within = [trial for trial in trials if budget is None or trial.seconds <= budget]
    highest = max((trial.psnr for trial in within), default=0.0)
    best = [trial for trial in within if trial.psnr >= highest - EQUAL]
    return min(best, key=lambda trial: trial.seconds, default=None)


def write_results(
    trials: Sequence[Trial], out: Path, *, title: str, budget: float | None, console: Console
) -> Trial | None:
    """Write trials.csv, front.csv and front.png, print them, and return the recommended trial."""
    best, chosen = pareto_front(trials), recommended(trials, budget)
    figure = draw_pareto(trials, front=best, chosen=chosen, budget=budget, title=title)
    with replaced_when_written(out / "front.png") as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    for name, rows, caption in (
        ("trials", trials, "Trials"),
        ("front", best, "Pareto front of time and PSNR"),
    ):
        table = _table(rows, caption)
        write_text(out / f"{name}.csv", csv_text(table))
        console.line(markdown(table))
    if chosen is None:
        cheapest = min(trials, key=lambda trial: trial.seconds)
        console.warn(
            f"no trial is within the budget; the cheapest takes {cheapest.seconds:.1f} s; "
            "no profile.json is written"
        )
        return None
    console.line(f"recommended: {chosen.label}, {chosen}")
    return chosen


def _table(trials: Sequence[Trial], caption: str) -> Table:
    rows = [
        (t.label, t.seconds, t.bytes / 2**20, t.observations, t.psnr, t.ssim, t.psnr_valid,
         t.psnr_generated, t.depth_rel_valid)
        for t in trials
    ]  # fmt: skip
    return Table(COLUMNS, tuple(rows), caption)
