"""The JSON of a run: its record and the reports of its rounds, read and checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from gvtools.errors import ProjectError
from gvtools.runs.folder import RunDirectory
from gvtools.runs.layout import RECORD, REPORT, round_folder

# Keys that records and reports have, with their JSON types.
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


def read_record(path: Path) -> dict[str, Any]:
    """What the run.json of a run's folder holds.

    Raises:
        ProjectError: no run, or a record of another version.
    """
    file = path / RECORD
    if not file.is_file():
        raise ProjectError(f"{path}: holds no {RECORD}; expected the folder of a run")
    try:
        record: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(record, dict):
            raise TypeError("no JSON object")
        lacking = [key for key in _RECORDED if key not in record]
        if lacking:
            raise KeyError(", ".join(lacking))
        _check_types(record, _RECORDED)
        _check_types(resolved_settings(record), _CONFIGURED)
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
    """The reports of a run's whole rounds, the context's (round 0) first; perhaps none.

    Raises:
        ProjectError: one is damaged, or of another version.
    """
    reports = tuple(RunDirectory(path).reports())
    for number, report in enumerate(reports):
        if not _is_report(report, number):
            raise ProjectError(
                f"{round_folder(path, number) / REPORT}: no report of this version; run "
                "reconstruct again"
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
