"""Splatting: its options, requests, image buffers and back ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gvtools.cameras import Cameras
from gvtools.memory.store.tile import DOUBLINGS
from gvtools.settings import Settings

if TYPE_CHECKING:
    from gvtools.memory.store.store import Store

# Back ends without blending.
ONE_PIXEL = ("nearest", "open3d")


class SplatOptions(Settings):
    """How the memory is projected."""

    section = "splat"

    nearest_views: int | None = Field(2, ge=1)
    """Views in the first tier; each later tier takes twice as many. None takes all as one: which
    views are nearest then plays no part."""
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
    """One target camera and the images being written."""

    # A batch of one, and its (4, 4) pose from the memory's frame.
    camera: Cameras
    cam_from_local: NDArray[np.float64]
    # (R, 4) image rectangle of each segment, see culling.cull_segments.
    rect: NDArray[np.int32]
    # What is nearer is behind or inside the camera, scene units.
    z_near: np.float32
    # A power of two near the typical depth, scene units, that depths are summed in.
    unit: np.float32
    # (H, W, 3) in [0, 1], and (H, W); depth in scene units.
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


@dataclass(frozen=True, eq=False)
class SplatRequest:
    """Segments to be splatted into a target camera, and the pixels that they may write."""

    target: FrameBuffers
    # (n,) rows of the memory's segments.
    chosen: NDArray[np.int64]
    # (H, W): only what is nearer is written; 0 shuts a pixel.
    limit: NDArray[np.float32]
    # (views,) view weights.
    weight: NDArray[np.float32]
    # (H, W) the pixels to be written, where these are few; None for most.
    writable: NDArray[np.bool_] | None = None
    # False stops after the depth pass.
    blend: bool = True


class Splatter(Protocol):
    """A back end: splats segments of one memory, with one set of options, into targets."""

    def splat(self, request: SplatRequest) -> NDArray[np.float32]:
        """Splat segments and keep the sums until ``resolve``.

        Returns:
            (H, W) nearest depth, ``limit`` where nothing is nearer.
        """

    def resolve(self, target: FrameBuffers, open_: NDArray[np.bool_], *, generated: bool) -> None:
        """Write the last splat's pixels where ``open_`` and the support suffices.

        The confidence is the mean of the observations' confidence x view weight; ``generated`` says
        what kind the splatted observations are.
        """


def thinning(
    store: Store, target: FrameBuffers, chosen: NDArray[np.int64], *, px: float
) -> NDArray[np.uint8] | None:
    """(n,) thinned copies of segments whose cubes are at most ``px`` pixels wide; None in RAM."""
    if store.in_ram or not px:
        return None
    box, M = store.segments.box[chosen].astype(np.float64), target.cam_from_local
    K = target.camera.K[0]
    nearest = np.full(len(chosen), M[2, 3])
    for k in range(3):
        nearest += np.minimum(M[2, k] * box[:, k], M[2, k] * box[:, 3 + k])
    edge = store.voxel * np.ldexp(1.0, store.tiles.places.level[chosen].astype(np.int32))
    with np.errstate(divide="ignore"):
        wide = np.where(nearest > 0, edge * max(K[0, 0], K[1, 1]) / nearest, np.inf)
    out = np.zeros(len(chosen), np.uint8)
    for doublings in DOUBLINGS:
        out[wide * 2**doublings <= px] = doublings
    return out
