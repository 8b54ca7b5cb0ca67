"""Depth of two photographs side by side: rectified, then OpenCV's semi-global matching.

H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 30(2),
2008, as OpenCV's StereoSGBM has it. Far faster than a sweep, and made for exactly this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.depth.source import DepthMap
from gvtools.errors import ProjectError
from gvtools.scenes.scene import Frame, Scene, View

Float64 = NDArray[np.float64]

# A pair is rectifiable when its axes differ by no more than this, degrees, and its baseline leaves
# the common axis by at least this, degrees.
AXES = 6.0
SIDEWAYS = 75.0
# Window, penalties and checks of the matching, in OpenCV's terms.
BLOCK = 5
UNIQUENESS = 5
SPECKLE = 100
# Disparities without sparse points: up to this share of the width.
WIDEST = 0.35
# With them, up to this one.
WIDEST_EVER = 0.8
# Standard deviation of a disparity, pixels, and the relative depth error of half confidence.
DISPARITY_ERROR = 0.5
HALF_CONFIDENCE = 0.03


def is_rectifiable(cameras: Cameras) -> bool:
    """Whether two cameras stand side by side and look the same way, with images of one size."""
    if len(cameras) != 2 or len(set(zip(cameras.width.tolist(), cameras.height.tolist(),
                                        strict=True))) > 1:  # fmt: skip
        return False
    axes = cameras.cam_from_world[:, 2, :3]
    between = np.degrees(np.arccos(np.clip(axes[0] @ axes[1], -1, 1)))
    baseline = cameras.centers[1] - cameras.centers[0]
    length = float(np.linalg.norm(baseline))
    if between > AXES or length == 0:
        return False
    common = (axes[0] + axes[1]) / np.linalg.norm(axes[0] + axes[1])
    return bool(np.degrees(np.arccos(abs(common @ baseline) / length)) >= SIDEWAYS)


class RectifiedPair:
    """Depth of both views of a rectifiable pair, computed together when the first is asked for.

    Args:
        scene: the project.
        views: two names.

    Raises:
        ProjectError: the views cannot be rectified.
    """

    name = "rectified-pair"

    def __init__(self, scene: Scene, views: Sequence[str]) -> None:
        if len(views) != 2 or not is_rectifiable(scene.subset(views).cameras):
            raise ProjectError(
                f"{scene.root}: {len(views)} views; expected two side by side for rectified stereo"
            )
        self._scene, self._views = scene, tuple(views)
        self._maps: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] | None = None

    def covers(self, view: View) -> bool:
        """The two views."""
        return view.name in self._views

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """See ``DepthSource.depth``."""
        if not self.covers(view):
            raise ProjectError(f"{scene.root}: {view.name} is not of the pair {self._views}")
        if self._maps is None:
            self._maps = dict(zip(self._views, self._match(), strict=True))
        depth, confidence = self._maps[view.name]
        return DepthMap(depth, confidence, self.name)

    def _match(self) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        cameras = self._scene.subset(self._views).cameras
        rectified = _rectify(cameras)
        pictures = [
            rectified.picture(self._scene[name].load().rgb, side)
            for side, name in enumerate(self._views)
        ]
        low, high = self._disparities(cameras, rectified)
        if rectified.swapped:
            pictures.reverse()
        disparities = list(_both_disparities(*pictures, low=low, high=high))
        if rectified.swapped:
            disparities.reverse()
        return [rectified.depth(d, cameras[side], side) for side, d in enumerate(disparities)]

    def _disparities(self, cameras: Cameras, rectified: _Rectified) -> tuple[int, int]:
        """Range to search, pixels; from the sparse points where there are enough."""
        width = rectified.size[0]
        low, high = 0.0, WIDEST * width
        points = self._scene.points
        if points is not None:
            rows = [self._scene.names.index(name) for name in self._views]
            seen = np.unique(points.point_index[np.isin(points.view_index, rows)])
            _, z = cameras[0].project(points.positions[seen])
            known = z[0][z[0] > 0]
            if len(known) >= 20:
                near, far = np.percentile(known, (1, 99))
                low = max(0.7 * rectified.strength / far, 0.0)
                high = 1.3 * rectified.strength / near
        first = int(min(low, 0.5 * width)) // 16 * 16
        last = int(min(high, WIDEST_EVER * width))
        return first, first + max(-(-(last - first) // 16), 1) * 16


@dataclass(frozen=True, eq=False)
class _Rectified:
    """Both cameras turned so that rows of one image are rows of the other.

    Attributes:
        K: (3, 3) of both, pixels as OpenCV counts them (first centre at 0).
        turns: two (3, 3) rotations, from each camera to its turned one.
        Ks: two (3, 3) of the given cameras, pixels as OpenCV counts them.
        size: width and height.
        strength: focal length times baseline: disparity times depth.
        vertical: the cameras stand one above the other; images are transposed.
        swapped: the second camera is the left (or upper) one.
    """

    K: Float64
    turns: tuple[Float64, Float64]
    Ks: tuple[Float64, Float64]
    size: tuple[int, int]
    strength: float
    vertical: bool
    swapped: bool

    def picture(self, rgb: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
        """A picture seen by its turned camera."""
        import cv2

        maps = cv2.initUndistortRectifyMap(
            self.Ks[side], np.zeros(5), self.turns[side], self.K, self.size, cv2.CV_32FC1
        )
        out = np.asarray(cv2.remap(rgb, maps[0], maps[1], cv2.INTER_LINEAR), np.uint8)
        return np.ascontiguousarray(out.transpose(1, 0, 2)) if self.vertical else out

    def depth(
        self, disparity: NDArray[np.float32], camera: Cameras, side: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """z-depth and confidence in the given camera, from a disparity map of its turned one."""
        import cv2

        if self.vertical:
            disparity = np.ascontiguousarray(disparity.T)
        height, width = int(camera.height[0]), int(camera.width[0])
        u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(self.Ks[side]).T
        turned = rays @ self.turns[side].T
        place = turned @ self.K.T
        x, y = (place[..., :2] / place[..., 2:]).transpose(2, 0, 1).astype(np.float32)
        found = cv2.remap(disparity, x, y, cv2.INTER_NEAREST, borderValue=0)
        known = (found > 0) & (turned[..., 2] > 0)
        depth = np.zeros((height, width), np.float32)
        # Depth along the turned axis, carried along the pixel's own ray.
        along = self.strength / found[known]
        depth[known] = along / turned[known][:, 2]
        error = DISPARITY_ERROR / np.maximum(found, 1e-6)
        confidence = 1 / (1 + (error / HALF_CONFIDENCE) ** 2)
        return depth, np.where(known, confidence, 1).astype(np.float32)


def _rectify(cameras: Cameras) -> _Rectified:
    import cv2

    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    Ks = (cameras.K[0] - half, cameras.K[1] - half)
    relative = cameras.cam_from_world[1] @ cameras.world_from_cam[0]
    size = (int(cameras.width[0]), int(cameras.height[0]))
    R1, R2, P1, P2 = cv2.stereoRectify(
        Ks[0], np.zeros(5), Ks[1], np.zeros(5), size, relative[:3, :3], relative[:3, 3:],
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )[:4]  # fmt: skip
    vertical = bool(abs(P2[1, 3]) > abs(P2[0, 3]))
    shift = float(P2[1, 3] if vertical else P2[0, 3])
    turns = np.asarray(R1, np.float64), np.asarray(R2, np.float64)
    return _Rectified(
        np.asarray(P1[:, :3], np.float64), turns, Ks, size, abs(shift), vertical, shift > 0
    )


def _both_disparities(
    left: NDArray[np.uint8], right: NDArray[np.uint8], *, low: int, high: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Disparities of both images, pixels, 0 = none; each confirmed by the other."""
    import cv2

    # The right image's search is the left one's in a mirror.
    searches = ((left, right), (right[:, ::-1], left[:, ::-1]))
    found = []
    for first, second in searches:
        matcher = cv2.StereoSGBM.create(
            minDisparity=low, numDisparities=max(high - low, 16), blockSize=BLOCK,
            P1=8 * 3 * BLOCK**2, P2=32 * 3 * BLOCK**2, uniquenessRatio=UNIQUENESS,
            speckleWindowSize=SPECKLE, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )  # fmt: skip
        # OpenCV leaves out as many columns at the left as it searches; a margin takes their place.
        margin = [(0, 0), (high, 0), (0, 0)]
        raw = matcher.compute(np.pad(first, margin), np.pad(second, margin))[:, high:]
        found.append(np.where(raw > 16 * low, raw / np.float32(16), 0).astype(np.float32))
    mine, other = found[0], np.ascontiguousarray(found[1][:, ::-1])
    return _confirmed(mine, other, -1), _confirmed(other, mine, 1)


def _confirmed(
    mine: NDArray[np.float32], other: NDArray[np.float32], direction: int
) -> NDArray[np.float32]:
    """The disparities that the other image's agree with within a pixel."""
    width = mine.shape[1]
    column = np.arange(width) + direction * np.rint(mine).astype(np.int64)
    inside = (column >= 0) & (column < width) & (mine > 0)
    there = np.take_along_axis(other, np.clip(column, 0, width - 1), axis=1)
    return np.where(inside & (np.abs(there - mine) <= 1), mine, 0).astype(np.float32)
