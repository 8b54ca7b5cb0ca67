"""Depth of the context that was computed rather than recorded: kept in round 0, and looked at.

``context_depth_NAME.npz`` has the keys depth (float32 z-depth, scene units, 0 = none) and
confidence; ``context_depth_NAME.png`` shows it, near red, far blue, none black.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from gvtools.depth.scale_check import disagrees, scale_to_points
from gvtools.depth.source import DepthMap, DepthSource, RecordedDepth
from gvtools.errors import DegenerateError, ProjectError
from gvtools.scenes.scene import Frame, Scene, View
from pipelines.round_files import target_stems, write_png


class KeptDepth:
    """The depth of a run's context: recorded, kept by round 0, or asked of the source.

    Args:
        scene: the project.
        names: of the context views.
        source: where depth comes from.
        folder: of round 0; what is not recorded is written there, and read again later.
    """

    def __init__(
        self, scene: Scene, names: Sequence[str], source: DepthSource, folder: Path
    ) -> None:
        self.scene, self.source, self.folder = scene, source, folder
        # Views that no depth was found for, with the reason.
        self.failed: dict[str, str] = {}
        self._stem = dict(zip(names, target_stems(names), strict=True))

    def covers(self, view: View) -> bool:
        """Whether the source does."""
        return self.source.covers(view)

    def depth(self, view: View, frame: Frame) -> DepthMap:
        """The depth of a context view whose pixels are ``frame``.

        Raises:
            ProjectError: what was kept is damaged.
        """
        path = self.folder / f"context_depth_{self._stem[view.name]}.npz"
        if not path.exists():
            try:
                found = self.source.depth(self.scene, view, frame)
            except DegenerateError as error:
                # The view stays without depth; the others carry the run.
                self.failed[view.name] = str(error)
                empty = np.zeros(frame.rgb.shape[:2], np.float32)
                found = DepthMap(empty, np.ones_like(empty), self.source.name)
            if found.source != RecordedDepth.name:
                self._keep(path, found)
            return found
        try:
            with np.load(path, allow_pickle=False) as stored:
                kept = DepthMap(stored["depth"], stored["confidence"], str(stored["source"]))
            if kept.depth.shape != frame.rgb.shape[:2]:
                raise ValueError(f"depth of {kept.depth.shape}, picture of {frame.rgb.shape[:2]}")
            return kept
        except (OSError, EOFError, ValueError, KeyError, BadZipFile, zlib.error) as error:
            raise ProjectError(
                f"{path}: unreadable ({error!r}); expected depth of the context; start the run "
                "again with another --out"
            ) from error

    def _keep(self, path: Path, found: DepthMap) -> None:
        np.savez_compressed(
            path,
            depth=found.depth,
            confidence=found.confidence,
            source=np.array(found.source),
        )
        write_png(path.with_suffix(".png"), colored(found.depth))


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
