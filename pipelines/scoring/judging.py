"""Several methods' pictures measured on the same targets, with tables and contact sheets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.images import better_reading
from gvtools.evaluation.picture_sets import (
    Matching,
    MethodPicture,
    PictureSet,
    match_pictures,
    open_pictures,
)
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.evaluation.tables import csv_text
from gvtools.files import replaced_when_written, write_json, write_text
from gvtools.runs.layout import RECORD
from gvtools.runs.poses import refined_poses_of
from gvtools.runs.run import Run, RunTarget, load_memory, load_run
from gvtools.runs.target_files import to_bytes
from gvtools.scenes.inspection import spread
from gvtools.scenes.scene import Frame
from pipelines.console import Console
from pipelines.scoring.evaluation import provenance
from pipelines.scoring.measurement import (
    JUDGED,
    MeasuredTarget,
    Measurement,
    MeasureOptions,
    context_pictures,
    load_measured,
    matcher_called,
    run_targets,
    true_pictures,
)
from pipelines.scoring.tables import differences, judge_markdown, judge_tables, print_judgement
from viz.report.pictures import JudgedView, method_sheet

if TYPE_CHECKING:
    from gvtools.cameras import Cameras
    from gvtools.evaluation.tables import Table
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import Scene


OWN_LAYOUT = "gvtools run"
# A picture has its target's aspect when its height differs by at most this from the height that
# its width and the target's aspect give, pixels.
SHAPE_TOLERANCE = 1.0
# Pictures are compared with the truths of all views as thumbnails (width, height). They are taken
# for those of another view where its truth is nearer by more than this factor.
THUMBNAIL = (32, 24)
CLEARLY = 2.0
# Pictures that tell whether all are to be read otherwise.
READINGS = 8


@dataclass(frozen=True, eq=False)
class JudgeReference:
    """A run with a memory, seen as what other methods' pictures are compared with."""

    run: Run
    cameras: Path | None = None  # trajectory of the pictures' cameras; None takes the run's targets
    _surfaces: dict[tuple[str, int], NDArray[np.float32]] = field(default_factory=dict, repr=False)

    @cached_property
    def memory(self) -> SpatialMemory:
        """What the context alone gave."""
        return load_memory(self.run.path, up_to=0)

    @cached_property
    def targets(self) -> list[MeasuredTarget]:
        """The targets with the run's own pictures, or the memory's where cameras were given."""
        return run_targets(self.run) if self.cameras is None else self._projected(self.cameras)

    @property
    def others(self) -> tuple[str, ...]:
        """Names of the project's views that are not judged."""
        if self.cameras is not None:
            return ()
        judged = {target.picture.name for target in self.targets}
        scene, truths = self.run.scenes
        return tuple(name for name in (truths or scene).names if name not in judged)

    def with_surfaces(self, targets: Sequence[MeasuredTarget]) -> list[MeasuredTarget]:
        """The targets, those whose picture has no depth of its own with the memory's."""
        return [t if t.picture.depth is not None else self._with_surface(t) for t in targets]

    def _with_surface(self, target: MeasuredTarget) -> MeasuredTarget:
        if target.key not in self._surfaces:
            self._surfaces[target.key] = self.memory.project(target.picture.camera).depth[0]
        return replace(target, surface=self._surfaces[target.key])

    @property
    def poses(self) -> str:
        """Whose the poses of the targets and the context are."""
        if self.cameras is not None and refined_poses_of(self.run.path) is not None:
            return f"as given in {self.cameras}; the context's refined by the run"
        return "recorded" if refined_poses_of(self.run.path) is None else "refined by the run"

    def context(self) -> list[PosedPicture]:
        """The context views with the memory's depth."""
        return context_pictures(self.run, self.memory)

    def _projected(self, cameras: Path) -> list[MeasuredTarget]:
        from gvtools.trajectory_files import read_trajectory

        context = self.run.scenes[0].subset(self.run.context).cameras
        targets = []
        for camera in read_trajectory(cameras, context[0], beside=context):
            seen = self.memory.project(camera)
            picture = PosedPicture(camera.names[0], camera, to_bytes(seen.rgb[0]))
            observed = seen.valid[0] & ~seen.generated[0]
            targets.append(MeasuredTarget(1, picture, observed, ~observed, None))
        return targets


def open_reference(path: Path, *, cameras: Path | None) -> JudgeReference:
    """The run at ``path``; ``cameras`` as of JudgeReference."""
    return JudgeReference(load_measured(path) if cameras is None else load_run(path), cameras)


def reference_from_context(
    scene: Scene,
    out: Path,
    *,
    context: str | None,
    targets: str | None,
    cameras: Path | None,
    reading: Mapping[str, Any],
    console: Console,
) -> JudgeReference:
    """A run in ``out`` of a project's context alone; one that is there is resumed.

    Context and targets select views: those given, and those that the pictures stand for, unless a
    trajectory file has the cameras of the pictures.
    """
    from gvtools.settings import with_values
    from pipelines.reconstruction.run import reconstruct
    from pipelines.reconstruction.settings import RunSettings

    if context is None or (targets is None and cameras is None):
        raise OptionError(
            "--against a project: expected --context with the views that the methods were given, "
            "and --targets with those that the pictures stand for; or give a finished run"
        )
    values = {
        "context": context,
        "targets": targets if cameras is None else str(cameras),
        # One round: nothing is added to the memory between the targets.
        "views_per_round": max(len(scene), 1) if cameras is None else 1_000_000,
        "completer": "none",
        "refine.steps": 0,
        # Where other methods were told that the cameras stand.
        "refine.poses": False,
    }
    console.line(f"fusing the context into {out}")
    # What a run says of the memory's own pictures would be mistaken for a judgement.
    config, quiet = with_values(RunSettings(), values), Console(quiet=True)
    resume = (out / RECORD).is_file()
    reconstruct(scene, config, out, console=quiet, resume=resume, reading=reading)
    return JudgeReference(load_run(out))


@dataclass(frozen=True, eq=False)
class MethodPictures:
    """One method's pictures."""

    name: str
    pictures: PictureSet  # as they lie in their folder
    matching: Matching  # which picture stands for which target
    targets: list[MeasuredTarget]  # those that the method has a picture of, each with this picture
    # Sizes (width, height) of the pictures that were resized to their target's, and how many.
    resized: dict[tuple[int, int], int]
    # Whether they are of these targets, and as they should be; nothing where all speaks for it.
    doubts: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """What was read and how, JSON-ready."""
        sizes = {
            (int(t.picture.camera.width[0]), int(t.picture.camera.height[0])) for t in self.targets
        }
        depth = "own" if any(t.picture.depth is not None for t in self.targets) else None
        if depth is None and any(t.surface is not None for t in self.targets):
            depth = "none; features are carried by the memory's"
        return {
            "name": self.name,
            "pictures": str(self.pictures.path),
            "layout": self.pictures.layout,
            "matched_by": self.matching.rule,
            "found": len(self.pictures.pictures),
            "missing": list(self.matching.missing),
            "left_over": list(self.matching.left_over),
            "sizes": [list(size) for size in sorted(sizes)],
            "resized": [
                {"from": list(size), "pictures": count}
                for size, count in sorted(self.resized.items())
            ],
            "depth": depth,
            "reading": [*self.pictures.notes, *self.doubts],
        }


def method_names(paths: Sequence[Path], names: Sequence[str]) -> list[str]:
    """A name for each method: those given, else the folders'."""
    if names and len(names) != len(paths):
        raise OptionError(
            f"{len(names)} names (--name) for {len(paths)} folders; give one for each"
        )
    chosen = list(names) or [path.resolve().name for path in paths]
    if not names and len(set(chosen)) < len(chosen):
        chosen = [f"{path.resolve().parent.name}/{path.resolve().name}" for path in paths]
    for name in chosen:
        if chosen.count(name) > 1:
            raise OptionError(f"two methods are called {name!r}; tell them apart with --name")
    return chosen


def open_method(
    path: Path,
    name: str,
    targets: Sequence[MeasuredTarget],
    *,
    rule: str,
    others: Sequence[str] = (),
) -> MethodPictures:
    """The pictures of a run of gvtools, or those that ``open_pictures`` reads, for the targets."""
    pictures = _run_pictures(path) if (path / RECORD).is_file() else open_pictures(path)
    views = [target.picture.name for target in targets]
    matching = match_pictures(
        pictures.names, views, others=others, rule=rule, what=str(path),
        alphabetical=pictures.alphabetical,
    )  # fmt: skip
    matched, resized, opaque = [], dict[tuple[int, int], int](), list[float]()
    for target, number in zip(targets, matching.picture_of, strict=True):
        if number is None:
            continue
        picture, view = pictures.pictures[number], target.picture
        frame, size = _at_size(picture.load(), view.camera, what=f"{path}: {picture.name}")
        if size is not None:
            resized[size] = resized.get(size, 0) + 1
        opaque.append(1.0 if frame.mask is None else float(frame.mask.mean()))
        posed = PosedPicture(view.name, view.camera, frame.rgb, frame.depth)
        matched.append(replace(target, picture=posed))
    doubts = [_doubt(pictures, matching, targets, matched=matched) or _other_reading(matched)]
    if clear := [1 - share for share in opaque if share < 1]:
        doubts.append(
            f"{len(clear)} of {len(matched)} pictures have transparent pixels ({np.mean(clear):.1%}"
            " of them), which lie before black here; where that is not meant, save them without"
        )
    return MethodPictures(name, pictures, matching, matched, resized, tuple(filter(None, doubts)))


def _run_pictures(path: Path) -> PictureSet:
    """What a run of gvtools completed, with its depth."""
    run = load_run(path)

    def load(view: RunTarget) -> Frame:
        files = view.read()
        return Frame(files.picture, files.depth)

    pictures = tuple(MethodPicture(view.name, partial(load, view)) for view in run.views)
    return PictureSet(path, OWN_LAYOUT, pictures)


def _at_size(frame: Frame, camera: Cameras, *, what: str) -> tuple[Frame, tuple[int, int] | None]:
    """The picture in its target's size, and the size (width, height) that it had if another."""
    import cv2

    width, height = int(camera.width[0]), int(camera.height[0])
    rows, columns = frame.rgb.shape[:2]
    if (columns, rows) == (width, height):
        return frame, None
    expected = height * columns / width
    if abs(rows - expected) > SHAPE_TOLERANCE:
        turned = " (an orientation tag is not applied)" * (columns * width == rows * height)
        raise ProjectError(
            f"{what} has {columns}x{rows} pixels; expected {width}x{height} like its view, or the "
            f"same shape in another size{turned}; render it from the view's camera"
        )
    way = cv2.INTER_AREA if columns > width else cv2.INTER_CUBIC
    rgb = np.asarray(cv2.resize(frame.rgb, (width, height), interpolation=way), np.uint8)
    depth = frame.depth
    if depth is not None:
        depth = np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST))
    return Frame(rgb, depth, frame.mask), (columns, rows)


def _doubt(
    pictures: PictureSet,
    matching: Matching,
    targets: Sequence[MeasuredTarget],
    *,
    matched: Sequence[MeasuredTarget],
) -> str:
    """What is said where most pictures are nearer to the truth of another target; else nothing.

    Where a tool wrote the ground truth beside all of its renders, that is compared, and the first
    one that is another target's is refused.
    """
    loads = [picture.load_truth for picture in pictures.pictures]
    rows = [row for row, target in enumerate(targets) if target.truth is not None]
    if not rows:
        return ""
    own, off = {target.key: target.picture.rgb for target in matched}, list[str]()
    truths = np.stack([_thumbnail(t.truth.rgb) for t in targets if t.truth is not None])
    for row in rows:
        number = matching.picture_of[row]
        if number is None:
            continue
        load = loads[number] if all(loads) else None
        shown = _thumbnail(own[targets[row].key] if load is None else load())
        distance = np.abs(truths - shown).mean(axis=(1, 2, 3))
        best = int(distance.argmin())
        if distance[rows.index(row)] <= CLEARLY * distance[best]:
            continue
        off.append(
            f"{pictures.names[number]} stands for {targets[row].picture.name} by its "
            f"{matching.rule}, but {'it shows' if load is None else 'the truth beside it is'} "
            f"{targets[rows[best]].picture.name}"
        )
        if load is not None:
            raise ProjectError(
                f"{pictures.path}: {off[0]}; expected the same views in the same order; give the "
                "same --targets"
            )
    if len(off) <= len(matched) / 2:
        return ""
    return f"{len(off)} of {len(matched)} pictures look like other views ({off[0]})"


def _other_reading(matched: Sequence[MeasuredTarget]) -> str:
    """What is said where a few pictures would all fit their truths far better if read otherwise."""
    true = [(target.picture.rgb, target.truth) for target in matched if target.truth is not None]
    some = [true[row] for row in spread(len(true), READINGS)]
    found = better_reading([rgb for rgb, _ in some], [truth for _, truth in some])
    return found and f"its pictures seem to be {found}"


def _thumbnail(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    import cv2

    return np.asarray(cv2.resize(rgb, THUMBNAIL, interpolation=cv2.INTER_AREA), np.float32)


VIEWS_A_SHEET = 4


def judge(
    paths: Sequence[Path],
    names: Sequence[str],
    reference: JudgeReference,
    *,
    options: MeasureOptions,
    rule: str,
    sheet_views: int,
    out: Path,
    console: Console,
) -> dict[str, Any]:
    """Measure the methods, write figures, tables and sheets, print the table.

    Pictures are matched with views by a rule of ``match_pictures``. The figures are what
    ``judge.json`` holds.
    """
    targets = reference.targets
    measurement = Measurement(
        options=options,
        context=reference.context,
        truths=true_pictures(targets),
        names=JUDGED,
        console=console,
        matcher=matcher_called(options.matcher),
    )
    shown = {targets[row].key: targets[row] for row in spread(len(targets), sheet_views)}
    on_sheets: dict[str, dict[tuple[str, int], NDArray[np.uint8]]] = {}

    def measure(path: Path, name: str) -> dict[str, Any]:
        method = open_method(path, name, targets, rule=rule, others=reference.others)
        if "consistency" in options.parts:
            # Pictures without depth get the memory's.
            method = replace(method, targets=reference.with_surfaces(method.targets))
        _print_matching(method, len(targets), console)
        on_sheets[name] = {t.key: t.picture.rgb for t in method.targets if t.key in shown}
        return {
            **method.to_dict(),
            "rounds": max((target.number for target in method.targets), default=0),
            "views": len(method.targets),
            **measurement.of(method.targets),
        }

    measured = [measure(path, name) for path, name in zip(paths, names, strict=True)]
    figures = {
        "against": str(reference.run.path),
        "project": reference.run.record["project"],
        "context": list(reference.run.context),
        "poses": reference.poses,
        "cameras": None if reference.cameras is None else str(reference.cameras),
        "targets": [target.picture.name for target in targets],
        "with_truth": sum(target.truth is not None for target in targets),
        "methods": measured,
        "differences": differences(measured, options.seed) if "images" in options.parts else [],
        "judge": {
            "parts": list(options.parts),
            "matcher": options.matcher,
            "control": options.control,
            "rule": rule,
            "sheet_views": sheet_views,
            "seed": options.seed,
            "lpips_net": options.lpips_net,
            "lpips_measured": options.lpips is not None,
            **provenance(),
        },
    }
    tables = judge_tables(figures)
    views = [
        JudgedView(
            name=target.picture.name,
            truth=None if target.truth is None else target.truth.rgb,
            mask=None if target.truth is None else target.truth.mask,
            never_observed=~target.observed,
            pictures={name: own.get(key) for name, own in on_sheets.items()},
        )
        for key, target in shown.items()
    ]
    files = _write(figures, tables, views, out=out)
    print_judgement(tables, console)
    console.line(
        f"results in {out}: judge.json, judge.md, judge.csv, "
        f"{', '.join(f'{name}.csv' for name in tables if name != 'means')}"
        + (f", {len(files)} contact sheets" if files else "")
    )
    return figures


def _print_matching(method: MethodPictures, targets: int, console: Console) -> None:
    """Say how the pictures were read and matched."""
    name, matching, pictures = method.name, method.matching, method.pictures
    console.line(
        f"{name}: {len(method.targets)} of {targets} views, matched by "
        f"{matching.rule} ({pictures.layout})"
    )
    for note in pictures.notes:
        console.line(f"  {note}")
    if matching.missing:
        listed = ", ".join(matching.missing[:3]) + (", ..." if len(matching.missing) > 3 else "")
        console.warn(f"{name}: no picture of {len(matching.missing)} views ({listed})")
    if matching.left_over:
        console.line(f"  {len(matching.left_over)} pictures of no judged view left out")
    for doubt in method.doubts:
        console.warn(f"{name}: {doubt}")
    for (width, height), count in sorted(method.resized.items()):
        console.warn(f"{name}: {count} pictures of {width}x{height} pixels resized to their views'")


def _write(
    figures: dict[str, Any], tables: Mapping[str, Table], views: Sequence[JudgedView], *, out: Path
) -> list[str]:
    """Write the results; returns the names of the contact sheets."""
    from PIL import Image

    sheets = []
    for number, first in enumerate(range(0, len(views), VIEWS_A_SHEET)):
        sheets.append(f"sheet_{number:03d}.png")
        picture = Image.fromarray(method_sheet(views[first : first + VIEWS_A_SHEET]))
        with replaced_when_written(out / sheets[-1]) as temporary:
            picture.save(temporary, format="PNG")
    write_json(out / "judge.json", figures)
    for name, table in tables.items():
        write_text(out / ("judge.csv" if name == "means" else f"{name}.csv"), csv_text(table))
    write_text(out / "judge.md", judge_markdown(figures, tables, sheets))
    return sheets
