"""Projection of the memory into target cameras by z-buffer splatting, without ray casting.

Views near the target know best how it looks from there, so observations are splatted in tiers,
nearest views first, and a later tier writes only pixels that are still open; runs whose rectangle
holds no open pixel are not touched at all. Generated views come in tiers of their own after all
observed ones. Last, what observed views of later tiers know to stand clearly in front is let
through, unless a view of the first tier saw that space to be free.

Which runs go into which pixels is decided here; a back end (``Splatter``) does the splatting.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, check_usable
from gvtools.errors import ShapeError
from gvtools.guidance import Guidance, together
from gvtools.memory import culling
from gvtools.memory.splat import ONE_PIXEL, SplatOptions, Splatter, Target

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory

# Points nearer than this share of the typical depth, and than a voxel, are behind or inside the
# camera.
NEAREST = 1e-4
# An occluder must hold a square of this many pixels.
OCCLUDER_SIDE = 5


def view_distance(memory: SpatialMemory, camera: Cameras, scale: float) -> NDArray[np.float64]:
    """How differently each of the memory's views looks from a camera, without unit.

    The angle between the optical axes over 15 degrees, plus the distance of the centres over
    0.15 x ``scale`` (a typical depth, scene units): about 8 degrees of parallax.
    """
    forward = memory.frame.cam_from_local(camera.cam_from_world)[0, 2, :3]
    cosine = memory.views.cam_from_local[:, 2, :3] @ forward
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    distance = np.linalg.norm(
        memory.views.centers - memory.frame.from_world(camera.centers), axis=1
    )
    return angle / 15 + distance / (0.15 * scale)


def project(
    memory: SpatialMemory, cameras: Cameras, *, options: SplatOptions | None = None
) -> Guidance:
    """Project the memory into cameras of one image size.

    What is nearer to the camera's plane than a voxel and than 1e-4 of the typical depth is not
    drawn.

    Raises:
        ShapeError: the cameras have images of several sizes, or there is none, or one is unusable.
    """
    sizes = set(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))
    if len(sizes) != 1:
        raise ShapeError(
            f"projection into cameras of {len(sizes)} image sizes; expected one; "
            "project each size by itself"
        )
    check_usable(cameras)
    options = options or SplatOptions()
    if options.backend in ONE_PIXEL:
        from gvtools.memory.one_pixel import project_one_pixel

        return project_one_pixel(memory, cameras, open3d=options.backend == "open3d")
    splatter = _splatter(memory, options)
    return together([_Projection(memory, c, options, splatter).run() for c in cameras])


@dataclass(frozen=True, eq=False)
class Observed:
    """What the observed tiers alone wrote of a camera's images; see Target."""

    rgb: NDArray[np.float32]
    depth: NDArray[np.float32]
    valid: NDArray[np.bool_]
    confidence: NDArray[np.float32]


def project_again(
    memory: SpatialMemory, camera: Cameras, observed: Observed | None, *, options: SplatOptions
) -> tuple[Guidance, Observed | None]:
    """``project`` into one camera, and what the observed views show there.

    Args:
        memory: is projected.
        camera: a batch of one.
        observed: from an earlier call; it is taken over. The caller knows that nothing observed
            was fused or forgotten since. None: all is splatted.
        options: of a back end that blends.

    Returns:
        The same guidance, to the bit, as ``project`` gives, and what the observed views show;
        None where they show nothing.
    """
    check_usable(camera)
    projection = _Projection(memory, camera, options, _splatter(memory, options))
    return projection.run(observed, keep=True), projection.observed


def _splatter(memory: SpatialMemory, options: SplatOptions) -> Splatter:
    if options.backend == "torch":
        from gvtools.memory.splat_torch import TorchSplatter

        return TorchSplatter(memory, options)
    from gvtools.memory.splat_cpu import CpuSplatter

    return CpuSplatter(memory, options)


class _Projection:
    """The steps that write one target camera's images."""

    def __init__(
        self, memory: SpatialMemory, camera: Cameras, options: SplatOptions, splatter: Splatter
    ) -> None:
        self.memory, self.camera, self.options = memory, camera, options
        self.splatter = splatter
        shape = (int(camera.height[0]), int(camera.width[0]))
        cam_from_local = memory.frame.cam_from_local(camera.cam_from_world)[0]
        self.target = Target(
            camera,
            cam_from_local,
            np.empty((memory.runs.count, 4), np.int32),
            np.float32(0),
            np.float32(1),
            np.zeros((*shape, 3), np.float32),
            np.zeros(shape, np.float32),
            np.zeros(shape, np.bool_),
            np.zeros(shape, np.float32),
            np.zeros(shape, np.bool_),
        )
        self.observed: Observed | None = None

    def run(self, observed: Observed | None = None, *, keep: bool = False) -> Guidance:
        """The images.

        Args:
            observed: what the observed tiers write, where that is known.
            keep: leave a copy of that in ``observed``.
        """
        t = self.target
        if self._cull():
            tiers, split = self._tiers()
            if observed is None:
                self._splat_tiers(tiers[:split], 0)
            else:
                t.rgb[:], t.depth[:] = observed.rgb, observed.depth
                t.valid[:], t.confidence[:] = observed.valid, observed.confidence
            if keep:
                self.observed = observed or Observed(
                    t.rgb.copy(), t.depth.copy(), t.valid.copy(), t.confidence.copy()
                )
            self._splat_tiers(tiers[split:], split)
            if self.options.occluders:
                self._splat_occluders()
        return Guidance(
            self.camera,
            t.rgb[None],
            t.depth[None],
            t.valid[None],
            t.confidence[None],
            t.generated[None],
        )

    def _cull(self) -> bool:
        """Find the runs in view and rank the views that they come from."""
        memory, runs, target = self.memory, self.memory.runs, self.target
        self.z_range = np.empty((runs.count, 2), np.float32)
        groups = np.arange(runs.groups)
        group_rect = np.empty((runs.groups, 4), np.int32)
        self._cull_boxes(runs.group_box, groups, group_rect, np.empty((runs.groups, 2), np.float32))
        rows = groups[group_rect[:, 1] >= 0, None] * runs.GROUP + np.arange(runs.GROUP)
        rows = rows.ravel()
        rows = rows[rows < runs.count]
        self._cull_boxes(runs.box, rows, target.rect, self.z_range)
        self.seen = rows[target.rect[rows, 1] >= 0]
        if not len(self.seen):
            return False
        # Of what was observed where there is any: it must not hang on what was added to it.
        far = self.z_range[self.seen, 1]
        made = memory.views.generated[runs.view[self.seen]]
        scale = float(np.median(far if made.all() else far[~made]))
        target.near = np.float32(min(NEAREST * scale, memory.voxel))
        target.unit = np.float32(np.ldexp(1.0, int(np.frexp(scale)[1])))
        self.distance = view_distance(memory, self.camera, scale)
        present = np.bincount(
            runs.view[self.seen], runs.length[self.seen], minlength=len(memory.views)
        )
        # Observed views come before generated ones, however near those are.
        order = np.lexsort((self.distance, memory.views.generated))
        self.ranked = order[present[order] > 0]
        self.tier = np.full(len(memory.views), -1)
        return True

    def _cull_boxes(
        self,
        boxes: NDArray[np.float32],
        rows: NDArray[np.int64],
        rect: NDArray[np.int32],
        z_range: NDArray[np.float32],
    ) -> None:
        height, width = self.target.shape
        culling.cull_runs(
            boxes, rows, self.target.cam_from_local, self.camera.K[0], width, height,
            self.options.blend_reach, rect, z_range,
        )  # fmt: skip

    def _tiers(self) -> tuple[list[NDArray[np.int64]], int]:
        """The ranked views cut into tiers that double in size, and how many are of observed views.

        Generated views come in tiers of their own.
        """
        made = self.memory.views.generated[self.ranked]
        tiers: list[NDArray[np.int64]] = []
        size, split = self.options.nearest_views, 0
        for part in (self.ranked[~made], self.ranked[made]):
            split = len(tiers)
            at = 0
            while at < len(part):
                self.tier[part[at : at + size]] = len(tiers)
                tiers.append(part[at : at + size])
                at += size
                size *= 2
        return tiers, split

    def _splat_tiers(self, tiers: list[NDArray[np.int64]], first: int) -> None:
        """Nearest views first; each later tier writes what is still open.

        ``first`` is the number of the first of these tiers.
        """
        target = self.target
        view = self.memory.runs.view[self.seen]
        open_ = np.empty(target.shape, np.bool_)
        limit = np.empty(target.shape, np.float32)
        for number, members in enumerate(tiers, first):
            culling.still_open(target.valid, open_, limit)
            chosen = self.seen[self.tier[view] == number]
            table = None
            if number:
                table = culling.summed_area(open_)
                if not table[-1, -1]:
                    return
                chosen = culling.touching(target.rect, table, chosen)
            self._write(chosen, limit, open_, members=members, table=table)

    def _write(
        self,
        chosen: NDArray[np.int64],
        limit: NDArray[np.float32],
        open_: NDArray[np.bool_],
        *,
        members: NDArray[np.int64],
        table: NDArray[np.int32] | None,
    ) -> None:
        """Splat and write; proximity counts from the nearest of the views ``members``."""
        beyond = np.maximum(self.distance - self.distance[members].min(), 0)
        weight = np.exp(-self.options.proximity * beyond).astype(np.float32)
        self.splatter.splat(self.target, chosen, limit, weight=weight, table=table, blend=True)
        made = bool(self.memory.views.generated[members[0]])
        self.splatter.resolve(self.target, open_, generated=made)

    def _splat_occluders(self) -> None:
        """Let through what unused observations know to stand clearly in front.

        A view of the first tier may have looked past an object that only others saw. Where a
        first-tier view saw the object's place to be free, the object is noise or has moved.
        Generated content is never let through: it must not stand before what was observed.
        """
        memory, target = self.memory, self.target
        runs, records, K = memory.runs, memory.records, self.camera.K[0]
        view = runs.view[self.seen]
        later = self.seen[(self.tier[view] != 0) & ~memory.views.generated[view]]
        if not len(later):
            return
        seen_free = _stacked(memory.observed_grids(np.flatnonzero(self.tier == 0)))
        tolerance = memory.options.free_space_tolerance
        chosen = culling.in_front(
            later, runs.start, runs.length, target.rect, self.z_range,
            records.x, records.y, records.z, target.cam_from_local, K,
            target.depth, culling.tile_farthest(target.depth), 2 * self.options.band,
            *seen_free, tolerance,
        )  # fmt: skip
        if not len(chosen):
            return
        limit = target.depth * np.float32(1 - 2 * self.options.band)
        none = np.zeros(len(memory.views), np.float32)
        zbuffer = self.splatter.splat(target, chosen, limit, weight=none, table=None, blend=False)
        front = culling.not_free(zbuffer, limit, target.cam_from_local, K, *seen_free, tolerance)
        # Slivers along silhouettes are what an error of a pixel in a pose looks like.
        front = culling.opened(front, OCCLUDER_SIDE)
        table = culling.summed_area(front)
        if table[-1, -1]:
            chosen = culling.touching(target.rect, table, chosen)
            limit = np.where(front, limit, np.float32(0))
            observed = self.ranked[~memory.views.generated[self.ranked]]
            self._write(chosen, limit, front, members=observed, table=table)


def _stacked(
    grids: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
    """K (T, 3, 3), cam_from_local (T, 4, 4) and the grids (T, h, w), padded with 0 = unknown."""
    shape = np.max([(1, 1), *(grid.shape for _, _, grid in grids)], axis=0)
    stack = np.zeros((len(grids), *shape), np.float32)
    for row, (_, _, grid) in zip(stack, grids, strict=True):
        row[: grid.shape[0], : grid.shape[1]] = grid
    K = np.array([K for K, _, _ in grids]).reshape(-1, 3, 3)
    return K, np.array([M for _, M, _ in grids]).reshape(-1, 4, 4), stack
