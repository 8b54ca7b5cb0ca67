"""The JSON of a run: its record and the reports of its rounds, read and checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator

from gvtools.cameras import rigid_transform
from gvtools.errors import ProjectError, ShapeError
from gvtools.runs.digests import check_sums
from gvtools.runs.folder import RunDirectory
from gvtools.runs.layout import RECORD, REPORT, round_folder
from gvtools.untrusted import read_json

Row3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]


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


class _Camera(BaseModel):
    K: Annotated[list[Row3], Field(min_length=3, max_length=3)]
    cam_from_world: Annotated[list[Row4], Field(min_length=4, max_length=4)]
    width: Annotated[int, Field(gt=0, lt=2**31)]
    height: Annotated[int, Field(gt=0, lt=2**31)]

    @model_validator(mode="after")
    def _usable(self) -> _Camera:
        finite = np.isfinite(self.K).all() and self.K[0][0] > 0 and self.K[1][1] > 0
        if not finite:
            raise ValueError("impossible intrinsics")
        try:
            rigid_transform(self.cam_from_world, what="cam_from_world")
        except ShapeError as error:
            raise ValueError(str(error)) from None
        return self


class _View(BaseModel):
    name: str
    stem: str
    coverage: float
    coverage_after: float
    camera: _Camera
    scale: dict[str, Any]


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
    except ValidationError as error:
        first = error.errors()[0]
        raise _outdated(file, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _outdated(file, repr(error)) from None
    return record


def _outdated(file: Path, reason: str) -> ProjectError:
    return ProjectError(
        f"{file}: no record of a run of this version ({reason}); run reconstruct again"
    )


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
