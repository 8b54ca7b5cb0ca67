"""Depth of a run's context: recorded, read from the folder of round 0, or computed and put there.

``context_depth_STEM.npz`` has the keys depth (float32 z-depth, scene units, 0 = none), confidence,
source, and failed (why there is no depth, or empty); ``context_depth_STEM.png`` shows the depth.
A file under its final name is complete, so that a run that is killed in round 0 goes on with the
next view.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from gvtools.depth.shown import FittedDepth
from gvtools.depth.source import (
    DepthMap,
    DepthSource,
    RecordedDepth,
    disagrees,
    is_recorded,
    scale_to_points,
)
from gvtools.errors import DegenerateError, ProjectError
from gvtools.files import replaced_when_written
from gvtools.runs.layout import context_depth, target_stems
from gvtools.runs.target_files import write_png
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.untrusted import expect, load_arrays

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
        sound = array.dtype == np.float32 and np.isfinite(array).all() and not (array < 0).any()
        expect(sound, f"{name} of type {array.dtype}, or not finite, or negative")
    depth_map = DepthMap(stored["depth"], stored["confidence"], str(stored["source"]))
    expect(depth_map.depth.shape == size, f"depth of {depth_map.depth.shape}, picture of {size}")
    return depth_map, str(stored["failed"])


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
    odd = [report for report in reports if report["scale"] and report["scale"]["disagrees"]]
    if not odd:
        return None
    names = ", ".join(report["view"] for report in odd[:MAX_NAMED])
    more = f" and {len(odd) - MAX_NAMED} more" if len(odd) > MAX_NAMED else ""
    first = odd[0]["scale"]
    scale = f", scale {first['scale']:.3g}" if first["scale"] else ""  # not a number: null
    return (
        f"depth of {len(odd)} of {len(reports)} views is off the sparse points' scale: "
        f"{names}{more}; the first: {first['status']}{scale}; look at its unit and at the poses"
    )


class DepthCache:
    """The depth of a run's context: recorded, in a file of round 0, or asked of the source."""

    def __init__(
        self,
        scene: Scene,
        names: Sequence[str],
        source: DepthSource,
        *,
        folder: Path,  # of round 0; what is not recorded is written there, and read again later
        unfinished: bool = False,  # round 0 is being written; damaged files are replaced
        # gives depth of a view that takes the place of computed depth, or None
        fallback: Callable[[View, Frame], DepthMap | None] = lambda view, frame: None,
    ) -> None:
        self.scene, self.source = scene, source
        self.failed: dict[str, str] = {}  # why there is no depth, by view
        self._fallback, self._unfinished = fallback, unfinished
        self._file = context_depth_files(folder, names)

    def covers(self, view: View) -> bool:
        """Whether the source does."""
        return self.source.covers(view)

    @property
    def file_count(self) -> int:
        """How many of the views have a file."""
        return sum(path.exists() for path in self._file.values())

    def depth(self, view: View, frame: Frame) -> DepthMap:
        """The depth of a context view whose pixels are ``frame``."""
        path = self._file[view.name]
        if path.exists():
            try:
                depth_map, failed = read_context_depth(path, frame.rgb.shape[:2])
            except UNREADABLE as error:
                if not self._unfinished:
                    raise ProjectError(
                        f"{path}: unreadable ({error!r}); expected depth of the context; start the "
                        "run again with another --out"
                    ) from error
            else:
                # An interrupted attempt fitted other Gaussians.
                if not (self._unfinished and depth_map.source == FittedDepth.name):
                    if failed:
                        self.failed[view.name] = failed
                    return depth_map
        try:
            substitute = None if is_recorded(self.source, view) else self._fallback(view, frame)
            depth_map = substitute or self.source.depth(self.scene, view, frame)
        except DegenerateError as error:
            # The view stays without depth; the others carry the run.
            self.failed[view.name] = str(error)
            empty = np.zeros(frame.rgb.shape[:2], np.float32)
            depth_map = DepthMap(empty, np.ones_like(empty), self.source.name)
        if depth_map.source != RecordedDepth.name:
            failed = self.failed.get(view.name, "")
            picture = colored(depth_map.depth)
            write_context_depth(path, depth_map, failed=failed, picture=picture)
        return depth_map


def depth_report(scene: Scene, name: str, depth_map: DepthMap) -> dict[str, Any]:
    """What a view's depth covers, and whether it has the scale of the sparse points."""
    fit = scale_to_points(scene, name, depth_map.depth)
    return {
        "view": name,
        "source": depth_map.source,
        "known": float((depth_map.depth > 0).mean()),
        "scale": None if fit is None else {**asdict(fit), "disagrees": disagrees(fit)},
    }


def colored(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3): inverse depth from its 2nd percentile (blue) to its 98th (red); none is black."""
    from matplotlib import colormaps

    known = depth > 0
    out = np.zeros((*depth.shape, 3), np.uint8)
    if known.any():
        inverse = 1 / depth[known]
        low, high = np.percentile(inverse, (2, 98))
        share = np.clip((inverse - low) / max(high - low, 1e-12), 0, 1)
        out[known] = np.rint(colormaps["turbo"](share)[:, :3] * 255).astype(np.uint8)
    return out
