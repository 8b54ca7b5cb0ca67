"""Depth sources behind one protocol: where a view's depth comes from and how far it is trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.scene import Frame, Scene, View


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depth of one view.

    Attributes:
        depth: (H, W) float32 z-depth, scene units, 0 = none.
        confidence: (H, W) float32 in (0, 1].
        source: name of the source.
    """

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    source: str


class DepthSource(Protocol):
    """Gives the depth of a scene's views."""

    name: str

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The depth of ``view``, whose pixels are ``frame``."""
        ...


class RecordedDepth:
    """Depth that the project itself holds: a sensor's, or COLMAP's stereo maps.

    The error of triangulated depth, by structured light or by stereo, grows with its square; the
    confidence falls likewise beyond the scene's near range (the view's 10th percentile).
    """

    name = "recorded"

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The depth that was loaded with the picture.

        Raises:
            ProjectError: the view has none.
        """
        if frame.depth is None:
            raise ProjectError(
                f"{scene.root}: view {view.name} has no depth; leave it out of the context or "
                "add its depth map"
            )
        depth = frame.depth
        known = depth[depth > 0]
        near = float(np.percentile(known, 10)) if known.size else 1.0
        with np.errstate(divide="ignore"):
            confidence = np.minimum((near / depth) ** 2, 1.0, dtype=np.float32)
        return DepthMap(depth, np.where(depth > 0, confidence, np.float32(1)), self.name)


CHOICES = ("auto", "sensor", "colmap")


def choose_source(scene: Scene, views: tuple[str, ...], choice: str) -> DepthSource:
    """The source for the views that a run lifts.

    Args:
        scene: the project.
        views: names of the context views.
        choice: one of CHOICES; ``sensor`` wants RGB-D, ``colmap`` COLMAP's stereo maps.

    Raises:
        OptionError: unknown choice, or one that the project cannot give.
        ProjectError: no view has depth.
    """
    if choice not in CHOICES:
        raise OptionError(f"depth {choice!r}; expected one of {', '.join(CHOICES)}")
    if (choice == "sensor" and scene.kind == "colmap") or (
        choice == "colmap" and scene.kind != "colmap"
    ):
        raise OptionError(f"depth {choice!r}: {scene.root} is a {scene.kind} project; use auto")
    with_depth = sum(scene[name].has_depth for name in views)
    if not with_depth:
        raise ProjectError(
            f"{scene.root}: none of the {len(views)} context views has depth; run COLMAP's "
            "patch_match_stereo on an undistorted workspace (stereo/depth_maps is then read), or "
            "use a posed RGB-D recording"
        )
    return RecordedDepth()
