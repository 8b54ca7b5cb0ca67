"""The demo's room as somebody records it who walks through it with a cheap RGB-D camera.

Room, cameras and seeds are those of ``room_sample``, so that runs on the two differ by the noise
alone. Context views have measured depth (``depth_sensor``), poses of a tracker that errs, and an
exposure of their own. Target views have none of it: they are held out as the truth.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, invert_rigid
from gvtools.procedural.builder import ProceduralScene
from gvtools.procedural.depth_sensor import Surfaces, measured_depth
from gvtools.procedural.geometry import BOX
from gvtools.procedural.ray_cast import cast
from gvtools.procedural.render import developed, radiance
from gvtools.procedural.room_sample import RoomSample, check_options, room_views
from gvtools.procedural.sample_workspace import is_written, written_whole
from gvtools.procedural.shading import Look
from gvtools.scenes.calibration import INTRINSICS
from gvtools.similarity import align_poses

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Of context poses before alignment, root mean square over views: length of the centre's error,
# angle of the turn.
POSE_METRES, POSE_DEGREES = 0.01, 0.5
POSE_SMOOTH = 2.0  # views over which half of the error's variance is drift
EXPOSURE = 0.03  # standard deviation of the logarithm of exposure, over context views
GLOSSY = 0.15  # of the boxes; round things are glossy all
MILLIMETRES = 1e-3


def write_noisy_room(
    folder: Path,
    *,
    seed: int = 0,
    views: int = 20,
    width: int = 480,
    height: int = 360,
) -> RoomSample:
    """Write the recording of a seed's room; a folder that holds it already is left as it is.

    The layout is that of 7-Scenes (``NAME.color.png``, ``NAME.depth.png`` in millimetres,
    ``NAME.pose.txt`` camera-to-world, ``camera-intrinsics.txt``), depth as seen by the colour
    camera. The pictures are taken from the cameras of ``write_room`` with the same options. Context
    poses in the files are jittered, then moved together to where they agree with the true ones
    best: no method could know an error that all of them share. Target poses are the true ones, and
    targets' pictures and depth maps are exact, so that what a run predicts is measured against the
    truth. A run that moves the whole room with its context poses pays for it in the targets.

    Args:
        folder: absent, empty, or written by the same call before.
        seed: 0 or more.
        views: of context and targets together, at least 4.
        width: of the pictures, pixels.
        height: of the pictures, pixels.
    """
    check_options(seed, views, width=width, height=height)
    folder = Path(folder)
    room, cameras, _ = room_views(seed, views, width=width, height=height)
    count = sum(name.startswith("context") for name in cameras.names)
    stems = [name.removesuffix(".png") for name in cameras.names]
    names = tuple(f"{stem}.color.png" for stem in stems)
    sample = RoomSample(folder, names[:count], names[count:], names[count:], seed)
    record: dict[str, Any] = {"sample": "noisy-room", "version": 2, "width": width}
    record |= {"height": height}
    record |= {key: value for key, value in asdict(sample).items() if key != "folder"}
    if is_written(folder, record):
        return sample
    rng = np.random.default_rng([seed, 22])
    light, depth = radiance(room.geometry, room.look, cameras)
    exposure = np.ones(len(cameras))
    exposure[:count] = np.exp(rng.normal(0, EXPOSURE, count))
    poses = cameras.world_from_cam
    true = cameras.cam_from_world[:count]
    off = jittered(true, rng)
    poses[:count] = invert_rigid(off @ align_poses(off, true))
    depth[:count] = _measured(room, cameras[:count], depth[:count], rng)
    key = room.key / float(light.mean())
    K = cameras.K[0].copy()
    K[:2, 2] -= 0.5  # the layout counts from the first pixel's centre
    with written_whole(folder, record) as partial:
        np.savetxt(partial / INTRINSICS, K, fmt="%.9g")
        for i, stem in enumerate(stems):
            _save(partial / f"{stem}.color.png", developed(light[i], key * exposure[i]))
            millimetres = np.rint(depth[i] / MILLIMETRES).astype(np.uint16)
            _save(partial / f"{stem}.depth.png", millimetres)
            np.savetxt(partial / f"{stem}.pose.txt", poses[i], fmt="%.12g")
    return sample


def jittered(cam_from_world: Float64, rng: np.random.Generator) -> Float64:
    """(V, 4, 4) poses with the errors of a tracker: half of the variance drifts, half jumps.

    Args:
        cam_from_world: (V, 4, 4) rigid, metres, in the order of recording.
        rng: decides everything.
    """
    from scipy.ndimage import gaussian_filter1d
    from scipy.spatial.transform import Rotation

    count = len(cam_from_world)
    margin = round(4 * POSE_SMOOTH)
    weights = gaussian_filter1d(np.eye(1, 129, 64)[0], POSE_SMOOTH)
    drift = gaussian_filter1d(rng.standard_normal((count + 2 * margin, 6)), POSE_SMOOTH, axis=0)
    drift = drift[margin : margin + count] / np.sqrt((weights**2).sum())
    error = (drift + rng.standard_normal((count, 6))) / np.sqrt(2)
    error /= np.sqrt(3)  # of three components each, so that lengths have the stated mean square
    moved = np.tile(np.eye(4), (count, 1, 1))
    moved[:, :3, :3] = Rotation.from_rotvec(np.radians(POSE_DEGREES) * error[:, 3:]).as_matrix()
    moved[:, :3, 3] = POSE_METRES * error[:, :3]
    return np.asarray(moved @ cam_from_world)


def _measured(
    room: ProceduralScene, cameras: Cameras, depth: Float32, rng: np.random.Generator
) -> Float32:
    """(V, H, W) z-depth that the sensor reports."""
    glossy = (room.geometry.kind != BOX) | (rng.random(len(room.geometry.kind)) < GLOSSY)
    solid = cast(room.geometry, cameras).solid
    albedo, _ = radiance(room.geometry, _evenly_lit(room.look), cameras)
    found = [
        measured_depth(
            Surfaces(
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


def _save(path: Path, array: NDArray[Any]) -> None:
    from PIL import Image

    Image.fromarray(array).save(path, compress_level=3)
