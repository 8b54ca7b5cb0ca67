"""Splatting: its options, the images that are being written, and what a back end has to do.

Which points go into which pixels is decided in ``projection``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gvtools.cameras import Cameras
from gvtools.settings import Settings

# Back ends without blending.
ONE_PIXEL = ("nearest", "open3d")


class SplatOptions(Settings):
    """How the memory is projected."""

    section = "splat"

    nearest_views: int = Field(2, ge=1)
    """Views in the first tier; each later tier takes twice as many."""
    view_weight: float = Field(4.0, ge=0)
    """Weight of a view is exp(-view_weight x (d - d_nearest)), see ``projection.view_distance``;
    confidence x weight counts, and is reported, as no less than 1e-36."""
    depth_band: float = Field(0.05, gt=0)
    """Relative depth band inside which observations blend."""
    depth_reach: float = Field(0.5, gt=0)
    """Half width of the depth pass's footprint, in spacings."""
    blend_reach: float = Field(1.4, gt=0)
    """Radius of the blending kernel, in spacings."""
    support: float = Field(0.5, gt=0)
    """Kernel sum that makes a pixel valid."""
    max_splat_px: float = Field(32.0, gt=0)
    """Widest footprint, pixels; what a memory this coarse leaves open is a hole."""
    far_detail_px: float = Field(0.0, ge=0)
    """Where a memory is in tiles on disk and its voxels are finer than the picture, thinned copies
    are drawn, whose cubes are at most so many pixels wide; 0 draws every observation, as in RAM.
    [px]"""
    occluders: bool = True
    """Look for things in front that the first tiers did not see."""
    backend: Literal["cpu", "torch", "nearest", "open3d"] = "cpu"
    """The kernels: "cpu" (compiled), "torch" (the same on ``device``), or without blending, one
    pixel a point: "nearest" (our own) and "open3d" (``project_to_rgbd_image``)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where "torch" computes: "cpu", "cuda", or "auto" for CUDA where there is one."""


@dataclass(eq=False)
class FrameBuffers:
    """One target camera and the images being written.

    Attributes:
        camera: a batch of one.
        cam_from_local: (4, 4) float64, from the memory's frame.
        rect: (R, 4) int32, image rectangle of each segment, see culling.cull_segments.
        z_near: what is nearer is behind or inside the camera, scene units.
        unit: a power of two near the typical depth, scene units, that depths are summed in.
        rgb: (H, W, 3) float32 in [0, 1].
        depth: (H, W) float32, scene units.
        valid: (H, W) bool.
        confidence: (H, W) float32.
        generated: (H, W) bool.
        scanned: (H, W) bool.
    """

    camera: Cameras
    cam_from_local: NDArray[np.float64]
    rect: NDArray[np.int32]
    z_near: np.float32
    unit: np.float32
    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]
    valid: NDArray[np.bool_]
    confidence: NDArray[np.float32]
    generated: NDArray[np.bool_]
    scanned: NDArray[np.bool_]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return int(self.camera.height[0]), int(self.camera.width[0])


class Splatter(Protocol):
    """A back end: splats segments of one memory, with one set of options, into targets."""

    def splat(
        self,
        target: FrameBuffers,
        chosen: NDArray[np.int64],
        limit: NDArray[np.float32],
        *,
        weight: NDArray[np.float32],
        writable: NDArray[np.bool_] | None,
        blend: bool,
    ) -> NDArray[np.float32]:
        """Splat the segments ``chosen`` and keep the sums until ``resolve``.

        Args:
            target: the camera.
            chosen: (n,) rows of the memory's segments.
            limit: (H, W), only what is nearer is written; 0 shuts a pixel.
            weight: (views,) view weight.
            writable: (H, W), the pixels to be written, where these are few; None for most.
            blend: False stops after the depth pass.

        Returns:
            (H, W) float32 nearest depth, ``limit`` where nothing is nearer.
        """

    def resolve(self, target: FrameBuffers, open_: NDArray[np.bool_], *, generated: bool) -> None:
        """Write the last splat's pixels where ``open_`` and the support suffices.

        The confidence is the mean of the observations' confidence x view weight; ``generated`` says
        what kind the splatted observations are.
        """
