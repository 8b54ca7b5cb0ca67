"""A run read back: its settings, its rounds and targets, its memory and its project."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ValidationError, model_validator

from gvtools.cameras import Cameras, check_usable, rigid_transform
from gvtools.errors import MemoryFileError, OptionError, ProjectError, ShapeError
from gvtools.memory.files import INDEX
from gvtools.notebook import html_table, png_tag
from gvtools.poses.motions import mean_near, motions_between, move_pose
from gvtools.runs.digests import check_sums
from gvtools.runs.folder import RunDirectory
from gvtools.runs.layout import (
    APPEARANCE,
    MEMORY,
    METRICS,
    POINTS,
    RECORD,
    REPORT,
    round_folder,
    saved_memory,
)
from gvtools.runs.poses import RunPoses, refined_poses_of, with_poses
from gvtools.runs.target_files import TargetFiles, entry_camera, read_target
from gvtools.splat_files import READERS
from gvtools.untrusted import expect, read_json

if TYPE_CHECKING:
    from gvtools.appearance.appearance import Appearance
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import Scene, View


# How often a run is read anew whose memory was replaced meanwhile.
ATTEMPTS = 5


MEMORIES = (".npz", ".ply")  # files of memories
# Refinement turns no camera by more [rad]; other poses of the same names are another project's.
FARTHEST_TURN = 0.5


@dataclass(frozen=True, eq=False)
class RunTarget:
    """A target of a run that a round completed."""

    folder: Path
    # From 1.
    round: int
    # Its entry in the round's report.
    report: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Of the target."""
        return str(self.report["name"])

    @cached_property
    def camera(self) -> Cameras:
        """Of the target, a batch of one."""
        return entry_camera(self.report)

    def read(self) -> TargetFiles:
        """Its picture, depth and support."""
        return read_target(self.folder, self.report)


@dataclass(frozen=True, eq=False)
class Run:
    """A run as its folder holds it; memory and project are read when they are first used."""

    path: Path  # its folder
    record: Mapping[str, Any]  # what run.json holds
    # Reports of the complete rounds, the context's (round 0) first; perhaps none.
    rounds: tuple[Mapping[str, Any], ...]
    project: Path | None = None  # where its project lies now; None: where it lay

    @cached_property
    def settings(self) -> Mapping[str, Any]:
        """The resolved settings, nested, as JSON has them; derived values in their places."""
        return resolved_settings(self.record)

    @property
    def context(self) -> tuple[str, ...]:
        """Names of the context views."""
        return tuple(self.record["context"])

    @property
    def planned(self) -> int:
        """How many rounds the run is to have, the context's included."""
        return len(self.record["schedule"]) + 1

    @property
    def complete(self) -> bool:
        """Whether every planned round is there."""
        return len(self.rounds) == self.planned

    def _repr_html_(self) -> str:
        last = self.rounds[-1] if self.rounds else {}
        rows = {
            "folder": self.path,
            "project": self.record["project"],
            "rounds": f"{len(self.rounds)} of {self.planned}",
            "context, targets": f"{len(self.context)}, {len(self.views)} views",
            "observations": f"{last.get('points', 0):,}, {last.get('generated', 0):,} generated",
        }
        picture = self.path / "growth.png"
        return html_table("Run", rows, png_tag(picture.read_bytes()) if picture.is_file() else "")

    @cached_property
    def views(self) -> tuple[RunTarget, ...]:
        """The completed targets, in the order of the rounds."""
        return tuple(
            RunTarget(round_folder(self.path, number), number, entry)
            for number, report in enumerate(self.rounds)
            for entry in report["views"]
        )

    @cached_property
    def memory(self) -> SpatialMemory:
        """The memory after the last complete round."""
        return load_memory(self.path)

    @cached_property
    def scenes(self) -> tuple[Scene, Scene | None]:
        """The project, and the scene with the true pictures of the targets, if there is one."""
        from gvtools.scenes.layout import is_address
        from gvtools.scenes.project import open_project, open_recorded
        from gvtools.scenes.resized import reduced

        max_side = self.settings.get("max_side")
        project, reading = self.record["project"], self.record["reading"]
        try:
            scene = reduced(open_recorded(project, reading, moved=self.project), max_side)
        except (TypeError, ValueError, AttributeError, KeyError, OverflowError) as error:
            raise ProjectError(
                f"{self.path}: its record says of the project what cannot be read ({error}); "
                "expected the record of a run; run reconstruct again"
            ) from error
        other = self.record["targets_project"]
        truths = scene if self.record["targets_kind"] == "hold-out" else None
        if other is not None:
            # Another scene of the data set lies in the same download.
            root = None if scene.origin is None else scene.origin.root
            truths = reduced(
                open_project(other, root=root if is_address(other) else None), max_side
            )
        poses = refined_poses_of(self.path)
        if poses is None:
            return scene, truths
        if truths is not None:
            truths = with_poses(truths, self.record["targets"], poses.targets)
        return with_poses(scene, self.context, poses.context), truths

    def targets(self) -> Iterator[tuple[RunTarget, TargetFiles, View | None]]:
        """Each completed target, its files, and the view with its true picture, if any."""
        truths = self.scenes[1]
        for view in self.views:
            files = view.read()
            truth = None if truths is None else truths[view.name]
            if truth is not None and not _same_camera(truth, files):
                raise ProjectError(
                    f"{self.path}: the camera of {view.name} is another one now than when the run "
                    "was made; expected the project as it was; run reconstruct again"
                )
            yield view, files, truth


def load_run(path: Path | str, *, project: Path | None = None) -> Run:
    """The run in a folder, finished or not.

    Args:
        path: the folder.
        project: where its project lies now; None: where it lay.

    Raises:
        ProjectError: no run, a damaged one, or one of another version.
    """
    path = Path(path)
    check_sums(path, [METRICS] if (path / METRICS).is_file() else [])
    return Run(path, read_record(path), read_reports(path), project)


def _refined(run: Path) -> tuple[Path, RunPoses | None]:
    """The folder of a run or of the memory in it, and the run's own poses, if it has any."""
    folder = run if run.is_dir() else run.parent
    return folder, refined_poses_of(folder) if (folder / RECORD).is_file() else None


def said_of_path(path: Path, run: Path) -> str:
    """What is said of cameras from a file without pictures, which stay as given; "" if nothing."""
    refined = _refined(run)[1] is not None
    return f"poses: as given in {path}; the run refined those of its views" if refined else ""


def at_run_poses(scene: Scene, run: Path, memory: SpatialMemory | None = None) -> tuple[Scene, str]:
    """A scene at the poses of a run of it, and what was done; "" where the run has no own poses.

    ``run`` is a run's folder or the memory in it. Views that it did not have move like its context
    near them, where cameras err alike there. A ``memory`` apart from its run tells other poses.
    """
    folder, poses = _refined(run)
    if poses is None:
        seen = memory.views.photographed if memory is not None else ()
        for camera in (view.camera for view in seen if view.camera.names[0] in scene.names):
            given_pose = scene[camera.names[0]].camera.cam_from_world
            if not np.allclose(given_pose, camera.cam_from_world, rtol=1e-9, atol=1e-6):
                return scene, (
                    f"poses: as given, not those of the memory's views ({camera.names[0]}); if its "
                    "run refined them, give the run's folder"
                )
        return scene, ""
    record = read_record(folder)
    context, held = record["context"], record["targets"]
    held = held if record["targets_kind"] == "hold-out" else []
    motions = None
    if set(context) <= set(scene.names):
        given = scene.subset(context).cameras.cam_from_world
        motions = motions_between(given, poses.context)
    if motions is None or np.linalg.norm(motions[:, 3:], axis=1).max() > FARTHEST_TURN:
        return scene, f"poses: as given; the run's own are refined, but not for {scene.root}"
    others = [name for name in scene.names if name not in {*context, *held}]
    moved = with_poses(scene, context, poses.context)
    if held:
        moved = with_poses(moved, held, poses.targets)
    how = "stay as given"
    if poses.depth:
        how = "moved like the context near them"
        near = [
            move_pose(pose, mean_near(pose, given, motions, depth=poses.depth))
            for pose in (scene[name].camera.cam_from_world[0] for name in others)
        ]
        moved = with_poses(moved, others, np.array(near).reshape(-1, 4, 4))
    rest = f"; {len(others)} views that it did not have {how}" if others else ""
    return moved, f"poses: as refined by the run{rest}"


def load_growing_run(path: Path, *, project: Path | None = None) -> Run:
    """The run in a folder that another process may add rounds to; its memory is loaded."""
    for attempt in range(ATTEMPTS):
        run = load_run(path, project=project)
        try:
            run.memory  # noqa: B018, loaded while it belongs to the rounds
        except MemoryFileError:
            # The next round is complete, and this one's memory gone.
            if attempt == ATTEMPTS - 1 or len(run.rounds) == count_rounds(path):
                raise
            continue
        if len(run.rounds) == count_rounds(path):
            break
    return run


def count_rounds(path: Path) -> int:
    """How many complete rounds a run's folder has; 0 also where there is no folder."""
    return len(RunDirectory(path).reports())


def _same_camera(view: View, target: TargetFiles) -> bool:
    return all(
        np.allclose(getattr(view.camera, name), getattr(target.camera, name), rtol=1e-9, atol=1e-9)
        for name in ("K", "cam_from_world", "width", "height")
    )


class _Record(BaseModel):
    """What readers of run.json stand on."""

    project: str
    reading: dict[str, Any]
    targets_project: str | None
    targets_kind: str
    schedule: list[list[Any]]
    context: list[str]
    targets: list[str]
    settings: dict[str, Any]
    derived: dict[str, Any]
    versions: dict[str, Any]


class _Settings(BaseModel):
    """What readers of the resolved settings stand on."""

    completer: str
    voxel: float
    seed: int
    max_side: int | None = None


class _View(BaseModel):
    name: str
    stem: str
    coverage: float
    coverage_after: float
    camera: dict[str, Any]
    scale: dict[str, Any]

    @model_validator(mode="after")
    def _usable(self) -> _View:
        try:
            camera = entry_camera({"name": self.name, "camera": self.camera})
            check_usable(camera)
            rigid_transform(camera.cam_from_world[0], what=self.name)
            size = [self.camera[side] for side in ("width", "height")]
            fits = [*camera.width, *camera.height] == size and max(size) < 2**31
            expect(fits and all(np.ndim(side) == 0 for side in size), f"a picture of {size} pixels")
            shapes = [np.shape(self.camera[name]) for name in ("K", "cam_from_world")]
            expect(shapes == [(3, 3), (4, 4)], f"K and cam_from_world of shapes {shapes}")
        except (ShapeError, KeyError, TypeError, OverflowError) as error:
            raise ValueError(str(error)) from None
        return self


class _Report(BaseModel):
    """What readers of a round's report stand on."""

    round: int
    points: int
    observed: int
    generated: int
    scanned: int = 0
    voxels: int
    added: int
    merged: int
    rejected: int
    bytes: int
    coverage_before: float | None
    coverage_after: float | None
    seconds: dict[str, float]
    views: list[_View]


def read_record(path: Path) -> dict[str, Any]:
    """What the run.json of a run's folder holds."""
    file = path / RECORD
    if not file.is_file():
        raise ProjectError(f"{path}: holds no {RECORD}; expected the folder of a run")
    try:
        record: dict[str, Any] = read_json(file)
        _Record.model_validate(record)
        _Settings.model_validate(resolved_settings(record))
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = repr(error)
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            reason = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise ProjectError(
            f"{file}: no record of a run of this version ({reason}); run reconstruct again"
        ) from None
    return record


def resolved_settings(record: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a run's record, nested, with the derived values in their places."""
    out: dict[str, Any] = json.loads(json.dumps(record["settings"]))
    for key, value in record["derived"].items():
        *sections, name = key.split(".")
        place = out
        for section in sections:
            place = place[section]
        place[name] = value
    return out


def read_reports(path: Path) -> tuple[Mapping[str, Any], ...]:
    """The reports of a run's whole rounds, the context's (round 0) first; perhaps none."""
    reports = tuple(RunDirectory(path).reports())
    for number, report in enumerate(reports):
        try:
            whole = _Report.model_validate(report).round == number
        except ValidationError:
            whole = False
        if not whole:
            raise ProjectError(
                f"{round_folder(path, number) / REPORT}: no report of this version; run "
                "reconstruct again"
            )
        check_sums(round_folder(path, number), (REPORT,))
    return reports


def load_appearance(path: Path) -> Appearance | None:
    """The Gaussians that a run fitted; None for a file, and for a run without them."""
    from gvtools.appearance.appearance import Appearance

    file = round_folder(path, 0) / APPEARANCE
    return Appearance.load(file) if file.exists() else None


def load_memory(
    # A memory file, a folder of tiles, a coloured PLY, or a run's folder; an unfinished run gives
    # that of its last complete round.
    path: Path,
    *,
    up_to: int | None = None,  # forget the rounds after this one; None keeps all
) -> SpatialMemory:
    """The memory in a file or of a run."""
    from gvtools.memory.spatial_memory import SpatialMemory, TiledMemory

    memory: SpatialMemory
    if path.suffix.lower() == ".ply":
        # Sums beside a PLY of somebody else's are none of a run.
        if path.name == POINTS and (path.parent / RECORD).is_file():
            check_sums(path.parent, (path.name,))
        memory = SpatialMemory.from_ply(path)
    else:
        saved = memory_path(path)
        memory = TiledMemory.load(saved) if saved.is_dir() else SpatialMemory.load(saved)
    if up_to is not None:
        if up_to not in memory.rounds:
            raise OptionError(
                f"--round {up_to}: the memory has rounds {', '.join(map(str, memory.rounds))}; "
                "expected one of them"
            )
        for number in reversed(memory.rounds):
            if number > up_to:
                memory.forget(round=number)
    return memory


def memory_path(path: Path) -> Path:
    """The memory that ``path``, a file, a folder of tiles or a run's folder, stands for."""
    if path.is_file() and path.suffix.lower() not in ("", *MEMORIES):
        raise ProjectError(
            f"{path}: no memory by its suffix; expected a run's folder, or a file that ends with "
            f"{', '.join(MEMORIES)}; view and export open more ({', '.join(READERS)})"
        )
    if path.is_file() or (path / INDEX).is_file():
        return path
    if not path.is_dir():
        raise ProjectError(f"{path}: no such file or folder; expected a memory or a run's folder")
    rounds = sorted(path.glob("round_*"))
    for candidate in map(saved_memory, (path, *reversed(rounds))):
        if candidate.exists():
            return candidate
    raise ProjectError(
        f"{path}: holds no {MEMORY} and no round with one; expected a run's folder or a memory file"
    )
