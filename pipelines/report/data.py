"""Everything that a run's report tells, collected from the run's folder and its project."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gvtools.errors import GvError, ProjectError
from gvtools.runs.context_depth import off_scale
from gvtools.runs.run import Run, load_run
from gvtools.settings import dotted
from pipelines.reconstruction.plan import scan_line
from pipelines.reconstruction.settings import RunSettings
from pipelines.report.measures import read_measures, report_poses
from pipelines.report.sheets import contact_sheets
from viz.report.content import RunReport

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene, View

PICTURES = 12


@dataclass(frozen=True, eq=False)
class Sources:
    """Where a report's photographs come from.

    Attributes:
        scene: the project, in the size that the run works in; None where it cannot be read.
        truths: by the target's name the view that shows the truth, if any.
        problem: why the project cannot be read.
    """

    scene: Scene | None
    truths: Mapping[str, View | None]
    problem: str | None = None


def open_sources(run: Run) -> Sources:
    """The project of a run read again; an error becomes the ``problem``."""
    try:
        scene, truths = run.scenes
    except GvError as error:
        return Sources(None, {}, str(error))
    by_name = {} if truths is None else {view.name: view for view in truths}
    return Sources(scene, {name: by_name.get(name) for name in run.record["targets"]})


def collect(
    path: Path, *, sources: Sources | None = None, project: Path | None = None, most: int = PICTURES
) -> RunReport:
    """What the report of a run shows, of its complete rounds.

    Args:
        path: the run's folder.
        sources: the project, where it is open already.
        project: where it lies now, where it is not; None: where it lay.
        most: targets whose pictures are shown.
    """
    run = load_run(path, project=project)
    record, reports = run.record, run.rounds
    if not reports:
        raise ProjectError(f"{path}: no round is done yet; expected one; wait, or add --resume")
    sources = sources or open_sources(run)
    measures = read_measures(run)
    psnr = {view["name"]: view.get("psnr") for view in measures.views}
    scene, truths = sources.scene, sources.truths
    sheets = contact_sheets(run, psnr=psnr, most=most, scene=scene, truths=truths)
    settings = dotted(run.settings)
    return RunReport(
        title=f"{path.resolve().name}: a run of gvtools",
        facts=_facts(run),
        rounds=reports,
        changed=_changed(dotted(record["settings"])),
        settings={key: _as_text(value) for key, value in settings.items()},
        warnings=[
            *_warnings(record, reports),
            *([] if sources.problem is None else [f"no photographs: {sources.problem}"]),
            *measures.warnings,
            *sheets.warnings,
        ],
        measures=measures,
        sheets=sheets,
        poses=report_poses(reports, scene, record["context"], found=measures.poses),
    )


def _facts(run: Run) -> list[tuple[str, str]]:
    record, config, reports = run.record, run.settings, run.rounds
    done = len(reports) - 1
    planned = len(record["schedule"])
    return [
        ("project", str(record["project"])),
        ("context", f"{len(record['context'])} views"),
        ("targets", f"{len(record['targets'])} ({record['targets_kind']})"),
        ("rounds", str(done) if done == planned else f"{done} of {planned}"),
        ("completer", str(config["completer"])),
        *([("scan", scan_line(reports[0]["scan"]))] if reports[0].get("scan") else []),
        *([("colours", reports[0]["colours"])] if reports[0].get("colours") else []),
        ("voxel", f"{config['voxel']:g} scene units"),
        ("seed", str(config["seed"])),
        ("gvtools", str(record["versions"].get("gvtools", "?"))),
        *[("refined", _refined(call)) for call in record.get("refined", [])],
    ]


def _refined(call: Mapping[str, Any]) -> str:
    return ", ".join(f"{value:g} {unit}" for unit, value in call.items())


def _warnings(record: Mapping[str, Any], reports: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    planned = len(record["schedule"])
    if len(reports) - 1 < planned:
        yield (
            f"the run is not finished: {len(reports) - 1} of {planned} rounds are done; "
            "gvtools reconstruct ... --resume goes on, gvtools report renews this page"
        )
    scheduled = sum(len(rows) for rows in record["schedule"])
    if scheduled < len(record["targets"]):
        yield f"{len(record['targets']) - scheduled} targets are in no round"
    depth = reports[0].get("depth", ())
    flagged = off_scale([entry for entry in depth if "scale" in entry])
    if flagged:
        yield flagged
    failed = [str(entry["view"]) for entry in depth if entry.get("failed")]
    if failed:
        yield f"no depth was found for {len(failed)} of {len(depth)} context views: {_few(failed)}"
    for report in reports[1:]:
        refused = [view for view in report["views"] if not view["scale"]["accepted"]]
        if refused:
            yield (
                f"round {report['round']}: {len(refused)} of {len(report['views'])} completions "
                f"gave no points: {_few([str(view['name']) for view in refused])} "
                f"({refused[0]['scale']['description']})"
            )


def _few(names: Sequence[str], most: int = 4) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


def _changed(settings: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Settings that differ from the defaults, with both."""
    defaults = dotted(RunSettings().to_dict())
    return [
        (key, _as_text(value), _as_text(defaults[key]) if key in defaults else "none")
        for key, value in settings.items()
        if key not in defaults or value != defaults[key]
    ]


def _as_text(value: object) -> str:
    return "not set" if value is None else str(value)
