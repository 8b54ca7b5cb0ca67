"""The report of a run: its content, collected from the run's folder and its project, and its files.

Targets are shown of every round, worst and best first; figures are those of an evaluation of this
run as it stands, else those that the run wrote itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.cameras import rigid_transform
from gvtools.errors import GvError, ProjectError, printable
from gvtools.evaluation.images import FIGURES
from gvtools.files import replaced_when_written, write_text
from gvtools.runs.context_depth import off_scale
from gvtools.runs.layout import COMPLETION, GUIDANCE, METRICS, VALID, round_folder
from gvtools.runs.run import Run, load_run
from gvtools.runs.target_files import entry_camera, read_picture
from gvtools.settings import dotted
from gvtools.untrusted import read_json
from gvtools.view_selection import evenly_spread, nearest_views
from pipelines.reconstruction.plan import scan_line
from pipelines.reconstruction.settings import RunSettings
from viz.plots.trajectories import Trajectories
from viz.report.page import Measures, ReportedPoses, RunReport, SheetRow, Sheets, report_html
from viz.report.pictures import Thumbnail, contact_row

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gvtools.runs.folder import RunDirectory
    from gvtools.scenes.scene import Scene, View
    from pipelines.reconstruction.plan import Plan

PAGE, GROWTH = "report.html", "growth.png"
EVALUATION = "evaluation/evaluation.json"
PICTURES = 12
# Of a round, from 1, that the paper's figure shows.
FRAMES = (1, 3, 5)
# Decoding and compressing leave the interpreter alone.
READERS = 2

Reports = Sequence[Mapping[str, Any]]


def draw_run(plan: Plan, directory: RunDirectory) -> tuple[str, ...]:
    """The growth figure and the report of a finished run whose project is open; their names."""
    from viz.plots.rounds import draw_growth

    figure = draw_growth(directory.reports(), title=plan.scene.root.name)
    with replaced_when_written(directory.path / GROWTH) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    write_report(plan, directory.path)
    return PAGE, GROWTH


def write_report(plan: Plan, path: Path) -> None:
    """The report of a run whose project is open."""
    targets = plan.targets
    truths = dict(zip(targets.cameras.names, targets.truth, strict=True))
    write_text(path / PAGE, report_html(collect(path, sources=ReportScenes(plan.scene, truths))))


@dataclass(frozen=True, eq=False)
class ReportScenes:
    """The photographs of a report."""

    scene: Scene | None  # the project, in the size that the run works in; None: cannot be read
    truths: Mapping[str, View | None]  # by the target's name the view that shows the truth
    problem: str | None = None  # why the project cannot be read


def open_sources(run: Run) -> ReportScenes:
    """The project of a run read again; an error becomes the ``problem``."""
    try:
        scene, truths = run.scenes
    except GvError as error:
        return ReportScenes(None, {}, str(error))
    by_name = {} if truths is None else {view.name: view for view in truths}
    return ReportScenes(scene, {name: by_name.get(name) for name in run.record["targets"]})


def load_started(path: Path, *, project: Path | None = None) -> Run:
    """A run with at least one whole round; ``project`` is where its project lies now."""
    run = load_run(path, project=project)
    if not run.rounds:
        raise ProjectError(f"{path}: no round is done yet; expected one; wait, or add --resume")
    return run


def collect(
    path: Path,
    *,
    sources: ReportScenes | None = None,
    project: Path | None = None,
    most: int = PICTURES,
) -> RunReport:
    """The report of a run's complete rounds, with the pictures of so many targets at most.

    ``sources`` is the project where it is open already, else ``project`` where it lies now.
    """
    run = load_started(path, project=project)
    record, reports = run.record, run.rounds
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
        poses=report_poses(reports, scene, record["context"], probe=measures.poses),
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
        *(
            ("refined", ", ".join(f"{value:g} {unit}" for unit, value in call.items()))
            for call in record.get("refined", [])
        ),
    ]


def _warnings(record: Mapping[str, Any], reports: Reports) -> Iterator[str]:
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


def nested(data: Mapping[str, Any] | None, path: str) -> Any:
    """The value at a path of keys, such as ``images.mean``; None where one is absent or null."""
    value: Any = data
    for key in path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


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
        content = read_json(file)
        if not isinstance(content, dict):
            raise ValueError(f"a {type(content).__name__}")
        return content
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
    reports: Reports,
    scene: Scene | None,
    context: Sequence[str],
    *,
    probe: Mapping[str, Any] | None,
) -> ReportedPoses:
    """Requested cameras of the rounds that are done, those of the context, and estimated ones.

    The latter, and their errors, are what the pose probe found.
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
    known = _estimated_poses(probe)
    if known:
        estimated = _inverted([known.get(view["name"]) for view in entries])
        note += (
            "Estimated: where the completed pictures look from, found from the pictures alone; a "
            "grey line leads to the requested camera. "
        )
    else:
        note += "No poses were estimated; gvtools evaluate does it. "
    if not len(requested) + len(given):
        return ReportedPoses(None, note.strip(), ())
    return ReportedPoses(Trajectories(given, requested, estimated), note.strip(), _errors(probe))


def _estimated_poses(probe: Mapping[str, Any] | None) -> dict[str, Any]:
    """cam_from_world by name, of what the pose probe found; None where it found none."""
    known: dict[str, Any] = {}
    for view in nested(probe, "views") or ():
        if not isinstance(view, dict) or not isinstance(view.get("name"), str):
            continue
        pose = view.get("cam_from_world")
        try:
            known[view["name"]] = None if pose is None else rigid_transform(pose, what="")[0]
        except (GvError, TypeError, ValueError):
            known[view["name"]] = None
    return known


def _inverted(poses: Sequence[Any]) -> NDArray[np.float64]:
    known = np.array([np.full((4, 4), np.nan) if pose is None else pose for pose in poses], float)
    return np.asarray(np.linalg.inv(known.reshape(-1, 4, 4)), np.float64)


def _errors(probe: Mapping[str, Any] | None) -> list[tuple[str, float | None, float | None]]:
    if probe is None or not probe.get("pictures"):
        return []
    rows = (
        ("located, share", "success_share"),
        ("ATE as estimated, rmse, scene units", "ate_none.rmse"),
        ("ATE after Sim(3) alignment, rmse, scene units", "ate_sim3.rmse"),
        ("RPE, rmse, scene units", "rpe_none.rmse"),
        ("rotation error, median, degrees", "ate_none.rotation_deg.median"),
    )
    true = probe.get("true_pictures")
    return [(label, nested(probe, path), nested(true, path)) for label, path in rows]


def chosen_targets(
    reports: Reports, psnr: Mapping[str, float | None], most: int
) -> list[tuple[int, int]]:
    """(round, place in the round) of at most ``most`` targets, in order.

    Every round gives its worst target first, then its best, its second worst and so on; with more
    rounds than ``most``, rounds are taken evenly from the first to the last. Where a target's PSNR
    is unknown, coverage decides.
    """
    queues: list[list[tuple[int, int]]] = []
    for number, report in enumerate(reports):
        views = report["views"]
        known = all(psnr.get(view["name"]) is not None for view in views)
        worth = [psnr[view["name"]] if known else view["coverage"] for view in views]
        order = np.argsort(np.array(worth, np.float64), kind="stable").tolist()
        alternating = [place for ends in zip(order, reversed(order), strict=True) for place in ends]
        queues.append([(number, place) for place in alternating[: len(views)]])
    queues = [queue for queue in queues if queue]
    if len(queues) > most:
        queues = [queues[i] for i in np.unique(np.linspace(0, len(queues) - 1, most).astype(int))]
    turns = [place for turn in zip_longest(*queues) for place in turn if place is not None]
    return sorted(turns[:most])


def contact_sheets(
    run: Run,
    *,
    psnr: Mapping[str, float | None],
    most: int,
    scene: Scene | None,
    truths: Mapping[str, View | None],
) -> Sheets:
    """The pictures of some of a run's targets, with PSNR where it was measured."""
    path, reports = run.path, run.rounds
    places = chosen_targets(reports, psnr, most)
    total = sum(len(report["views"]) for report in reports)
    given = None if scene is None or not run.context else scene.subset(run.context)

    def row(place: tuple[int, int]) -> SheetRow | str:
        number, at = place
        entry = reports[number]["views"][at]
        name = str(entry["name"])
        heading = f"round {number}: {name}, coverage {entry['coverage']:.1%}"
        if psnr.get(name) is not None:
            heading += f", PSNR {psnr[name]:.2f} dB"
        try:
            tiles = _pictures(path, number, entry, truth=truths.get(name), given=given)
            return SheetRow(heading, tiles)
        except (GvError, OSError, ValueError) as error:
            return f"pictures of {name} (round {number}) cannot be shown: {error}"

    with ThreadPoolExecutor(READERS) as pool:
        shown = list(pool.map(row, places))
    rows = tuple(one for one in shown if isinstance(one, SheetRow))
    folders = f"{path.resolve().name}/round_*"
    note = ""
    if total:
        note = f"{len(rows)} of {total} targets"
        if len(places) < total:
            note += (
                ": of each round its worst, then its best, and so on; the other "
                f"{total - len(rows)} lie in {folders}"
            )
        note += (
            f". Files in {folders}: guidance_* is the hint, valid_* the validity, generated_* the "
            "completion."
        )
        if not any(truths.values()):
            note += " No true pictures are at hand, so there are no error maps."
    return Sheets(rows, note, tuple(one for one in shown if isinstance(one, str)))


def _pictures(
    path: Path,
    number: int,
    entry: Mapping[str, Any],
    *,
    truth: View | None,
    given: Scene | None,
) -> list[Thumbnail]:
    folder, context = round_folder(path, number), None
    if given is not None:
        (place,) = nearest_views(given.cameras, entry_camera(entry), 1)
        context = given.views[place]
    kinds = {"hint": GUIDANCE, "support": VALID, "completion": COMPLETION}
    return contact_row(
        str(entry["name"]),
        **{name: read_picture(folder, kind, entry["stem"]) for name, kind in kinds.items()},
        truth=None if truth is None else truth.load(),
        context=context,
    )


def frame_rows(run: Run) -> list[tuple[str, list[NDArray[np.uint8] | None]]]:
    """Labels, and completed and true picture of each: two context views, then FRAMES of a round."""
    if not run.views:
        raise ProjectError(
            f"{run.path}: no target is completed yet; expected a round; add --resume"
        )
    sources = open_sources(run)
    columns: list[tuple[str, list[NDArray[np.uint8] | None]]] = []
    if sources.scene is not None:
        for name in evenly_spread(run.context, 2):
            columns.append((f"given: {name}", [sources.scene[name].load().rgb] * 2))
    for number in range(1, len(run.rounds)):
        of_round = [target for target in run.views if target.round == number]
        for frame in FRAMES:
            if frame <= len(of_round):
                target = of_round[frame - 1]
                truth = sources.truths.get(target.name)
                pictures = [target.read().picture, None if truth is None else truth.load().rgb]
                columns.append((f"round {number}, {frame}: {target.name}", pictures))
    return columns
