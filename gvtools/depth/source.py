"""Depth sources behind one protocol, their check by other views, and their scale by sparse points.

A sensor's depth of foil, glass or dark cardboard is off by centimetres, and differs from view to
view. A point where other views measured something farther floats in front of what is there, and
hides it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.kernels import KernelSet, compiled, in_threads
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.similarity import ScaleFit, align_depth_scale
from gvtools.view_selection import nearest_views

# Another view agrees with a point if its depth there differs by less than AGREE of the point's, and
# looks through it if its depth there and around is greater by more than THROUGH.
AGREE, THROUGH = 0.02, 0.04
# Depth is contradicted where at least so many views look through it, and more than agree.
LEAST = 2


def contradictions(
    depth: NDArray[np.float32],
    camera: Cameras,
    others: Sequence[tuple[NDArray[np.float32], Cameras]],
) -> NDArray[np.bool_]:
    """(H, W) pixels whose depth (0 = none) other views, each with its camera, contradict."""
    height, width = depth.shape
    agree, through = np.zeros((2, height, width), np.uint8)
    for other, seen_by in others:
        motion = seen_by.cam_from_world[0] @ camera.world_from_cam[0]
        matrix = seen_by.K[0] @ motion[:3, :3] @ np.linalg.inv(camera.K[0])
        in_threads(
            _compare, height, depth, other, matrix, seen_by.K[0] @ motion[:3, 3], AGREE, THROUGH,
            agree, through,
        )  # fmt: skip
    return (through >= LEAST) & (through > agree)


@compiled()
def _compare(first, last, depth, other, matrix, offset, below, above, agree, through):
    """Count per pixel of rows ``first`` to before ``last`` if another view agrees or looks through.

    In: depth (H, W) and other (H', W') z-depth, 0 = none; z matrix (u, v, 1) + offset is the point
    of a pixel in homogeneous pixels of the other view, its last coordinate the z-depth there; below
    and above are AGREE and THROUGH. ``agree`` and ``through`` (H, W) are added to.
    """
    height, width = other.shape
    for row in range(first, last):
        v = row + 0.5
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if not z > 0:
                continue
            u = column + 0.5
            z2 = z * (matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]) + offset[2]
            if not z2 > 0:
                continue
            x = (z * (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) + offset[0]) / z2
            y = (z * (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) + offset[1]) / z2
            if x < 0 or y < 0 or x >= width or y >= height:
                continue
            theirs = other[int(y), int(x)]
            if not theirs > 0:
                continue
            if abs(theirs - z2) < below * z2:
                agree[row, column] += 1
            elif theirs > (1 + above) * z2 and _all_beyond(other, int(y), int(x), (1 + above) * z2):
                through[row, column] += 1


@compiled()
def _all_beyond(depth, row, column, least):
    """Whether all known depth of the 3 x 3 pixels around one is greater.

    Poses are a little off: beside something thin, a view seems to look through it.
    """
    for i in range(max(row - 1, 0), min(row + 2, depth.shape[0])):
        for j in range(max(column - 1, 0), min(column + 2, depth.shape[1])):
            if depth[i, j] > 0 and depth[i, j] <= least:
                return False
    return True


def compile_check() -> None:
    """Call the kernels once."""
    depth = np.ones((4, 4), np.float32)
    camera = Cameras.alike(np.eye(3), np.eye(4), size=(4, 4))
    contradictions(depth, camera, [(2 * depth, camera)])


KERNELS = KernelSet("check of depth", compile_check, _compare)


# Sparse points that have to fall on known depth.
MIN_POINTS = 20
# A scale farther from 1 than this is of other poses or another unit.
SUSPECT = 0.05


def scale_to_points(scene: Scene, name: str, depth: NDArray[np.float32]) -> ScaleFit | None:
    """The robust fit points = scale x depth (H, W) of a view's sparse points; None without any."""
    if scene.points is None:
        return None
    measured, known = depth_of_points(scene, name, depth)
    return align_depth_scale(measured, known, valid=measured > 0, min_support=MIN_POINTS)


def depth_of_points(
    scene: Scene, name: str, depth: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """A depth map's value (N,) at each sparse point of a view, and the point's own depth (N,).

    The map may have another size than the view; 0 = none.
    """
    points = scene.points
    assert points is not None
    row = scene.names.index(name)
    camera = scene.views[row].camera
    mine = points.view_index == row
    _, z = camera.project(points.positions[points.point_index[mine]])
    height, width = depth.shape
    column = np.floor(points.xy[mine, 0] * (width / int(camera.width[0]))).astype(np.int64)
    line = np.floor(points.xy[mine, 1] * (height / int(camera.height[0]))).astype(np.int64)
    inside = (column >= 0) & (column < width) & (line >= 0) & (line < height) & (z[0] > 0)
    return depth[line[inside], column[inside]], z[0][inside]


def disagrees(fit: ScaleFit | None) -> bool:
    """Whether a fit contradicts the depth: another scale, or points that fit no scale."""
    if fit is None or fit.support < MIN_POINTS:
        return False
    return not fit.ok or abs(fit.scale - 1) > SUSPECT


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
            ``contradictions``; without any, depth is taken as it is.
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
            wrong = contradictions(depth, view.camera, seen)
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
    """Recorded depth where a view has it, another source's elsewhere."""

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
