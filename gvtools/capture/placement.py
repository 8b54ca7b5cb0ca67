"""Position, orientation and scale of a model in the world, which mapping leaves undetermined.

With GPS the world is metric, with x east, y north and z up. Otherwise z is up as the cameras were
held, see ``level_up``, x and y are arbitrary, and so is the scale unless a distance is given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.scenes.faces import face_name
from gvtools.scenes.scene import Finding
from gvtools.trajectories import level_up

if TYPE_CHECKING:
    import pycolmap

# Error of a phone's or a drone's GPS; positions that spread by less than twice this are not used.
# [metres]
GPS_ERROR = 5.0
# Pictures with GPS that are needed to place a model.
LEAST_PLACED = 3
SEED = 1


@dataclass(frozen=True)
class WorldPlacement:
    """How a model was placed."""

    metric: bool  # whether its units are metres
    by: str  # "GPS", "distance" (scale only) or "cameras" (which way is up only)
    # Latitude, longitude [degrees] and height [m] of its origin; None without GPS.
    origin: tuple[float, float, float] | None = None


def place(
    model: pycolmap.Reconstruction,
    *,
    locations: Mapping[str, tuple[float, float, float]],
    distance: tuple[str, str, float] | None = None,
) -> tuple[WorldPlacement, list[Finding]]:
    """Move, rotate and scale a model in place.

    Locations are latitude and longitude [degrees] and height [m] of pictures by name; the distance
    is that of the places where two pictures were taken, metres.
    """
    from gvtools.colmap import pycolmap

    placed = {name: value for name, value in locations.items() if _found(model, name) is not None}
    placement: WorldPlacement | None = None
    findings: list[Finding] = []
    if len(placed) >= LEAST_PLACED:
        placement, findings = _by_gps(model, placed)
    if placement is None:
        _level(model)
        placement = WorldPlacement(metric=False, by="cameras")
    if distance is not None:
        first, second, metres = distance
        ends = []
        for name in (first, second):
            centre = _found(model, name)
            if centre is None:
                raise OptionError(
                    f"--distance: {name!r} is no registered picture; give two that are"
                )
            ends.append(centre)
        apart = float(np.linalg.norm(ends[0] - ends[1]))
        if apart <= 1e-9:
            raise OptionError(f"--distance: {first!r} and {second!r} were taken at one place")
        identity = pycolmap.Rotation3d(np.array([0.0, 0.0, 0.0, 1.0]))
        model.transform(pycolmap.Sim3d(metres / apart, identity, np.zeros(3)))
        placement = WorldPlacement(True, "distance", placement.origin)
    return placement, findings


def _found(model: pycolmap.Reconstruction, name: str) -> NDArray[np.float64] | None:
    # All faces of a panorama are at its place.
    image = model.find_image_with_name(name) or model.find_image_with_name(face_name(name, "front"))
    return None if image is None or not image.has_pose else np.asarray(image.projection_center())


def _by_gps(
    model: pycolmap.Reconstruction, placed: Mapping[str, tuple[float, float, float]]
) -> tuple[WorldPlacement | None, list[Finding]]:
    from gvtools.colmap import pycolmap

    names, values = list(placed), np.array(list(placed.values()))
    origin = values.mean(axis=0)
    east = pycolmap.GPSTransform().ellipsoid_to_enu(values, *origin)
    east = np.asarray(east) - np.asarray(east).mean(axis=0)
    spread = float(np.linalg.norm(east[:, :2], axis=1).max())
    if spread < 2 * GPS_ERROR:
        text = (
            f"GPS of {len(names)} pictures spreads over {spread:.1f} m alone, about what it errs "
            "by: not used; give --distance for metres"
        )
        return None, [Finding("info", text)]
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = GPS_ERROR, SEED
    fronts = [
        name if model.find_image_with_name(name) is not None else face_name(name, "front")
        for name in names
    ]
    moved = pycolmap.align_reconstruction_to_locations(model, fronts, east, LEAST_PLACED, options)
    if moved is None:
        text = f"GPS of {len(names)} pictures contradicts the cameras that were found: not used"
        return None, [Finding("warning", text)]
    model.transform(moved)
    at = {name: _found(model, name) for name in names}
    errors = [float(np.linalg.norm(at[name] - row)) for name, row in zip(names, east, strict=True)]
    error = float(np.median(errors))
    text = f"placed by GPS of {len(names)} pictures, which it differs from by {error:.2f} m"
    return WorldPlacement(True, "GPS", (float(origin[0]), float(origin[1]), float(origin[2]))), [
        Finding("info", text)
    ]


def _level(model: pycolmap.Reconstruction) -> None:
    """Rotate the vertical, as the cameras were held, to +z, and move their mean centre to 0."""
    from scipy.spatial.transform import Rotation

    from gvtools.colmap import pycolmap

    images = [image for image in model.images.values() if image.has_pose]
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3] = [image.cam_from_world().matrix() for image in images]
    one = np.array(1)
    cameras = Cameras(np.tile(np.eye(3), (len(images), 1, 1)), poses, one, one, ())
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [level_up(cameras)])[0]
    shift = -turn.apply(cameras.centers.mean(axis=0))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(turn.as_quat()), shift))
