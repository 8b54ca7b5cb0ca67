"""The web page's frame: near its origin, and in units in which every scene is of one size.

The page has fixed units of its own: what lies nearer than 0.01 or farther than 1000 is cut off,
keys move two units a second, depth behind the scene ends at 167. A scene in millimetres, or of an
arbitrary scale as COLMAP's are, would not fit them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.memory.store.local_frame import LocalFrame
from viz.run_view.from_outside import position_outside

if TYPE_CHECKING:
    import viser

    from viz.run_view.view import RunView

# What the typical depth of a run is on the page, in its units: as that of a room in metres.
TYPICAL = 3.0

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PageFrame:
    """page = scale (world - origin); axes are the world's.

    Attributes:
        origin: (3,) float64, world frame.
        scale: the page's units in a scene unit.
        memory: the frame of the memory's points.
    """

    origin: Float64
    scale: float
    memory: LocalFrame

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

    def client_camera(self, client: viser.ClientHandle, *, longest: int) -> Cameras:
        """A client's camera in the world's frame: a batch of one of at most ``longest`` pixels."""
        from viser.transforms import SO3

        seen = client.camera
        factor = min(1.0, longest / max(seen.image_width, seen.image_height, 1))
        width = max(1, round(seen.image_width * factor))
        height = max(1, round(seen.image_height * factor))
        focal = height / (2 * np.tan(seen.fov / 2))
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        rotation = SO3(np.array(seen.wxyz)).as_matrix().T
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ (np.array(seen.position) / self.scale + self.origin)
        return Cameras(K[None], pose[None], np.array([width]), np.array([height]), ("viewer",))


def home(run: RunView, frame: PageFrame) -> tuple[Float64, Float64]:
    """Where the page begins to look from and at, (3,) each in its frame.

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
