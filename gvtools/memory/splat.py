"""Projection of the memory into target cameras by z-buffer splatting, without ray casting.

Views near the target know best how it looks from there, so observations are splatted in tiers,
nearest views first, and a later tier writes only pixels that are still open; runs whose rectangle
holds no open pixel are not touched at all. Last, what later tiers know to stand clearly in front is
let through, unless a view already used saw that space to be free.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ShapeError
from gvtools.guidance import Guidance
from gvtools.memory import splat_kernels
from gvtools.memory.occlusion import in_free_space

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory

# Points nearer than this share of the typical depth are behind or inside the camera.
NEAREST = 1e-4
# An occluder must hold a square of this many pixels.
OCCLUDER_SIDE = 5


@dataclass(frozen=True, kw_only=True)
class SplatOptions:
    """How the memory is projected.

    Attributes:
        nearest_views: views in the first tier; each later tier takes twice as many.
        proximity: weight of a view is exp(-proximity x (d - d_nearest)), see view_distance.
        band: relative depth band inside which observations blend.
        depth_reach: half width of the depth pass's footprint, in spacings.
        blend_reach: radius of the blending kernel, in spacings.
        support: kernel sum that makes a pixel valid.
        size_cap: widest footprint, pixels; what a memory this coarse leaves open is a hole.
        occluders: look for things in front that the first tiers did not see.
    """

    nearest_views: int = 2
    proximity: float = 4.0
    band: float = 0.05
    depth_reach: float = 0.5
    blend_reach: float = 1.5
    support: float = 0.5
    size_cap: float = 16.0
    occluders: bool = True


def view_distance(memory: SpatialMemory, camera: Cameras, scale: float) -> NDArray[np.float64]:
    """How differently each of the memory's views looks from a camera, without unit.

    The angle between the optical axes over 15 degrees, plus the distance of the centres over
    0.15 x ``scale`` (a typical depth, scene units): about 8 degrees of parallax.
    """
    cosine = memory.views.cam_from_local[:, 2, :3] @ camera.cam_from_world[0, 2, :3]
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    distance = np.linalg.norm(memory.views.centers + memory.origin - camera.centers[0], axis=1)
    return angle / 15 + distance / (0.15 * scale)


def project(
    memory: SpatialMemory, cameras: Cameras, *, options: SplatOptions | None = None
) -> Guidance:
    """Project the memory into cameras of one image size.

    Raises:
        ShapeError: the cameras have images of several sizes, or there is none.
    """
    sizes = set(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))
    if len(sizes) != 1:
        raise ShapeError(
            f"projection into cameras of {len(sizes)} image sizes; expected one; "
            "project each size by itself"
        )
    parts = [_Projection(memory, camera, options or SplatOptions()).run() for camera in cameras]
    return Guidance(
        cameras,
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("rgb", "depth", "valid", "confidence", "generated")
        ),
    )


class _Projection:
    """One target camera: the images being written and the steps that write them."""

    def __init__(self, memory: SpatialMemory, camera: Cameras, options: SplatOptions) -> None:
        self.memory, self.camera, self.options = memory, camera, options
        height, width = int(camera.height[0]), int(camera.width[0])
        self.shape = (height, width)
        self.rgb = np.zeros((height, width, 3), np.float32)
        self.depth = np.zeros(self.shape, np.float32)
        self.valid = np.zeros(self.shape, np.bool_)
        self.confidence = np.zeros(self.shape, np.float32)
        self.generated = np.zeros(self.shape, np.bool_)
        self.cam_from_local = camera.cam_from_world[0].copy()
        self.cam_from_local[:3, 3] += self.cam_from_local[:3, :3] @ memory.origin

    def run(self) -> Guidance:
        if self._cull():
            self._splat_tiers()
            if self.options.occluders:
                self._splat_occluders()
        images = (self.rgb, self.depth, self.valid, self.confidence, self.generated)
        return Guidance(self.camera, *(image[None] for image in images))

    def _cull(self) -> bool:
        """Find the runs in view and rank the views that they come from."""
        memory, runs = self.memory, self.memory.runs
        self.rect = np.empty((runs.count, 4), np.int32)
        self.z_range = np.empty((runs.count, 2), np.float32)
        splat_kernels.cull_runs(
            runs.box[: runs.count], self.cam_from_local, self.camera.K[0],
            self.shape[1], self.shape[0], self.options.blend_reach, self.rect, self.z_range,
        )  # fmt: skip
        self.seen = np.flatnonzero(self.rect[:, 1] >= 0)
        if not len(self.seen):
            return False
        scale = float(np.median(self.z_range[self.seen, 1]))
        self.near = np.float32(NEAREST * scale)
        self.distance = view_distance(memory, self.camera, scale)
        present = np.bincount(
            runs.view[self.seen], runs.length[self.seen], minlength=len(memory.views)
        )
        # Observed views come before generated ones, however near those are.
        order = np.lexsort((self.distance, memory.views.generated))
        self.ranked = order[present[order] > 0]
        self.weight = np.zeros(len(memory.views), np.float32)
        self.tier = np.full(len(memory.views), -1)
        self.zbuffer = np.empty(self.shape, np.float32)
        self.total = np.empty((*self.shape, splat_kernels.CHANNELS), np.float32)
        return True

    def _splat_tiers(self) -> None:
        """Nearest views first; each later tier writes what is still open."""
        at, size = 0, self.options.nearest_views
        views = self.memory.runs.view
        while at < len(self.ranked):
            members = self.ranked[at : at + size]
            self.tier[members] = at
            nearest = self.distance[members].min()
            self.weight[members] = np.exp(
                -self.options.proximity * (self.distance[members] - nearest)
            )
            open_ = ~self.valid
            chosen = self.seen[self.tier[views[self.seen]] == at]
            table = None
            if at:
                table = splat_kernels.summed_area(open_)
                if not table[-1, -1]:
                    return
                chosen = splat_kernels.touching(self.rect, table, chosen)
            limit = np.where(open_, np.float32(np.inf), np.float32(0))
            self._splat(chosen, limit, open_, table)
            at += size
            size *= 2

    def _splat_occluders(self) -> None:
        """Let through what unused observations know to stand clearly in front.

        A view of the first tier may have looked past an object that only others saw. Where a
        first-tier view saw the object's place to be free, the object is noise or has moved.
        """
        views = self.memory.runs.view
        first = self.ranked[: self.options.nearest_views]
        later = self.seen[self.tier[views[self.seen]] != 0]
        runs, records = self.memory.runs, self.memory.records
        chosen = splat_kernels.in_front(
            later, runs.start, runs.length, self.rect, self.z_range,
            records.x, records.y, records.z, self.cam_from_local, self.camera.K[0],
            self.depth, _tile_farthest(self.depth), 2 * self.options.band,
        )  # fmt: skip
        if not len(chosen):
            return
        limit = self.depth * np.float32(1 - 2 * self.options.band)
        self._splat(chosen, limit, None)
        rows, cols = np.nonzero(np.isfinite(self.zbuffer))
        if not len(rows):
            return
        z = self.zbuffer[rows, cols].astype(np.float64)
        K = self.camera.K[0]
        y = (rows + 0.5 - K[1, 2]) / K[1, 1]
        x = (cols + 0.5 - K[0, 2] - K[0, 1] * y) / K[0, 0]
        local = np.stack([x * z, y * z, z], axis=1) - self.cam_from_local[:3, 3]
        local = (local @ self.cam_from_local[:3, :3]).astype(np.float32)
        memory = self.memory
        grids = memory.observed_grids(first)
        free = in_free_space(local, grids, tolerance=memory.options.free_space_tolerance)
        front = np.zeros(self.shape, np.bool_)
        front[rows[~free], cols[~free]] = True
        # Slivers along silhouettes are what an error of a pixel in a pose looks like.
        front = splat_kernels.opened(front, OCCLUDER_SIDE)
        table = splat_kernels.summed_area(front)
        if table[-1, -1]:
            chosen = splat_kernels.touching(self.rect, table, chosen)
            nearest = self.distance[self.ranked].min()
            self.weight = np.exp(-self.options.proximity * (self.distance - nearest)).astype(
                np.float32
            )
            self._splat(chosen, np.where(front, limit, np.float32(0)), front, table)

    def _splat(
        self,
        chosen: NDArray[np.int64],
        limit: NDArray[np.float32],
        open_: NDArray[np.bool_] | None,
        table: NDArray[np.int32] | None = None,
    ) -> None:
        """Splat runs; ``open_`` None stops after the depth pass.

        ``table`` is the summed-area table of ``open_`` where that is a small part of the image.
        """
        memory, options = self.memory, self.options
        records, runs = memory.records, memory.runs
        reachable = np.empty(0, np.bool_) if table is None else splat_kernels.near_to(table)
        splat_kernels.splat_runs(
            chosen, runs.start, runs.length, runs.view, self.rect,
            records.x, records.y, records.z, records.color, records.confidence,
            records.agreement, records.spacing, self.weight, memory.views.generated,
            self.cam_from_local.astype(np.float32), self.camera.K[0], self.near, limit.reshape(-1), reachable,
            np.float32(options.band), np.float32(options.depth_reach),
            np.float32(options.blend_reach), np.float32(options.size_cap),
            np.float32(memory.options.weight_cap), numba.get_num_threads(), open_ is not None,
            self.shape[1], self.shape[0], self.zbuffer.reshape(-1),
            self.total.reshape(-1, splat_kernels.CHANNELS),
        )  # fmt: skip
        if open_ is not None:
            splat_kernels.resolve(
                self.total, open_, np.float32(options.support),
                self.rgb, self.depth, self.valid, self.confidence, self.generated,
            )  # fmt: skip


def _tile_farthest(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The farthest depth in each tile of ``splat_kernels.TILE`` pixels."""
    tile = splat_kernels.TILE
    height, width = depth.shape
    padded = np.pad(depth, ((0, -height % tile), (0, -width % tile)))
    return padded.reshape(padded.shape[0] // tile, tile, -1, tile).max(axis=(1, 3))
