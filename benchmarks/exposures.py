"""Exposures of the photographs, told apart by what several of them see of the same surfaces.

Cameras on automatic choose another exposure for each photograph. Each gets one factor a channel
that brings its colours to a common exposure. A picture rendered from such colours is then brought
to the exposure that the photographs nearest to its camera have, as a camera there would choose
alike; without that, a rendering has an exposure that no photograph has.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import Cameras
from gvtools.depth.source import DepthMap
from gvtools.errors import DegenerateError
from gvtools.scenes.scene import Scene

Float64 = NDArray[np.float64]

# Longer side of the pictures that are compared, pixels; the others that each is compared with, the
# nearest; and the surface points that two need to share.
SIDE, OTHERS, SHARED = 160, 8, 100
# Two views see the same surface point when their depths of it differ by less than this share.
SAME_DEPTH = 0.02
# Darker and brighter values tell little of the exposure, of 255.
DARKEST, BRIGHTEST = 8, 247
# What holds each logarithm to 0, in shared points: decides where views share nothing.
HOLD = 1.0
# Photographs whose exposure a rendered picture takes, the nearest.
AROUND = 2


@dataclass(frozen=True, eq=False)
class Exposures:
    """Factors to a common exposure.

    Attributes:
        cameras: of the V photographs.
        gain: (V, 3) float64 > 0, for red, green and blue; their geometric mean is 1.
    """

    cameras: Cameras
    gain: Float64

    def common(self, rgb: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
        """A photograph's colours, (..., 3) uint8, at the common exposure."""
        return _scaled(rgb, self.gain[self.cameras.names.index(name)])

    def gain_at(self, camera: Cameras) -> Float64:
        """(3,) the factors of a photograph taken at ``camera``: the nearest ones', by nearness."""
        distance = np.linalg.norm(self.cameras.centers - camera.centers[0], axis=-1)
        nearest = np.argsort(distance, kind="stable")[:AROUND]
        weight = 1 / (distance[nearest] + 1e-9 * (distance.max() + 1e-300))
        return np.exp(weight @ np.log(self.gain[nearest]) / weight.sum())

    def as_taken_at(self, rgb: NDArray[np.uint8], camera: Cameras) -> NDArray[np.uint8]:
        """Colours at the common exposure, (..., 3) uint8, as a photograph there would have them."""
        return _scaled(rgb, 1 / self.gain_at(camera))


def estimate_exposures(
    scene: Scene, depths: Mapping[str, DepthMap], *, others: int = OTHERS
) -> Exposures:
    """The exposures of the views that have depth; no other view is looked at.

    Of each two nearby views the median ratio of the colours that they see of the same surface
    points is taken; the logarithms of the gains are the least-squares solution of all these,
    each counting by its points. Medians make specular and wrongly placed points harmless.

    Args:
        scene: the project.
        depths: for each of V views its depth, at its picture's size.
        others: how many of the nearest views each is compared with.

    Raises:
        DegenerateError: no depth at all.
    """
    names = tuple(depths)
    if not names:
        raise DegenerateError("exposures of 0 views; expected depth of at least one")
    rows = [scene.names.index(name) for name in names]
    cameras = scene.cameras[rows]
    views = [_Small.of(scene, name, depths[name].depth) for name in names]
    count = len(names)
    system, right = HOLD * np.eye(count), np.zeros((count, 3))
    for i, view in enumerate(views):
        distance = np.linalg.norm(cameras.centers - cameras.centers[i], axis=-1)
        distance[i] = np.inf
        for j in np.argsort(distance, kind="stable")[: min(others, count - 1)]:
            mine, theirs = view.shared(views[j])
            if len(mine) < SHARED:
                continue
            # gain_i · mine = gain_j · theirs
            ratio = np.median(np.log(theirs) - np.log(mine), axis=0)
            n = len(mine)
            system[[i, j], [i, j]] += n
            system[[i, j], [j, i]] -= n
            right[i] += n * ratio
            right[j] -= n * ratio
    logarithm = np.linalg.solve(system, right)
    return Exposures(cameras, np.exp(logarithm - logarithm.mean(axis=0)))


@dataclass(frozen=True, eq=False)
class _Small:
    """A view reduced for comparing: (h, w, 3) float64 colours of 255, (h, w) depth, its camera."""

    colors: Float64
    depth: NDArray[np.float32]
    camera: Cameras

    @staticmethod
    def of(scene: Scene, name: str, depth: NDArray[np.float32]) -> _Small:
        import cv2

        frame, camera = scene[name].load(), scene[name].camera
        height, width = depth.shape
        scale = min(1.0, SIDE / max(height, width))
        w, h = max(1, round(scale * width)), max(1, round(scale * height))
        colors = cv2.resize(frame.rgb, (w, h), interpolation=cv2.INTER_AREA).astype(np.float64)
        # The depth at the centre of each small pixel.
        y = ((np.arange(h) + 0.5) * height / h).astype(np.int64)
        x = ((np.arange(w) + 0.5) * width / w).astype(np.int64)
        small = depth[np.ix_(y, x)]
        if frame.mask is not None:
            small = np.where(frame.mask[np.ix_(y, x)], small, np.float32(0))
        return _Small(colors, small, camera.resized(w, h))

    def shared(self, other: _Small) -> tuple[Float64, Float64]:
        """(N, 3) colours here and (N, 3) there of the surface points that both see."""
        y, x = np.nonzero(self.depth > 0)
        local = self.camera.rays()[y, x] * self.depth[y, x, None]
        pose = self.camera.world_from_cam[0]
        xy, z = other.camera.project(local @ pose[:3, :3].T + pose[:3, 3])
        height, width = other.depth.shape
        with np.errstate(invalid="ignore"):
            inside = (z[0] > 0) & (xy[0] >= 0).all(-1) & (xy[0] < (width, height)).all(-1)
        y, x, z = y[inside], x[inside], z[0][inside]
        column, row = xy[0][inside].astype(np.int64).T
        theirs = other.depth[row, column]
        mine_color, their_color = self.colors[y, x], other.colors[row, column]
        use = (theirs > 0) & (np.abs(theirs - z) < SAME_DEPTH * z)
        for color in (mine_color, their_color):
            use &= ((color > DARKEST) & (color < BRIGHTEST)).all(-1)
        return mine_color[use], their_color[use]


def _scaled(rgb: ArrayLike, gain: Float64) -> NDArray[np.uint8]:
    return np.clip(np.round(np.asarray(rgb) * gain), 0, 255).astype(np.uint8)
