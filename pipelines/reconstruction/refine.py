"""Further fitting of a run's Gaussians; the run is then made again with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import OptionError, ProjectError
from gvtools.files import folder_replaced_when_written, only_in, recover_folder
from gvtools.runs.folder import RunDirectory, changed_keys
from gvtools.runs.folder_lock import folder_lock
from gvtools.runs.layout import APPEARANCE, METRICS, round_folder
from gvtools.runs.run import Run, load_run
from gvtools.scenes.data_sets.address import is_address
from gvtools.scenes.reading import open_recorded
from gvtools.settings import dotted, with_values
from gvtools.untrusted import read_json
from pipelines.reconstruction.compile_kernels import compile_kernels
from pipelines.reconstruction.fitting import Fitted, fit_appearance
from pipelines.reconstruction.plan import Plan, describe, make_plan, run_identity
from pipelines.reconstruction.run import Draw, complete_run, say_results
from pipelines.reconstruction.scan import placed_scan
from pipelines.reconstruction.settings import RunSettings

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console

# In run.json: what each call was given, the first one first.
REFINED = "refined"


def refine(
    path: Path,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    project: Path | None = None,
    console: Console,
    draw: Draw | None = None,
) -> Path:
    """Fit a run's Gaussians further, and make all of its rounds again with them.

    The new run is written beside the earlier one, which it replaces when it is complete.

    Args:
        path: the run's folder; the run need not be finished.
        seconds: how long to fit; None counts steps.
        steps: how many steps, where no time is given.
        project: where the run's project lies now; None: where it lay.
        console: where progress and figures go.
        draw: see ``reconstruct``.

    Returns:
        The run's folder.
    """
    # A link stays one: what it leads to is replaced.
    place = path.resolve()
    recover_folder(place)
    run = load_run(path, project=project)
    plan, identity = _reopened(run, console)
    asked = {"seconds": seconds} if steps is None else {"steps": steps}
    options = plan.config.refine.replaced(**{"seconds": None, "steps": None, **asked})
    plan = replace(plan, config=plan.config.replaced(refine=options))
    compile_kernels(plan.config, console)
    describe(plan, console)
    earlier = _earlier(run, console)
    with folder_lock(place), folder_replaced_when_written(place) as folder:
        plan = plan.posed
        plan = replace(plan, scan=placed_scan(plan, console))
        fitted = fit_appearance(plan, console, earlier=earlier)
        if fitted is None:
            raise ProjectError(
                f"{path}: no Gaussians can be fitted to its context that show more than the "
                "memory; expected photographs with sparse points or recorded depth, and time for "
                "a fit; the run is as it was"
            )
        directory = RunDirectory(folder)
        history = [*run.record.get(REFINED, []), asked]
        with directory.open_or_resume({**identity, REFINED: history}, resume=False):
            drawn = complete_run(plan, directory, fitted=fitted, console=console, draw=draw)
        before, after = _figures(path), _figures(folder)
        others = only_in(path, folder)
    say_results(RunDirectory(path), drawn, console)
    if before.get("psnr") and after.get("psnr"):
        console.line(f"refined: PSNR {before['psnr']:.2f} -> {after['psnr']:.2f} dB")
    if others:
        console.warn(f"{', '.join(others)} in {path}: kept, of the run before it was refined")
    return path


def _reopened(run: Run, console: Console) -> tuple[Plan, Mapping[str, Any]]:
    """The plan of a run and its identity."""
    record = run.record
    try:
        settings = with_values(RunSettings(), dotted(record["settings"]))
    except OptionError as error:
        raise ProjectError(
            f"{run.path}: settings of another version ({error}); run reconstruct again"
        ) from None
    begun = round_folder(run.path, 0) if run.rounds else None
    scene = _project_of(run)
    plan = make_plan(scene, settings, say=console.line, round_0=begun)
    identity = run_identity(plan, record["reading"])
    changed = changed_keys(identity, record)
    if run.project is not None and "project" in changed:
        changed.remove("project")
    if changed:
        raise ProjectError(
            f"{run.path}: its project {scene.root} is not as it was when the run was made "
            f"({', '.join(changed)} differ); expected it unchanged; run reconstruct again"
        )
    return plan, identity


def _project_of(run: Run) -> Scene:
    """The project of a run."""
    project, reading = run.record["project"], run.record["reading"]
    place = Path(reading["root"] if is_address(project) else project)
    if not (run.project or place).exists():
        raise ProjectError(
            f"{run.path}: its project {run.project or place} is gone; say by --project where it is"
        )
    return open_recorded(project, reading, moved=run.project)


def _earlier(run: Run, console: Console) -> Fitted | None:
    """The fit of a run; None where it was made without, or stopped before it was saved."""
    saved = round_folder(run.path, 0) / APPEARANCE
    if run.rounds and saved.exists():
        return Fitted.load(saved)
    console.line(f"{run.path}: holds no fitted Gaussians; the fit begins anew")
    return None


def _figures(path: Path) -> Mapping[str, Any]:
    """The means of a run's metrics.json; none where the run is not finished."""
    try:
        figures = read_json(path / METRICS)
    except (OSError, ValueError):
        return {}
    return figures if isinstance(figures, dict) else {}
