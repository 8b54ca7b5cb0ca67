"""Standpoints: the up direction of points, the first look at a run, and the web page's frame.

The page has fixed units of its own: what lies nearer than 0.01 or farther than 1000 is cut off,
keys move two units a second, depth behind the scene ends at 167. A scene in millimetres, or of an
arbitrary scale as COLMAP's are, would not fit them: the page counts near its origin, in units in
which every scene is of one size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, invert_rigid, rigid_poses
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.trajectories import look_at

if TYPE_CHECKING:
    import viser

    from viz.viewer.run_view import RunView

Float64 = NDArray[np.float64]

# Scenes are wider than high; lower by so much is no accident.
FLATTER = 0.9
# Percent of the points at each end that may lie far off.
STRAY = 0.5
# Points that surfaces are found among, places where they are looked for, and neighbours of a place.
AMONG, PLACES, NEIGHBOURS = 50_000, 4_000, 16
# At a flat place the neighbours' spread across the surface is below this share of that along it.
FLAT = 0.25
# Floors, tables and ceilings are tilted by less in the frames that scenes come in, and agree this
# well, degrees; a smaller share of all flat places is no floor.
TILTED, AGREEING, ENOUGH = 40.0, 6.0, 0.15
# Vertical field of view, radians.
FIELD_OF_VIEW = np.radians(75.0)
# How far above the horizon it looks from, radians, and how much room there is around the cloud.
ABOVE, ROOM = np.radians(30.0), 1.1
# What the typical depth of a run is on the page, in its units: as that of a room in metres.
TYPICAL = 3.0


def guess_up(positions: Float64) -> Float64:
    """(3,) unit vector: what fits some points (P, 3) better, near z or near -y.

    Near each, across the surfaces that are nearly level by it, if there are enough. z if the points
    reach less far that way, else -y, as in the frame of a camera.
    """
    normals = flat_normals(positions)
    z, minus_y = (_levelled(up, normals) for up in np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))
    ends = np.percentile(positions @ np.stack([z, minus_y], axis=1), (STRAY, 100 - STRAY), axis=0)
    high, deep = np.diff(ends, axis=0)[0]
    return z if high < FLATTER * deep else minus_y


def _levelled(up: Float64, normals: Float64) -> Float64:
    """(3,) unit vector across what of the flat places (Q, 3) lies nearly level; else as it was."""
    aligned = np.where(normals @ up < 0, -1.0, 1.0)[:, None] * normals
    level = aligned[aligned @ up > np.cos(np.radians(TILTED))]
    if len(level) < ENOUGH * len(normals) or not len(level):
        return up
    # Those that most others agree with.
    agree = level @ level.T > np.cos(np.radians(AGREEING))
    most = agree[np.argmax(agree.sum(axis=1))]
    if most.sum() < ENOUGH * len(normals):
        return up
    mean = level[most].mean(axis=0)
    across: Float64 = mean / np.linalg.norm(mean)
    return across


def flat_normals(positions: Float64) -> Float64:
    """(Q, 3) unit vectors across the surface at those of some places where it is flat."""
    from scipy.spatial import cKDTree

    among = positions[:: max(1, len(positions) // AMONG)]
    if len(among) < NEIGHBOURS:
        return np.zeros((0, 3))
    places = among[:: max(1, len(among) // PLACES)]
    _, neighbours = cKDTree(among).query(places, k=NEIGHBOURS)
    around = among[neighbours] - among[neighbours].mean(axis=1, keepdims=True)
    # Ascending: the first direction is across the surface.
    spread, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", around, around))
    flat = spread[:, 0] < FLAT**2 * spread[:, 1]
    normals: Float64 = axes[flat, :, 0]
    return normals


def position_outside(run: RunView) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3,) to look from and at, world frame: the cloud is in view, its up is upwards."""
    up = run.up()
    low, high = run.bounds
    middle = (low + high) / 2
    radius = float(np.linalg.norm(high - low)) / 2 or run.typical_depth
    # Level and along the axis in which the cloud reaches least, so that its broad side is in view.
    reach = high - low
    reach[np.argmax(np.abs(up))] = np.inf
    ahead = np.eye(3)[np.argmin(reach)]
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    away = ROOM * radius / np.sin(FIELD_OF_VIEW / 2)
    return middle + away * (np.sin(ABOVE) * up - np.cos(ABOVE) * ahead), middle


def camera_outside(run: RunView, *, width: int = 1280, height: int = 960) -> Cameras:
    """A camera there, a batch of one."""
    position, middle = position_outside(run)
    pose = invert_rigid(look_at(position[None], middle, up=run.up())[0])
    return pinhole(pose, (width, height), FIELD_OF_VIEW, name="outside")


def pinhole(pose: Float64, size: tuple[int, int], field_of_view: float, *, name: str) -> Cameras:
    """A camera (4, 4) cam_from_world of a vertical field of view, radians, a batch of one."""
    focal = size[1] / (2 * np.tan(field_of_view / 2))
    return Cameras.pinhole(*size, focal=focal, cam_from_world=pose, name=name)


@dataclass(frozen=True, eq=False)
class PageFrame:
    """page = scale (world - origin); axes are the world's."""

    origin: Float64  # (3,) world frame
    scale: float  # the page's units in a scene unit
    memory: LocalFrame  # of the memory's points

    @classmethod
    def of(cls, run: RunView) -> PageFrame:
        """The frame for a run; it stays when the run grows."""
        return cls(run.bounds.mean(axis=0), TYPICAL / run.typical_depth, run.memory.frame)

    def points(self, local: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N, 3) float32 in the memory's frame as the page has them."""
        near = local - self.memory.from_world(self.origin).astype(np.float32)
        return near @ (self.scale * self.memory.axes.T).astype(np.float32)

    def position(self, world: Float64) -> Float64:
        """(3,) in the world's frame as the page has it."""
        return self.scale * (world - self.origin)

    def placement(self, camera: Cameras) -> tuple[Float64, Float64]:
        """Rotation (4,) as w, x, y, z and position (3,) on the page of a camera, a batch of one."""
        from viser.transforms import SO3

        pose = camera.world_from_cam[0]
        wxyz = np.asarray(SO3.from_matrix(pose[:3, :3]).wxyz, np.float64)
        return wxyz, self.position(pose[:3, 3])

    def client_camera(self, client: viser.ClientHandle, *, longest: float) -> Cameras:
        """A client's camera in the world's frame: a batch of one of at most ``longest`` pixels."""
        from viser.transforms import SO3

        seen = client.camera
        factor = min(1.0, longest / max(seen.image_width, seen.image_height, 1))
        width = max(1, round(seen.image_width * factor))
        height = max(1, round(seen.image_height * factor))
        rotation = SO3(np.array(seen.wxyz)).as_matrix().T
        place = np.array(seen.position) / self.scale + self.origin
        pose = rigid_poses(rotation, -rotation @ place)
        return pinhole(pose, (width, height), seen.fov, name="viewer")


def home(run: RunView, frame: PageFrame) -> tuple[Float64, Float64]:
    """(3,) that the page begins to look from and at, in its frame.

    Behind the first camera; where there is none, in front of the whole cloud and above it.
    """
    if run.cameras:
        pose = run.cameras[0].camera.world_from_cam[0]
        depth = run.typical_depth
        back = -0.5 * depth * pose[:3, 2] + 0.25 * depth * run.up()
        return (
            frame.position(pose[:3, 3] + back),
            frame.position(pose[:3, 3] + depth * pose[:3, 2]),
        )
    position, middle = position_outside(run)
    return frame.position(position), frame.position(middle)
