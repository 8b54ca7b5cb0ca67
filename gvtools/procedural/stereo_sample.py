"""The sample pair: the Motorcycle of the Middlebury 2014 stereo benchmark, a real photograph pair.

The scikit-image wheel ships it at a quarter of its size, with the left view's disparity measured
by structured light (Scharstein et al., High-resolution stereo datasets with subpixel-accurate
ground truth, GCPR 2014). It is written as a COLMAP workspace in metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, Float64
from gvtools.procedural.sample_workspace import (
    SampleContent,
    WrittenSample,
    is_written,
    write_sample,
)

# The calibration of the full-size pair, in its pixels, first pixel's centre at 0; the shipped
# images average blocks of 4 x 4.
SHRINK = 4
FOCAL = 3979.911 / SHRINK
LEFT_X = (1244.772 + 0.5) / SHRINK
CENTER_Y = (1019.507 + 0.5) / SHRINK
OFFSET = 124.343 / SHRINK  # the right principal point lies this much farther right, pixels
BASELINE = 0.193001  # metres

LEFT, RIGHT = "left.png", "right.png"
POINTS = 1500


def write_motorcycle(folder: Path) -> WrittenSample:
    """Write the pair; a folder that holds it already is left as it is.

    A COLMAP workspace in metres, its world the left camera's frame. Pixels without measured
    disparity have depth 0. Sparse points lie on the measured surface, each with a track of both
    views.
    """
    folder = Path(folder)
    sample = WrittenSample(folder, context=(LEFT,), targets=(RIGHT,), depth_truth=(LEFT,))
    record = sample.record("motorcycle", version=1)
    if is_written(folder, record):
        return sample
    import skimage.data

    left, right, disparity = skimage.data.stereo_motorcycle()
    depth = depth_from_disparity(disparity)
    cameras = motorcycle_cameras(left.shape[1], left.shape[0])
    depths = [depth.astype(np.float32), None]
    surface = _surface_points(cameras, left, depth)
    write_sample(folder, SampleContent(cameras, [left, right], depths, *surface), record=record)
    return sample


def motorcycle_cameras(width: int, height: int) -> Cameras:
    """The two cameras of the pair, left then right, in metres."""
    left = np.array([[FOCAL, 0, LEFT_X], [0, FOCAL, CENTER_Y], [0, 0, 1]])
    right = left.copy()
    right[0, 2] += OFFSET
    pose = np.repeat(np.eye(4)[None], 2, axis=0)
    pose[1, 0, 3] = -BASELINE
    return Cameras.alike(np.stack([left, right]), pose, size=(width, height), names=(LEFT, RIGHT))


def depth_from_disparity(disparity: NDArray[np.floating]) -> Float64:
    """(H, W) z-depth, metres, 0 = none, of (H, W) disparity, pixels, NaN or infinity = none."""
    measured = np.isfinite(disparity)
    shift = np.where(measured, disparity, 0).astype(np.float64) + OFFSET
    return np.where(measured & (shift > 0), FOCAL * BASELINE / np.maximum(shift, 1e-6), 0)


def _surface_points(
    cameras: Cameras, image: NDArray[np.uint8], depth: Float64
) -> tuple[Float64, NDArray[np.uint8], tuple[NDArray[np.intp], NDArray[np.intp], Float64]]:
    """Points where the left picture has detail and the right camera sees the same surface."""
    rows, columns = np.nonzero(depth > 0)
    points = cameras.rays(0)[rows, columns] * depth[rows, columns, None]
    xy, z = cameras.project(points)
    width, height = int(cameras.width[1]), int(cameras.height[1])
    column = np.floor(xy[1, :, 0]).astype(int)
    inside = (column >= 1) & (column < width - 1)
    nearest = np.full((height, width), np.inf)
    np.minimum.at(nearest, (rows[inside], column[inside]), z[1, inside])
    # A surface in front covers its neighbours' pixels too, hence the three columns.
    cover = np.full(len(z[1]), np.inf)
    cover[inside] = np.min(
        [nearest[rows[inside], column[inside] + step] for step in (-1, 0, 1)], axis=0
    )
    gradient = np.hypot(*np.gradient(image.astype(np.float64).mean(-1)))[rows, columns]
    seen = inside & (z[1] < 1.02 * cover)
    rng = np.random.default_rng(0)
    chance = np.where(seen, gradient, 0)
    chosen = np.sort(rng.choice(len(chance), POINTS, False, chance / chance.sum()))
    tracks = (
        np.repeat(np.arange(POINTS), 2),
        np.tile([0, 1], POINTS),
        xy[:, chosen].transpose(1, 0, 2).reshape(-1, 2),
    )
    return points[chosen], image[rows[chosen], columns[chosen]], tracks
