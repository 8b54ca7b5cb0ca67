"""Depth sources behind one protocol: where a view's depth comes from and how far it is trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gvtools.depth.view_check import contradicted
from gvtools.errors import ProjectError
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.view_selection import nearest_views

# How many of the nearest views each depth map is checked against.
CHECKING_VIEWS = 8


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depth of one view."""

    depth: NDArray[np.float32]  # (H, W) float32 z-depth, scene units, 0 = none
    confidence: NDArray[np.float32]  # (H, W) float32 in (0, 1]
    source: str  # name of the source
    contradicted: int = 0  # how many pixels' depth was dropped because other views look through it
    # (H, W) pixels whose depth nothing confirms, which the memory takes as generated; None for
    # none; not kept in files.
    guessed: NDArray[np.bool_] | None = None


class DepthSource(Protocol):
    """Gives the depth of a scene's views.

    A source that reads weights names them in an attribute ``files``: they decide the result.
    """

    name: str

    def covers(self, view: View) -> bool:
        """Whether the source has, or can find, the depth of ``view``."""
        ...

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The depth of ``view``, whose pixels are ``frame``."""
        ...


class RecordedDepth:
    """Depth that the project itself holds: a sensor's, or COLMAP's stereo maps.

    The error of triangulated depth, by structured light or by stereo, grows with the square of
    depth. Confidence is (d / depth)^2, at most 1, where d is the view's 10th percentile of depth.

    Args:
        views: names of the views whose recorded depth each depth map is checked against, see
            ``contradicted``; without any, depth is taken as it is.
    """

    name = "recorded"

    def __init__(self, views: Sequence[str] = ()) -> None:
        self.views = tuple(views)
        # Views that are lifted one after the other share most neighbours.
        self._kept_depth = lru_cache(maxsize=2 * CHECKING_VIEWS)(_usable_depth)

    def covers(self, view: View) -> bool:
        """Views with a depth map."""
        return view.has_depth

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The depth that was loaded with the picture, but for what other views look through."""
        if frame.depth is None:
            raise ProjectError(
                f"{scene.root}: view {view.name} has no depth; leave it out of the context or "
                "add its depth map"
            )
        depth = frame.depth
        others = [name for name in self.views if name != view.name and scene[name].has_depth]
        wrong = np.zeros(depth.shape, np.bool_)
        if others:
            near = nearest_views(scene.subset(others).cameras, view.camera, CHECKING_VIEWS)
            checking = [scene[others[row]] for row in near]
            seen = [(self._kept_depth(other.load), other.camera) for other in checking]
            wrong = contradicted(depth, view.camera, seen)
            if frame.mask is not None:
                wrong &= frame.mask
        depth = np.where(wrong, np.float32(0), depth)
        known = depth[depth > 0]
        near_depth = float(np.percentile(known, 10)) if known.size else 1.0
        with np.errstate(divide="ignore"):
            confidence = np.minimum((near_depth / depth) ** 2, 1.0, dtype=np.float32)
        confidence = np.where(depth > 0, confidence, np.float32(1))
        return DepthMap(depth, confidence, self.name, int(wrong.sum()))


def _usable_depth(load: Callable[[], Frame]) -> NDArray[np.float32]:
    """A view's depth, 0 where its mask leaves pixels out."""
    frame = load()
    assert frame.depth is not None
    return frame.depth if frame.mask is None else np.where(frame.mask, frame.depth, np.float32(0))


class MixedDepth:
    """Recorded depth where a view has it, another source's elsewhere.

    Args:
        computed: for the views that the first does not cover.
    """

    def __init__(self, recorded: DepthSource, computed: DepthSource) -> None:
        self.recorded, self.computed = recorded, computed
        self.name = f"{recorded.name} + {computed.name}"
        self.files: tuple[Path, ...] = getattr(computed, "files", ())

    def covers(self, view: View) -> bool:
        """Views of either source."""
        return self.recorded.covers(view) or self.computed.covers(view)

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """Of the first source that covers the view; see ``DepthSource.depth``."""
        source = self.recorded if self.recorded.covers(view) else self.computed
        return source.depth(scene, view, frame)


def is_recorded(source: DepthSource, view: View) -> bool:
    """Whether the source reads the depth of ``view``, where it would otherwise compute it."""
    if isinstance(source, MixedDepth):
        source = source.recorded if source.recorded.covers(view) else source.computed
    return isinstance(source, RecordedDepth) and source.covers(view)
