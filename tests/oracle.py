"""The folder of reference values, and its fixtures by what their JSON says."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from conftest import shared_folder

NAMED_BY = "GVTOOLS_ORACLE"


def oracle_folder(environment: Mapping[str, str]) -> Path:
    """The folder that GVTOOLS_ORACLE names, or oracle/ beside the shared scenes.

    Raises:
        FileNotFoundError: a folder is named and holds no reference values. The default one may be
            absent: its tests are skipped with a reason.
    """
    named = environment.get(NAMED_BY)
    if not named:
        return shared_folder() / "oracle"
    if not any(Path(named).rglob("*.json")):
        raise FileNotFoundError(
            f"{NAMED_BY} = {named!r} holds no reference values; name a folder with fixtures, or "
            "unset it for the default"
        )
    return Path(named)


ORACLE = oracle_folder(os.environ)
ABSENT = f"no reference values in {ORACLE}; set {NAMED_BY} to a folder that holds them"


def expected_values(folder: Path) -> Iterator[tuple[Path, str, dict[str, Any]]]:
    """JSON file, name of the case, and its values, of every file with expected values."""
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else ():
        data = json.loads(path.read_text(encoding="utf-8"))
        for name, values in data.get("expected", {}).items():
            yield path, name, values


def network_fixtures(folder: Path) -> dict[str, dict[str, Any]]:
    """JSON by name of every fixture with arrays of its own name, without the expected values.

    Expected values (of image metrics and trajectories) have tests of their own.
    """
    found = {}
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else ():
        data = json.loads(path.read_text(encoding="utf-8"))
        if "upstream" in data and "expected" not in data and path.with_suffix(".npz").is_file():
            found[path.stem] = data
    return found


def unclaimed(folder: Path, starts: Iterable[str]) -> list[str]:
    """Names of the network fixtures that begin with none of ``starts``."""
    return [name for name in network_fixtures(folder) if not name.startswith(tuple(starts))]


def without_cases(folder: Path, starts: Iterable[str]) -> list[str]:
    """Names of the network fixtures with an empty list of cases, or none where one is due.

    Args:
        folder: of the fixtures.
        starts: beginnings of the names that are tested case by case.
    """
    return [
        name
        for name, data in network_fixtures(folder).items()
        if not data.get("cases", not name.startswith(tuple(starts)))
    ]


def arrays(path: Path) -> Iterator[Any]:
    """The .npz files that may belong to a JSON file: of its name, or of its name's beginning."""
    for candidate in sorted(path.parent.glob("*.npz")):
        if path.stem.startswith(candidate.stem) or candidate.stem.startswith(path.stem):
            yield np.load(candidate, allow_pickle=False)
