"""What a cheap structured-light camera would measure of an exact depth map.

Range noise has the form that Nguyen, Izadi and Lovell measured of the first Kinect (Modeling Kinect
sensor noise for improved 3D reconstruction and tracking, 3DIMPVT 2012), with somewhat larger
numbers; disparity comes in eighths of a pixel (Khoshelham and Elberink, Sensors 2012). Depth is
missing in the projector's shadow, where little light comes back, on glossy surfaces that throw it
elsewhere, at part of the edges, and along one side of the picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.special import ndtr

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

RANGE = (0.4, 6.0)  # metres
BASELINE = 0.075  # from camera to projector, which stands on its right, metres
DISPARITY = 580 * BASELINE  # pixels of the sensor times metres
STEPS = 8  # of disparity, to a pixel of the sensor
CORRELATED = 0.5  # share of the noise's variance that neighbouring pixels have in common
CORRELATION = 2.5  # its length, pixels
STRIP = 0.04  # share of the columns, on the right, that have no depth
EDGE = 0.05  # depth within three pixels that is an edge, as a share of depth
FLYING, LOST = 0.4, 0.3  # of edge pixels: between front and back, and without depth
FAINT = 0.016  # light that comes back, that of a white surface at 2 m being 1: half is lost
PATCH = 1.5  # pixels, the size of holes
MIRROR, GRAZING = 0.97, 0.5  # cosines beyond which a glossy surface dazzles, or sends nothing back


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What the rays through the pixels' centres meet.

    Attributes:
        depth: (H, W) float32, exact z-depth, metres.
        albedo: (H, W) float32 in [0, 1], the share of light that comes back.
        glossy: (H, W) bool.
        rays: (H, W, 3) float64, camera-frame points at z-depth 1.
    """

    depth: Float32
    albedo: Float32
    glossy: Mask
    rays: Float64


def range_noise(depth: Float32) -> Float32:
    """Standard deviation of the measured z-depth at true z-depths, metres.

    >>> range_noise(np.array([0.4, 2.4])).round(4)
    array([0.0015, 0.0115])
    """
    return 0.0015 + 0.0025 * (depth - 0.4) ** 2


def measured_depth(surfaces: Surfaces, rng: np.random.Generator) -> Float32:
    """(H, W) float32 z-depth as the sensor reports it, metres, 0 where it reports none."""
    depth = surfaces.depth
    front, back = minimum_filter(depth, 3), maximum_filter(depth, 3)
    edge = back - front > EDGE * depth
    draw = rng.random(depth.shape)
    between = front + rng.random(depth.shape) * (back - front)
    z = np.where(edge & (draw < FLYING), between, depth)
    z = z + range_noise(z) * _noise(depth.shape, rng)
    z = DISPARITY / np.maximum(np.rint(DISPARITY / np.maximum(z, 0.1) * STEPS), 1) * STEPS
    lost = edge & (draw > 1 - LOST)
    lost |= _shadow(surfaces) | _without_echo(surfaces, rng)
    lost[:, round(depth.shape[1] * (1 - STRIP)) :] = True
    lost |= (z < RANGE[0]) | (z > RANGE[1])
    return np.where(lost, 0, z).astype(np.float32)


def _noise(shape: tuple[int, ...], rng: np.random.Generator) -> Float64:
    """(H, W) of mean 0 and deviation 1, in part common to neighbours."""
    common = _smooth(shape, CORRELATION, rng)
    return np.sqrt(CORRELATED) * common + np.sqrt(1 - CORRELATED) * rng.standard_normal(shape)


def _smooth(shape: tuple[int, ...], length: float, rng: np.random.Generator) -> Float64:
    """Smoothed normal numbers, again of deviation 1: the filter's weights add up in squares."""
    weights = gaussian_filter(np.eye(1, 129, 64), (0, length))
    return np.asarray(gaussian_filter(rng.standard_normal(shape), length) / (weights**2).sum())


def _shadow(surfaces: Surfaces) -> Mask:
    """Pixels that the projector cannot reach, since something in front stands in its way.

    Seen from the projector, surfaces shift to the left by their disparity; what has a surface from
    further right to its left there is hidden.
    """
    slope = surfaces.rays[..., 0] - BASELINE / surfaces.depth
    nearest = np.minimum.accumulate(slope[:, ::-1], axis=1)[:, ::-1]
    return slope > nearest + 1e-9


def _without_echo(surfaces: Surfaces, rng: np.random.Generator) -> Mask:
    """Dark, far, slanted and glossy surfaces, in patches."""
    cosine = _incidence(surfaces)
    # The sensor matches windows of its pattern, so that texture finer than those does not count.
    light = gaussian_filter(surfaces.albedo * cosine * (2 / surfaces.depth) ** 2, PATCH)
    chance = np.clip(1.5 - light / FAINT, 0, 1)
    chance[surfaces.glossy & ((cosine > MIRROR) | (cosine < GRAZING))] = 0.9
    return ndtr(_smooth(chance.shape, PATCH, rng)) < chance


def _incidence(surfaces: Surfaces) -> Float64:
    """(H, W) cosine of the angle between rays and surface normals."""
    points = surfaces.rays * surfaces.depth[..., None]
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    rays = surfaces.rays / np.linalg.norm(surfaces.rays, axis=-1, keepdims=True)
    return np.abs((normal * rays).sum(-1))
