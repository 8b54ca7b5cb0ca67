"""What a model is given: observed views, lifted to the project's memory, splatted to the targets.

It is what inference does, by the same code: back-projection, fusion, projection, reduction to the
model's size. A memory of four views at 96 x 96 costs milliseconds, so nothing faster stands in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.completers.base import ContextView
from gvtools.errors import ShapeError
from gvtools.guidance import Guidance
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.training.corruption import (
    CorruptionOptions,
    corrupted_camera,
    corrupted_color,
    corrupted_depth,
)

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Clip:
    """Ordered views of one size with pictures and depth.

    Attributes:
        rgb: (V, H, W, 3) uint8.
        depth: (V, H, W) float32 z-depth, scene units, 0 = none.
        cameras: V of them.
    """

    rgb: NDArray[np.uint8]
    depth: Float32
    cameras: Cameras

    def __post_init__(self) -> None:
        if self.rgb.shape != (*self.depth.shape, 3) or len(self.cameras) != len(self.rgb):
            raise ShapeError(
                f"clip: rgb {self.rgb.shape}, depth {self.depth.shape}, {len(self.cameras)} "
                "cameras; expected (V, H, W, 3), (V, H, W) and V"
            )

    def __len__(self) -> int:
        return len(self.rgb)


@dataclass(frozen=True, eq=False)
class Observation:
    """Context views as a user has them, and where they are believed to stand.

    Attributes:
        views: pictures and depth in the true cameras, which the model is told.
        lifted: the cameras that their depth is lifted by.
    """

    views: tuple[ContextView, ...]
    lifted: tuple[Cameras, ...]

    def with_more(self, other: Observation) -> Observation:
        """These views and others."""
        return Observation(self.views + other.views, self.lifted + other.lifted)


def observed(
    clip: Clip, context: Sequence[int], strength: CorruptionOptions, *, rng: np.random.Generator
) -> Observation:
    """Context views of a clip with their faults.

    Args:
        clip: true views.
        context: which of them are given.
        strength: of this sample's faults, see ``corruption.drawn``.
        rng: draws the faults.
    """
    known = clip.depth[list(context)]
    unit = float(known[known > 0].mean()) if (known > 0).any() else 1.0
    views, lifted = [], []
    for number, index in enumerate(context):
        camera = clip.cameras[index]
        rgb = clip.rgb[index]
        depth = corrupted_depth(rng, clip.depth[index], strength)
        own = strength if number else strength.replaced(exposure=0.0, color=0.0, dropped=0.0)
        rgb = corrupted_color(rng, rgb, own)
        dropped = rng.random() < own.dropped
        lifted.append(corrupted_camera(rng, camera, unit, strength=strength))
        picture = (rgb / np.float32(255)).astype(np.float32)
        views.append(ContextView(camera.names[0], camera, picture, None if dropped else depth))
    return Observation(tuple(views), tuple(lifted))


def projected(observation: Observation, targets: Cameras) -> Guidance:
    """The memory of some observed views, with a run's defaults, projected into target cameras.

    Args:
        observation: views without depth are left out of the memory.
        targets: cameras of one size.
    """
    lifted = [
        (np.rint(view.rgb * 255).astype(np.uint8), view.depth, camera)
        for view, camera in zip(observation.views, observation.lifted, strict=True)
        if view.depth is not None and (view.depth > 0).any()
    ]
    footprints = [
        np.median(depth[depth > 0]) / np.sqrt(camera.K[0, 0, 0] * camera.K[0, 1, 1])
        for _, depth, camera in lifted
    ]
    voxel = float(np.median(footprints)) if lifted else 1.0
    memory = SpatialMemory(voxel, origin=targets.centers[0])
    for rgb, depth, camera in lifted:
        memory.observe(rgb, depth, camera, round=0)
    return memory.project(targets)
