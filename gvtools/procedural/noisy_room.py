"""The demo's room as somebody records it who walks through it with a cheap RGB-D camera.

Room, cameras and seeds are those of ``write_room``, so that runs on the two differ by the noise
alone. Context views have measured depth, poses of a tracker that errs, and an exposure of their
own. Target views have none of it: they are held out as the truth.

The depth is that of a structured-light camera: range noise has the form that Nguyen, Izadi and
Lovell measured of the first Kinect (Modeling Kinect sensor noise for improved 3D reconstruction
and tracking, 3DIMPVT 2012), with somewhat larger numbers; disparity comes in eighths of a pixel
(Khoshelham and Elberink, Sensors 2012). Depth is missing in the projector's shadow, where little
light comes back, on glossy surfaces that throw it elsewhere, at part of the edges, and along one
side of the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from gvtools.cameras import Cameras, Float64, invert_rigid, rigid_poses
from gvtools.procedural.builder import ProceduralScene
from gvtools.procedural.ray_cast import BOX, cast
from gvtools.procedural.render import Look, radiance, to_srgb
from gvtools.procedural.room_sample import check_options, room_views
from gvtools.procedural.sample_workspace import WrittenSample, is_written, save_png, written_whole
from gvtools.scenes.calibration import INTRINSICS
from gvtools.similarity import align_poses

Float32 = NDArray[np.float32]
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
class SensorView:
    """What the rays through the pixels' centres meet."""

    depth: Float32  # (H, W) float32, exact z-depth, metres
    albedo: Float32  # (H, W) float32 in [0, 1], the share of light that comes back
    glossy: Mask  # (H, W) bool
    rays: Float64  # (H, W, 3) float64, camera-frame points at z-depth 1


def range_noise(depth: Float32) -> Float32:
    """Standard deviation of the measured z-depth at true z-depths, metres.

    >>> range_noise(np.array([0.4, 2.4])).round(4)
    array([0.0015, 0.0115])
    """
    return 0.0015 + 0.0025 * (depth - 0.4) ** 2


def measured_depth(surfaces: SensorView, rng: np.random.Generator) -> Float32:
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


def _shadow(surfaces: SensorView) -> Mask:
    """Pixels that the projector cannot reach, since something in front stands in its way.

    Seen from the projector, surfaces shift to the left by their disparity; what has a surface from
    further right to its left there is hidden.
    """
    slope = surfaces.rays[..., 0] - BASELINE / surfaces.depth
    nearest = np.minimum.accumulate(slope[:, ::-1], axis=1)[:, ::-1]
    return slope > nearest + 1e-9


def _without_echo(surfaces: SensorView, rng: np.random.Generator) -> Mask:
    """Dark, far, slanted and glossy surfaces, in patches."""
    cosine = _incidence(surfaces)
    # The sensor matches windows of its pattern, so that texture finer than those does not count.
    light = gaussian_filter(surfaces.albedo * cosine * (2 / surfaces.depth) ** 2, PATCH)
    chance = np.clip(1.5 - light / FAINT, 0, 1)
    chance[surfaces.glossy & ((cosine > MIRROR) | (cosine < GRAZING))] = 0.9
    return ndtr(_smooth(chance.shape, PATCH, rng)) < chance


def _incidence(surfaces: SensorView) -> Float64:
    """(H, W) cosine of the angle between rays and surface normals."""
    points = surfaces.rays * surfaces.depth[..., None]
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    rays = surfaces.rays / np.linalg.norm(surfaces.rays, axis=-1, keepdims=True)
    return np.abs((normal * rays).sum(-1))


# Of context poses before alignment, root mean square over views: length of the centre's error,
# angle of the turn.
POSE_METRES, POSE_DEGREES = 0.01, 0.5
POSE_SMOOTH = 2.0  # views over which half of the error's variance is drift
EXPOSURE = 0.03  # standard deviation of the logarithm of exposure, over context views
GLOSSY = 0.15  # of the boxes; round things are glossy all
MILLIMETRES = 1e-3


def write_noisy_room(
    folder: Path, *, seed: int = 0, views: int = 20, width: int = 480, height: int = 360
) -> WrittenSample:
    """Write the recording of a seed's room; a folder that holds it already is left as it is.

    The layout is that of 7-Scenes (``NAME.color.png``, ``NAME.depth.png`` in millimetres,
    ``NAME.pose.txt`` camera-to-world, ``camera-intrinsics.txt``), depth as seen by the colour
    camera. The pictures are taken from the cameras of ``write_room`` with the same options. Context
    poses in the files are jittered, then moved together to where they agree with the true ones
    best: no method could know an error that all of them share. Target poses are the true ones, and
    targets' pictures and depth maps are exact, so that what a run predicts is measured against the
    truth. A run that moves the whole room with its context poses pays for it in the targets. There
    are at least 4 views of both together.
    """
    check_options(seed, views, width=width, height=height)
    folder = Path(folder)
    room, cameras, _ = room_views(seed, views, width=width, height=height)
    count = sum(name.startswith("context") for name in cameras.names)
    stems = [name.removesuffix(".png") for name in cameras.names]
    names = tuple(f"{stem}.color.png" for stem in stems)
    sample = WrittenSample(folder, names[:count], names[count:], names[count:], seed)
    record = sample.record("noisy-room", version=2, width=width, height=height)
    if is_written(folder, record):
        return sample
    rng = np.random.default_rng([seed, 22])
    light, depth = radiance(room.geometry, room.look, cameras)
    exposure = np.ones(len(cameras))
    exposure[:count] = np.exp(rng.normal(0, EXPOSURE, count))
    poses = cameras.world_from_cam
    true = cameras.cam_from_world[:count]
    off = jitter_poses(true, rng)
    poses[:count] = invert_rigid(off @ align_poses(off, true))
    depth[:count] = _measured(room, cameras[:count], depth[:count], rng)
    key = room.key / float(light.mean())
    K = cameras.K[0].copy()
    K[:2, 2] -= 0.5  # the layout counts from the first pixel's centre
    with written_whole(folder, record) as partial:
        np.savetxt(partial / INTRINSICS, K, fmt="%.9g")
        for i, stem in enumerate(stems):
            save_png(partial / f"{stem}.color.png", to_srgb(light[i], key * exposure[i]))
            millimetres = np.rint(depth[i] / MILLIMETRES).astype(np.uint16)
            save_png(partial / f"{stem}.depth.png", millimetres)
            np.savetxt(partial / f"{stem}.pose.txt", poses[i], fmt="%.12g")
    return sample


def jitter_poses(cam_from_world: Float64, rng: np.random.Generator) -> Float64:
    """(V, 4, 4) poses with the errors of a tracker: half of the variance drifts, half jumps.

    ``cam_from_world``: (V, 4, 4) rigid, metres, in the order of recording.
    """
    count = len(cam_from_world)
    margin = round(4 * POSE_SMOOTH)
    weights = gaussian_filter1d(np.eye(1, 129, 64)[0], POSE_SMOOTH)
    drift = gaussian_filter1d(rng.standard_normal((count + 2 * margin, 6)), POSE_SMOOTH, axis=0)
    drift = drift[margin : margin + count] / np.sqrt((weights**2).sum())
    error = (drift + rng.standard_normal((count, 6))) / np.sqrt(2)
    error /= np.sqrt(3)  # of three components each, so that lengths have the stated mean square
    turns = Rotation.from_rotvec(np.radians(POSE_DEGREES) * error[:, 3:]).as_matrix()
    return np.asarray(rigid_poses(turns, POSE_METRES * error[:, :3]) @ cam_from_world)


def _measured(
    room: ProceduralScene, cameras: Cameras, depth: Float32, rng: np.random.Generator
) -> Float32:
    """(V, H, W) z-depth that the sensor reports."""
    glossy = (room.geometry.kind != BOX) | (rng.random(len(room.geometry.kind)) < GLOSSY)
    solid = cast(room.geometry, cameras).solid
    albedo, _ = radiance(room.geometry, _evenly_lit(room.look), cameras)
    found = [
        measured_depth(
            SensorView(
                depth[i],
                np.minimum(albedo[i].mean(-1), 1),
                np.append(glossy, False)[solid[i]],  # the last stands for walls, number -1
                cameras.rays(i),
            ),
            rng,
        )
        for i in range(len(cameras))
    ]
    return np.stack(found)


def _evenly_lit(look: Look) -> Look:
    """The look under white light from everywhere, in which a surface shows its albedo."""
    return look._replace(
        emission=np.zeros_like(look.emission),
        ambient=np.ones((2, 3)),
        sun=np.stack([look.sun[0], np.zeros(3)]),
        lamps=np.zeros((0, 2, 3)),
    )
