"""Compile the memory's kernels at a time of one's choice."""

from __future__ import annotations

import numpy as np

from gvtools.cameras import Cameras, rigid_poses
from gvtools.kernels import KernelSet
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.splat.cpu import resolve


def compile_kernels(backend: str = "cpu") -> None:
    """Compile, or load from numba's cache, what lifting, fusing and projecting need."""
    memory = SpatialMemory(0.1)
    rgb, depth = np.zeros((16, 16, 3), np.uint8), np.full((16, 16), 2, np.float32)
    trust, mask = np.ones((16, 16), np.float32), np.ones((16, 16), np.bool_)
    options = SplatOptions(nearest_views=1, backend=backend)
    for number, x in enumerate((0.0, 0.5, 1.0)):
        pose = rigid_poses(np.eye(3), (x, 0, 0))
        camera = Cameras.pinhole(16, 16, focal=16.0, cam_from_world=pose, name=f"{number}")
        memory.observe(
            rgb, depth - np.float32(x), camera, round=number, confidence=trust, mask=mask,
            generated=number == 2, pixel_binning=1.0,
        )  # fmt: skip
        memory.project(camera, options=options)


KERNELS = KernelSet("memory", compile_kernels, resolve)
