"""How a reference pixel at an inverse depth moves into the source views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Warps:
    """Warps from one reference view into S source views.

    The reference pixel p = (u, v, 1) at inverse depth w lies at ``matrix @ p + w * offset`` in a
    source (homogeneous pixels; the first pixel's centre is (0.5, 0.5)). On a plane of space w is
    affine in u and v, so this is the plane's homography.

    Attributes:
        matrix: (S, 3, 3) float64, K_s R K_r⁻¹.
        offset: (S, 3) float64, K_s t, pixels x scene units.
    """

    matrix: Float64
    offset: Float64

    def project(self, xy: Float64, inverse_depth: Float64) -> tuple[Float64, Float64]:
        """Where reference pixels lie in the sources.

        Args:
            xy: (N, 2) pixels.
            inverse_depth: (N,), 1 / scene units.

        Returns:
            (S, N, 2) pixels, and (S, N) the source's depth over the reference's (<= 0: behind).
        """
        xy = np.asarray(xy, np.float64)
        homogeneous = np.concatenate([xy, np.ones_like(xy[:, :1])], axis=1)
        moved = np.einsum("sij,nj->sni", self.matrix, homogeneous)
        moved += np.asarray(inverse_depth)[None, :, None] * self.offset[:, None]
        z = moved[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return moved[..., :2] / z[..., None], z


def relative_warps(reference: Cameras, sources: Cameras) -> Warps:
    """The warps from ``reference`` (a batch of one) into ``sources``."""
    relative = sources.cam_from_world @ reference.world_from_cam[0]
    matrix = sources.K @ relative[:, :3, :3] @ np.linalg.inv(reference.K[0])
    offset = np.einsum("sij,sj->si", sources.K, relative[:, :3, 3])
    return Warps(matrix, offset)


def pixel_grid(camera: Cameras, across: int) -> Float64:
    """(N, 2) pixels spread evenly over the camera's image, ``across`` columns."""
    width, height = float(camera.width[0]), float(camera.height[0])
    down = max(2, round(across * height / width))
    x = (np.arange(across) + 0.5) * width / across
    y = (np.arange(down) + 0.5) * height / down
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def disparity_rate(
    reference: Cameras, sources: Cameras, near: float, *, far: float
) -> NDArray[np.float64]:
    """How far a pixel moves in each source from ``far`` to ``near``, over the inverse depths' gap.

    Args:
        reference: a batch of one.
        sources: S cameras.
        near: depth, scene units.
        far: depth, scene units, may be infinite.

    Returns:
        (S,) float64, pixels x scene units: the median over the pixels that both depths keep in
        the source; 0 where there are too few.
    """
    warps = relative_warps(reference, sources)
    xy = pixel_grid(reference, 12)
    ends = [warps.project(xy, np.full(len(xy), 1 / depth)) for depth in (near, far)]
    size = np.stack([sources.width, sources.height], axis=-1)[:, None]
    with np.errstate(invalid="ignore"):
        inside = [((p > 0) & (p < size)).all(-1) & (z > 0) for p, z in ends]
        moved = np.linalg.norm(ends[0][0] - ends[1][0], axis=-1) / (1 / near - 1 / far)
    rate = np.zeros(len(sources))
    for i in range(len(sources)):
        # Where the near end leaves the picture, the far end alone still tells the rate's order.
        for kept in (inside[0] & inside[1], inside[1], np.isfinite(moved[i])):
            chosen = kept[i] if kept.ndim == 2 else kept
            if chosen.sum() >= 4:
                rate[i] = np.median(moved[i][chosen & np.isfinite(moved[i])])
                break
    return rate
