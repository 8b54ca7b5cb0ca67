"""Computed depth of context views in the folder of round 0.

``context_depth_STEM.npz`` has the keys depth (float32 z-depth, scene units, 0 = none), confidence,
source, and failed (why there is no depth, or empty); ``context_depth_STEM.png`` shows the depth.
A file under its final name is complete, so that a run that is killed in round 0 goes on with the
next view.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from gvtools.depth.source import DepthMap
from gvtools.files import replaced_when_written
from gvtools.runs.layout import context_depth, target_stems
from gvtools.runs.target_files import write_png
from gvtools.untrusted import load_arrays

# Errors of a damaged file.
UNREADABLE = (OSError, EOFError, ValueError, KeyError, BadZipFile, zlib.error)
# Views that one line names at most.
MAX_NAMED = 10


def context_depth_files(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """For each context view the file of its depth in the folder of round 0."""
    stems = zip(names, target_stems(names), strict=True)
    return {name: context_depth(folder, stem) for name, stem in stems}


def read_context_depth(path: Path, size: tuple[int, ...]) -> tuple[DepthMap, str]:
    """A view's depth, and why it is empty, where it is; ``size`` (H, W) is of its picture."""
    stored = load_arrays(path, "depth", "confidence", "source", "failed")
    for name in ("depth", "confidence"):
        array = stored[name]
        if array.dtype != np.float32 or not np.isfinite(array).all() or (array < 0).any():
            raise ValueError(f"{name} of type {array.dtype}, or not finite, or negative")
    depth_map = DepthMap(stored["depth"], stored["confidence"], str(stored["source"]))
    failed = str(stored["failed"])
    if depth_map.depth.shape != size:
        raise ValueError(f"depth of {depth_map.depth.shape}, picture of {size}")
    return depth_map, failed


def write_context_depth(
    path: Path, depth_map: DepthMap, *, failed: str, picture: NDArray[np.uint8]
) -> None:
    """Write a view's depth, why it is empty, or an empty text, and a picture that shows it."""
    # The picture first: where the arrays exist, nothing is missing.
    with replaced_when_written(path.with_suffix(".png")) as temporary:
        write_png(temporary, picture)
    with replaced_when_written(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            depth=depth_map.depth,
            confidence=depth_map.confidence,
            source=np.array(depth_map.source),
            failed=np.array(failed),
        )


def off_scale(reports: Sequence[Mapping[str, Any]]) -> str | None:
    """One line that names the views, reported by round 0, whose depth is off the sparse points."""
    names = [report["view"] for report in disagreeing(reports)]
    if not names:
        return None
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return (
        f"depth of {len(names)} of {len(reports)} views is off the sparse points' scale: "
        f"{', '.join(names[:MAX_NAMED])}{more}"
    )


def disagreeing(reports: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The reports of views whose depth disagrees with the sparse points."""
    return [report for report in reports if report["scale"] and report["scale"]["disagrees"]]
