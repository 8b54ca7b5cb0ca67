"""Depth of a run's context: recorded, kept by round 0, or computed and kept there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.depth.fitted_depth import FittedDepth
from gvtools.depth.scale import disagrees, scale_to_points
from gvtools.depth.source import DepthMap, DepthSource, RecordedDepth, is_recorded
from gvtools.errors import DegenerateError, ProjectError
from gvtools.runs.context_depth import (
    UNREADABLE,
    context_depth_files,
    read_context_depth,
    write_context_depth,
)
from gvtools.scenes.scene import Frame, Scene, View


class DepthCache:
    """The depth of a run's context: recorded, kept by round 0, or asked of the source.

    Args:
        source: where depth comes from.
        folder: of round 0; what is not recorded is written there, and read again later.
        unfinished: round 0 is being written; a damaged file in its folder is then replaced.
        fallback: gives depth of a view that takes the place of computed depth, or None.

    Attributes:
        failed: views that no depth was computed for, with the reason.
    """

    def __init__(
        self,
        scene: Scene,
        names: Sequence[str],
        source: DepthSource,
        *,
        folder: Path,
        unfinished: bool = False,
        fallback: Callable[[View, Frame], DepthMap | None] = lambda view, frame: None,
    ) -> None:
        self.scene, self.source = scene, source
        self.failed: dict[str, str] = {}
        self._fallback, self._unfinished = fallback, unfinished
        self._file = context_depth_files(folder, names)

    def covers(self, view: View) -> bool:
        """Whether the source does."""
        return self.source.covers(view)

    @property
    def kept(self) -> int:
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
    report: dict[str, Any] = {
        "view": name,
        "source": depth_map.source,
        "known": float((depth_map.depth > 0).mean()),
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
