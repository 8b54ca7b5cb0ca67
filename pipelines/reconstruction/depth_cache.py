"""Depth of the context that was computed rather than recorded: kept in round 0, and looked at.

``context_depth_NAME.npz`` has the keys depth (float32 z-depth, scene units, 0 = none), confidence,
source, and failed (why there is no depth, or empty); ``context_depth_NAME.png`` shows the depth,
near red, far blue, none black. A file that stands under its name is whole, so that a run that is
killed in round 0 goes on with the next view.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from gvtools.depth.scale_check import disagrees, scale_to_points
from gvtools.depth.source import DepthMap, DepthSource, RecordedDepth, is_recorded
from gvtools.errors import DegenerateError, ProjectError
from gvtools.files import replaced_when_written
from gvtools.runs.arrays import save_arrays
from gvtools.runs.round_files import target_stems, write_png
from gvtools.scenes.scene import Frame, Scene, View
from pipelines.console import Console

# Views that a line names at most.
NAMED = 10


class KeptDepth:
    """The depth of a run's context: recorded, kept by round 0, or asked of the source.

    Args:
        scene: the project.
        names: of the context views.
        source: where depth comes from.
        folder: of round 0; what is not recorded is written there, and read again later.
        unfinished: round 0 is being written; a damaged file in its folder is then replaced.
        known: gives the depth of a view that needs none computed, or None.

    Attributes:
        failed: views that no depth was found for, with the reason.
    """

    def __init__(
        self,
        scene: Scene,
        names: Sequence[str],
        source: DepthSource,
        folder: Path,
        *,
        unfinished: bool = False,
        known: Callable[[View, Frame], DepthMap | None] = lambda view, frame: None,
    ) -> None:
        self._known = known
        self.scene, self.source, self.folder = scene, source, folder
        self.failed: dict[str, str] = {}
        self._unfinished = unfinished
        stems = dict(zip(names, target_stems(names), strict=True))
        self._file = {name: folder / f"context_depth_{stem}.npz" for name, stem in stems.items()}

    def covers(self, view: View) -> bool:
        """Whether the source does."""
        return self.source.covers(view)

    @property
    def kept(self) -> int:
        """How many of the views have a file."""
        return sum(path.exists() for path in self._file.values())

    def depth(self, view: View, frame: Frame) -> DepthMap:
        """The depth of a context view whose pixels are ``frame``.

        Raises:
            ProjectError: what was kept is damaged, or cannot be written.
        """
        path = self._file[view.name]
        if path.exists():
            try:
                found, failed = _read(path, frame)
            except (OSError, EOFError, ValueError, KeyError, BadZipFile, zlib.error) as error:
                if not self._unfinished:
                    raise ProjectError(
                        f"{path}: unreadable ({error!r}); expected depth of the context; start the "
                        "run again with another --out"
                    ) from error
            else:
                if failed:
                    self.failed[view.name] = failed
                return found
        try:
            spared = None if is_recorded(self.source, view) else self._known(view, frame)
            found = spared or self.source.depth(self.scene, view, frame)
        except DegenerateError as error:
            # The view stays without depth; the others carry the run.
            self.failed[view.name] = str(error)
            empty = np.zeros(frame.rgb.shape[:2], np.float32)
            found = DepthMap(empty, np.ones_like(empty), self.source.name)
        if found.source != RecordedDepth.name:
            _write(path, found, self.failed.get(view.name, ""))
        return found


def _read(path: Path, frame: Frame) -> tuple[DepthMap, str]:
    """What was kept, and why it is empty, where it is."""
    with np.load(path, allow_pickle=False) as stored:
        kept = DepthMap(stored["depth"], stored["confidence"], str(stored["source"]))
        failed = str(stored["failed"])
    if kept.depth.shape != frame.rgb.shape[:2]:
        raise ValueError(f"depth of {kept.depth.shape}, picture of {frame.rgb.shape[:2]}")
    return kept, failed


def _write(path: Path, found: DepthMap, failed: str) -> None:
    # The picture first: where the arrays stand, nothing is missing.
    with replaced_when_written(path.with_suffix(".png")) as temporary:
        write_png(temporary, colored(found.depth))
    with replaced_when_written(path) as temporary, temporary.open("wb") as file:
        save_arrays(
            file,
            depth=found.depth,
            confidence=found.confidence,
            source=np.array(found.source),
            failed=np.array(failed),
        )


def depth_report(scene: Scene, name: str, found: DepthMap) -> dict[str, Any]:
    """What a view's depth covers, and whether it has the scale of the sparse points."""
    fit = scale_to_points(scene, name, found.depth)
    report: dict[str, Any] = {
        "view": name,
        "source": found.source,
        "known": float((found.depth > 0).mean()),
        "scale": None,
    }
    if fit is not None:
        report["scale"] = {
            "status": fit.status,
            "scale": fit.scale,
            "inliers": fit.inliers,
            "inlier_share": fit.inlier_share,
            "residual": fit.residual,
            "support": fit.support,
            "disagrees": disagrees(fit),
        }
    return report


def warn_of_depth(reports: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Say of how many views there is no depth, or depth of another scale.

    Args:
        reports: see depth_report, with ``failed``.
        console: where to.
    """
    failed = [report for report in reports if report["failed"]]
    if failed:
        console.warn(
            f"{len(failed)} of {len(reports)} views have no depth and give no points, first: "
            f"{failed[0]['failed']}"
        )
    odd = _disagreeing(reports)
    if odd:
        first = odd[0]["scale"]
        console.warn(
            f"the depth of {len(odd)} of {len(reports)} views disagrees with the sparse points, "
            f"first {odd[0]['view']}: {first['status']}, scale {first['scale']:.3g}; look at its "
            "unit and at the poses"
        )


def off_scale(reports: Sequence[Mapping[str, Any]]) -> str | None:
    """One line with the names of the views whose depth disagrees with the sparse points."""
    names = [report["view"] for report in _disagreeing(reports)]
    if not names:
        return None
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return (
        f"depth of {len(names)} of {len(reports)} views is off the sparse points' scale: "
        f"{', '.join(names[:NAMED])}{more}"
    )


def _disagreeing(reports: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [report for report in reports if report["scale"] and report["scale"]["disagrees"]]


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
