"""What was measured on a run, for its report: figures of pictures, and poses found in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.cameras import rigid_transform
from gvtools.errors import GvError, printable
from gvtools.evaluation.images import FIGURES
from gvtools.runs.layout import METRICS
from gvtools.untrusted import read_json
from pipelines.report.nested import nested
from viz.plots.trajectories import Trajectories
from viz.report.content import Measures, Poses

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gvtools.runs.run import Run
    from gvtools.scenes.scene import Scene

EVALUATION = "evaluation/evaluation.json"


def read_measures(run: Run) -> Measures:
    """Of evaluation/evaluation.json where it is of this run as it stands, else of metrics.json."""
    try:
        return _measures(run)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        line = (
            f"{METRICS} or {EVALUATION} is of another form ({error!r}); gvtools evaluate renews it"
        )
        return Measures(warnings=[printable(line)])


def _measures(run: Run) -> Measures:
    names = [view.name for view in run.views]
    warnings: list[str] = []
    evaluation, entry = _read(run.path / EVALUATION, warnings), None
    if evaluation is not None:
        entry = _of_this_run(evaluation, run.record, names)
        if entry is None:
            warnings.append(
                f"{EVALUATION} is of another state of this run; gvtools evaluate renews it"
            )
    poses = None if entry is None else entry.get("poses")
    if entry is not None and "images" in entry:
        images = entry["images"]
        means = {name: images["mean"][name] for name in FIGURES}
        return Measures(
            EVALUATION,
            {name: mean["mean"] for name, mean in means.items()},
            {
                name: (mean["low"], mean["high"])
                for name, mean in means.items()
                if mean["low"] is not None and mean["high"] is not None
            },
            images["views"],
            list(images["notes"].values()),
            poses,
            warnings,
        )
    metrics = _read(run.path / METRICS, warnings)
    if metrics is None:
        note = (
            f"There is no {METRICS} yet; a run writes it at its end, gvtools evaluate at any time"
        )
        return Measures(notes=[note], poses=poses, warnings=warnings)
    if not _measured(metrics, names):
        warnings.append(f"{METRICS} is of another state of this run; gvtools evaluate renews it")
        return Measures(poses=poses, warnings=warnings)
    figures = {name: metrics.get(name) for name in FIGURES}
    notes = metrics.get("notes", ())
    return Measures(METRICS, figures, {}, metrics["views"], notes, poses, warnings)


def _read(file: Path, warnings: list[str]) -> dict[str, Any] | None:
    if not file.is_file():
        return None
    try:
        found = read_json(file)
        if not isinstance(found, dict):
            raise ValueError(f"a {type(found).__name__}")
        return found
    except (OSError, ValueError) as error:
        warnings.append(f"{file.name} cannot be read ({error})")
        return None


def _of_this_run(
    evaluation: Mapping[str, Any], record: Mapping[str, Any], names: Sequence[str]
) -> Mapping[str, Any] | None:
    """The entry of an evaluation that measured exactly these targets of exactly this run."""
    for entry in evaluation.get("runs", ()):
        same = all(entry.get(key) == record[key] for key in ("settings", "derived", "project"))
        if same and _measured(entry.get("images", entry.get("poses", {})), names):
            return dict(entry)
    return None


def _measured(part: Mapping[str, Any], names: Sequence[str]) -> bool:
    """Whether a part of an evaluation is of exactly these targets, in their order."""
    return [view.get("name") for view in part.get("views", ())] == list(names)


def report_poses(
    reports: Sequence[Mapping[str, Any]],
    scene: Scene | None,
    context: Sequence[str],
    *,
    found: Mapping[str, Any] | None,
) -> Poses:
    """Requested cameras of the rounds that are done, those of the context, and estimated ones.

    Args:
        reports: of all rounds.
        scene: the project; None where it cannot be read.
        context: names of the given views.
        found: what the pose probe found.
    """
    entries = [view for report in reports for view in report["views"]]
    requested = _inverted([view["camera"]["cam_from_world"] for view in entries])
    given = np.zeros((0, 4, 4))
    if scene is not None and context:
        given = scene.subset(context).cameras.world_from_cam
    estimated = None
    note = "Lines from the marks: viewing directions. "
    if scene is None:
        note += "The context's cameras are missing, since the project cannot be read. "
    known = _found_poses(found)
    if known:
        estimated = _inverted([known.get(view["name"]) for view in entries])
        note += (
            "Estimated: where the completed pictures look from, found from the pictures alone; a "
            "grey line leads to the requested camera. "
        )
    else:
        note += "No poses were estimated; gvtools evaluate does it. "
    if not len(requested) + len(given):
        return Poses(None, note.strip(), ())
    return Poses(Trajectories(given, requested, estimated), note.strip(), _errors(found))


def _found_poses(found: Mapping[str, Any] | None) -> dict[str, Any]:
    """cam_from_world by name, of what the pose probe found; None where it found none."""
    known: dict[str, Any] = {}
    for view in nested(found, "views") or ():
        if not isinstance(view, dict) or not isinstance(view.get("name"), str):
            continue
        pose = view.get("cam_from_world")
        try:
            known[view["name"]] = None if pose is None else rigid_transform(pose, what="")[0]
        except (GvError, TypeError, ValueError):
            known[view["name"]] = None
    return known


def _inverted(poses: Sequence[Any]) -> NDArray[np.float64]:
    out = np.full((len(poses), 4, 4), np.nan)
    for row, pose in enumerate(poses):
        if pose is not None:
            out[row] = np.linalg.inv(np.array(pose, np.float64))
    return out


def _errors(found: Mapping[str, Any] | None) -> list[tuple[str, float | None, float | None]]:
    if found is None or not found.get("pictures"):
        return []
    rows = (
        ("located, share", ("success_share",)),
        ("ATE as estimated, rmse, scene units", ("ate_none", "rmse")),
        ("ATE after Sim(3) alignment, rmse, scene units", ("ate_sim3", "rmse")),
        ("RPE, rmse, scene units", ("rpe_none", "rmse")),
        ("rotation error, median, degrees", ("ate_none", "rotation_deg", "median")),
    )
    true = found.get("true_pictures")
    return [(label, nested(found, *keys), nested(true, *keys)) for label, keys in rows]
