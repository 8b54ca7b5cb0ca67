"""A run read back: its project, what was given, and what its rounds left of each target."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.reduced import reduced
from gvtools.runs.round_files import TargetFiles, read_target
from gvtools.runs.folder import RunDirectory
from pipelines.commands.scene_arguments import reopen_scene

if TYPE_CHECKING:
    from gvtools.evaluation.posed_picture import PosedPicture
    from gvtools.scenes.scene import Scene, View


# What records and reports hold at least, and of what type, as JSON has them.
_RECORDED: dict[str, type | tuple[type, ...]] = {
    "project": str, "reading": dict, "targets_project": (str, NoneType), "targets_kind": str,
    "schedule": list, "context": list, "targets": list, "settings": dict,
    "derived": dict, "versions": dict,
}  # fmt: skip
_CONFIGURED: dict[str, type | tuple[type, ...]] = {
    "completer": str, "voxel": (int, float), "seed": int
}  # fmt: skip
_COUNTS = (
    "points", "observed", "generated", "voxels", "added", "merged", "rejected", "bytes"
)  # fmt: skip
_SHARES = ("coverage_before", "coverage_after")
_SHARES_OF_A_VIEW = ("coverage", "coverage_after")
_CAMERA = {"K": (3, 3), "cam_from_world": (4, 4), "width": (), "height": ()}
_OF_A_VIEW = ("name", "coverage", "coverage_after", "camera", "stem", "scale")


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A run with at least one round of targets.

    Attributes:
        path: its folder.
        record: what run.json holds.
        scene: the project.
        truths: the scene whose views show the truth of the targets; None where there is none.
        reports: of the whole rounds, the context's (round 0) first.
    """

    path: Path
    record: Mapping[str, Any]
    scene: Scene
    truths: Scene | None
    reports: tuple[Mapping[str, Any], ...]

    @property
    def whole(self) -> bool:
        """Whether every round that was planned is there."""
        return len(self.reports) == len(self.record["schedule"]) + 1

    def targets(self) -> Iterator[tuple[int, Mapping[str, Any], TargetFiles, View | None]]:
        """Round, entry of its report, files, and the view that shows the truth, of each target.

        Raises:
            ProjectError: files are absent or damaged, or the truth is of another camera by now.
        """
        for number, report in enumerate(self.reports[1:], start=1):
            folder = RunDirectory(self.path).round_path(number)
            for entry in report["views"]:
                target = read_target(folder, entry)
                truth = None if self.truths is None else self.truths[target.name]
                if truth is not None and not _same_camera(truth, target):
                    raise ProjectError(
                        f"{self.path}: the camera of {target.name} is another one now than when "
                        "the run was made; expected the project as it was; run reconstruct again"
                    )
                yield number, entry, target, truth

    def context(self) -> list[PosedPicture]:
        """The given views, with the depth of the memory's observed points as each sees them."""
        from gvtools.evaluation.posed_picture import PosedPicture
        from pipelines.rendering.memory_source import open_memory

        memory = open_memory(self.path, up_to=0)
        out = []
        for name in self.record["context"]:
            view = self.scene[name]
            frame = view.load()
            known = memory.project(view.camera)
            out.append(PosedPicture(name, view.camera, frame.rgb, known.depth[0], frame.mask))
        return out


def open_run(path: Path, *, project: Path | None = None) -> FinishedRun:
    """The run in a folder.

    Args:
        path: the folder.
        project: where its project lies now; None: where it lay.

    Raises:
        ProjectError: no run, one without a round of targets, or one whose project is gone.
    """
    record = read_record(path)
    reports = read_reports(path)
    if len(reports) < 2:
        raise ProjectError(f"{path}: no round of targets is done; expected one; add --resume to it")
    scene, truths = open_scenes(record, project=project)
    return FinishedRun(path, record, scene, truths, reports)


def read_record(path: Path) -> dict[str, Any]:
    """What the run.json of a run's folder holds.

    Raises:
        ProjectError: no run, or a record of another version.
    """
    file = path / "run.json"
    if not file.is_file():
        raise ProjectError(f"{path}: holds no run.json; expected the folder of a run")
    try:
        record: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(record, dict):
            raise TypeError("no JSON object")
        lacking = [key for key in _RECORDED if key not in record]
        if lacking:
            raise KeyError(", ".join(lacking))
        _check_types(record, _RECORDED)
        _check_types(resolved(record), _CONFIGURED)
        if not all(isinstance(rows, list) for rows in record["schedule"]):
            raise TypeError("schedule holds more than lists")
        for key in ("context", "targets"):
            if not all(isinstance(name, str) for name in record[key]):
                raise TypeError(f"{key} holds more than names")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ProjectError(
            f"{file}: no record of a run of this version ({error!r}); run reconstruct again"
        ) from None
    return record


def _check_types(data: Mapping[str, Any], kinds: Mapping[str, type | tuple[type, ...]]) -> None:
    for key, kind in kinds.items():
        if not isinstance(data[key], kind):
            raise TypeError(f"{key} is {data[key]!r}")


def resolved(record: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a run's record, nested, with what was derived in its place."""
    out: dict[str, Any] = json.loads(json.dumps(record["settings"]))
    for key, value in record["derived"].items():
        *sections, name = key.split(".")
        place = out
        for section in sections:
            place = place[section]
        place[name] = value
    return out


def open_scenes(
    record: Mapping[str, Any], *, project: Path | None = None
) -> tuple[Scene, Scene | None]:
    """The project of a run, and the scene whose views show the truth of its targets, if any does.

    Args:
        record: of its run.json.
        project: where the project lies now; None: where it lay.

    Raises:
        GvError: it cannot be read any more.
    """
    max_side = record["settings"].get("max_side")
    root = project or Path(record["project"])
    scene = reduced(reopen_scene(root, record["reading"]), max_side)
    other = record["targets_project"]
    if other is not None:
        from gvtools.scenes.project import open_project

        return scene, reduced(open_project(Path(other)), max_side)
    return scene, scene if record["targets_kind"] == "hold-out" else None


def read_reports(path: Path) -> tuple[Mapping[str, Any], ...]:
    """The reports of a run's whole rounds, the context's (round 0) first; perhaps none.

    Raises:
        ProjectError: one is damaged, or of another version.
    """
    reports = tuple(RunDirectory(path).reports())
    for number, report in enumerate(reports):
        if not _is_report(report, number):
            raise ProjectError(
                f"{RunDirectory(path).round_path(number)}/report.json: no report of this version; "
                "run reconstruct again"
            )
    return reports


def _is_report(report: Any, number: int) -> bool:
    """Whether it has what readers of a round's report stand on."""
    return (
        isinstance(report, dict)
        and report.get("round") == number
        and all(isinstance(report.get(key), int) for key in _COUNTS)
        and all(isinstance(report.get(key, ""), (int, float, NoneType)) for key in _SHARES)
        and isinstance(report.get("seconds"), dict)
        and all(isinstance(value, (int, float)) for value in report["seconds"].values())
        and isinstance(report.get("views"), list)
        and all(_is_view(view) for view in report["views"])
    )


def _is_view(view: Any) -> bool:
    return (
        isinstance(view, dict)
        and all(key in view for key in _OF_A_VIEW)
        and all(isinstance(view[key], str) for key in ("name", "stem"))
        and all(isinstance(view[key], (int, float)) for key in _SHARES_OF_A_VIEW)
        and isinstance(view["scale"], dict)
        and isinstance(view["camera"], dict)
        and all(_is_array(view["camera"].get(key), shape) for key, shape in _CAMERA.items())
    )


def _is_array(value: Any, shape: tuple[int, ...]) -> bool:
    try:
        return np.array(value, np.float64).shape == shape
    except (TypeError, ValueError):
        return False


def _same_camera(view: View, target: TargetFiles) -> bool:
    return all(
        np.allclose(getattr(view.camera, name), getattr(target.camera, name), rtol=1e-9, atol=1e-9)
        for name in ("K", "cam_from_world", "width", "height")
    )
