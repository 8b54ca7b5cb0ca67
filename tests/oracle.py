"""The folder of reference values, and its fixtures by what their JSON says."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from conftest import shared_folder

ORACLE = Path(os.environ.get("GVTOOLS_ORACLE") or shared_folder() / "oracle")
ABSENT = f"no reference values in {ORACLE}; set GVTOOLS_ORACLE to a folder that holds them"


def expected_values(folder: Path) -> Iterator[tuple[Path, str, dict[str, Any]]]:
    """JSON file, name of the case, and its values, of every file with expected values."""
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else ():
        data = json.loads(path.read_text(encoding="utf-8"))
        for name, values in data.get("expected", {}).items():
            yield path, name, values


def arrays(path: Path) -> Iterator[Any]:
    """The .npz files that may belong to a JSON file: of its name, or of its name's beginning."""
    for candidate in sorted(path.parent.glob("*.npz")):
        if path.stem.startswith(candidate.stem) or candidate.stem.startswith(path.stem):
            yield np.load(candidate, allow_pickle=False)
