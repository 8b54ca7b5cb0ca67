"""Splatting: its options, the images that are being written, and what a back end has to do.

Which points go into which pixels is decided in ``projection``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.options import check_range

BACKENDS = ("cpu", "torch", "nearest", "open3d")
# Back ends without blending.
ONE_PIXEL = ("nearest", "open3d")
DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True, kw_only=True)
class SplatOptions:
    """How the memory is projected.

    Attributes:
        nearest_views: views in the first tier; each later tier takes twice as many.
        proximity: weight of a view is exp(-proximity x (d - d_nearest)), see
            ``projection.view_distance``; confidence x weight counts, and is reported, as no less
            than 1e-36.
        band: relative depth band inside which observations blend.
        depth_reach: half width of the depth pass's footprint, in spacings.
        blend_reach: radius of the blending kernel, in spacings.
        support: kernel sum that makes a pixel valid.
        size_cap: widest footprint, pixels; what a memory this coarse leaves open is a hole.
        occluders: look for things in front that the first tiers did not see.
        backend: "cpu" (compiled), "torch" (the same on ``device``), or without blending, one pixel
            a point: "nearest" (our own) and "open3d" (``project_to_rgbd_image``).
        device: where "torch" computes: "cpu", "cuda", or "auto" for CUDA where there is one.
    """

    nearest_views: int = 2
    proximity: float = 4.0
    band: float = 0.05
    depth_reach: float = 0.5
    blend_reach: float = 1.4
    support: float = 0.5
    size_cap: float = 32.0
    occluders: bool = True
    backend: str = "cpu"
    device: str = "auto"

    def __post_init__(self) -> None:
        check_range("splat.nearest_views", self.nearest_views, least=1)
        check_range("splat.proximity", self.proximity, least=0)
        for key in ("band", "depth_reach", "blend_reach", "support", "size_cap"):
            check_range(f"splat.{key}", getattr(self, key), above=0)
        for name, value, known in (
            ("backend", self.backend, BACKENDS),
            ("device", self.device, DEVICES),
        ):
            if value not in known:
                raise OptionError(f"splat {name} {value!r}; expected one of {', '.join(known)}")


@dataclass(eq=False)
class Target:
    """One target camera and the images being written.

    Attributes:
        camera: a batch of one.
        cam_from_local: (4, 4) float64, from the memory's frame.
        rect: (R, 4) int32, image rectangle of each run, see culling.cull_runs.
        near: what is nearer is behind or inside the camera, scene units.
        unit: a power of two near the typical depth, scene units, that depths are summed in.
        rgb: (H, W, 3) float32 in [0, 1].
        depth: (H, W) float32, scene units.
        valid: (H, W) bool.
        confidence: (H, W) float32.
        generated: (H, W) bool.
    """

    camera: Cameras
    cam_from_local: NDArray[np.float64]
    rect: NDArray[np.int32]
    near: np.float32
    unit: np.float32
    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]
    valid: NDArray[np.bool_]
    confidence: NDArray[np.float32]
    generated: NDArray[np.bool_]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return int(self.camera.height[0]), int(self.camera.width[0])


class Splatter(Protocol):
    """A back end: splats runs of one memory, with one set of options, into targets."""

    def splat(
        self,
        target: Target,
        chosen: NDArray[np.int64],
        limit: NDArray[np.float32],
        *,
        weight: NDArray[np.float32],
        table: NDArray[np.int32] | None,
        blend: bool,
    ) -> NDArray[np.float32]:
        """Splat the runs ``chosen`` and keep the sums until ``resolve``.

        Args:
            target: the camera.
            chosen: (n,) rows of the memory's runs.
            limit: (H, W), only what is nearer is written; 0 shuts a pixel.
            weight: (views,) proximity.
            table: summed-area table of the pixels to be written, where these are few.
            blend: False stops after the depth pass.

        Returns:
            (H, W) float32 nearest depth, ``limit`` where nothing is nearer.
        """

    def resolve(self, target: Target, open_: NDArray[np.bool_], *, generated: bool) -> None:
        """Write the last splat's pixels where ``open_`` and the support suffices.

        The confidence is the mean of the observations' confidence x proximity; ``generated`` says
        what kind the splatted observations are.
        """
