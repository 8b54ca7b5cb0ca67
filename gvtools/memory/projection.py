"""Projection of the memory into target cameras by z-buffer splatting, without ray casting.

Views near the target know best how it looks from there, so observations are splatted in tiers,
nearest views first, and a later tier writes only pixels that are still open; segments whose
rectangle holds no open pixel are not touched at all. Then what observed views of later tiers know
to stand clearly in front is let through, unless a view of the first tier saw that space to be free.
Stations of scans come after all photographs, in tiers of their own, and generated views come last:
they fill what is open still.

Which segments go into which pixels is decided here; a back end (``Splatter``) does the splatting.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, check_usable
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import IMAGES, Guidance, concatenate
from gvtools.kernels import in_threads
from gvtools.memory import culling
from gvtools.memory.culling import in_free_space, stack_grids
from gvtools.memory.splat.api import ONE_PIXEL, FrameBuffers, SplatOptions, SplatRequest, Splatter
from gvtools.memory.store.store import Store
from gvtools.memory.store.views import FreeGrid

# Points nearer than this share of the typical depth, and than a voxel, are behind or inside the
# camera.
NEAREST = 1e-4
# An occluder must hold a square of this many pixels.
OCCLUDER_SIDE = 5


def view_distance(store: Store, camera: Cameras, scale: float) -> NDArray[np.float64]:
    """How differently each of the memory's views looks from a camera, without unit.

    The angle between the optical axes over 15 degrees, plus the distance of the centres over
    0.15 x ``scale`` (a typical depth, scene units): about 8 degrees of parallax.
    """
    forward = store.frame.cam_from_local(camera.cam_from_world)[0, 2, :3]
    cosine = store.views.cam_from_local[:, 2, :3] @ forward
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    distance = np.linalg.norm(store.views.centers - store.frame.from_world(camera.centers), axis=1)
    return angle / 15 + distance / (0.15 * scale)


def project(
    store: Store,
    cameras: Cameras,
    *,
    options: SplatOptions | None = None,
    without: str | None = None,
) -> Guidance:
    """Project the memory into cameras of one image size.

    What is nearer to the camera's plane than a voxel and than 1e-4 of the typical depth is not
    drawn. A back end that blends leaves out what the view named ``without`` saw.
    """
    sizes = set(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))
    if len(sizes) != 1:
        raise ShapeError(
            f"projection into cameras of {len(sizes)} image sizes; expected one; "
            "project each size by itself"
        )
    options = options or SplatOptions()
    if options.backend in ONE_PIXEL:
        check_usable(cameras)
        if not store.in_ram:
            raise OptionError(
                f"splat.backend {options.backend}: does not project a memory in tiles; choose cpu "
                "or torch, or a greater memory.budget"
            )
        from gvtools.memory.splat.one_pixel import project_one_pixel

        return project_one_pixel(store, cameras, open3d=options.backend == "open3d")
    splatter = _splatter(store, options)
    views = [
        Projection(store, camera, options, splatter=splatter, without=without).guidance()
        for camera in cameras
    ]
    return concatenate(views)


def _splatter(store: Store, options: SplatOptions) -> Splatter:
    if options.backend == "torch":
        from gvtools.memory.splat.torch_splatter import TorchSplatter

        return TorchSplatter(store, options)
    from gvtools.memory.splat.cpu import CpuSplatter

    return CpuSplatter(store, options)


class Observed(NamedTuple):
    """What observed views show of a camera; nothing generated changes it."""

    # By their names, see FrameBuffers.
    images: dict[str, NDArray[Any]]
    # Typical depth, scene units; 0 where no observed view shows anything.
    scale: float
    # How many tiers of views there are, and the size of the next one.
    tiers: int
    size: int


class Projection:
    """The images of one target camera: what observed views show, then what generated ones add.

    ``observed`` of an earlier one is taken over: the caller knows that nothing observed was fused
    or forgotten since. None splats all; the result is the same to the bit.
    """

    def __init__(
        self,
        store: Store,
        camera: Cameras,
        options: SplatOptions,
        *,
        observed: Observed | None = None,
        splatter: Splatter | None = None,
        without: str | None = None,
    ) -> None:
        check_usable(camera)
        names = [view.camera.names[0] for view in store.views]
        self.shown = np.array([name != without for name in names], np.bool_)
        self.store, self.camera, self.options = store, camera, options
        self.splatter = splatter or _splatter(store, options)
        shape = (int(camera.height[0]), int(camera.width[0]))
        # In one order of memory, for which alone the kernels are compiled.
        self.K = np.ascontiguousarray(camera.K[0])
        cam_from_local = np.ascontiguousarray(store.frame.cam_from_local(camera.cam_from_world)[0])
        single, flag = np.float32, np.bool_
        self.target = FrameBuffers(
            camera, cam_from_local, np.empty((store.segments.count, 4), np.int32), single(0),
            single(1), np.zeros((*shape, 3), single), np.zeros(shape, single),
            np.zeros(shape, flag), np.zeros(shape, single), np.zeros(shape, flag),
            np.zeros(shape, flag),
        )  # fmt: skip
        self.scale, self.tiers = 0.0, 0
        self.size = options.nearest_views or max(1, len(store.views))
        self.tier = np.full(len(store.views), -1)
        if observed is None:
            self.observe()
            return
        for name, image in observed.images.items():
            getattr(self.target, name)[:] = image
        self.tiers, self.size = observed.tiers, observed.size
        if observed.scale:
            self._set_scale(observed.scale)

    def observe(self) -> None:
        """Write what observed views show."""
        if self._find_segments(generated=False):
            self._splat_tiers()
            if self.options.occluders:
                scanned = self.store.views.scanned[self.store.segments.view[self.seen]]
                # Photographs first, as in the tiers.
                for source in np.unique(scanned):
                    self._splat_occluders(self.seen[scanned == source])

    def observed(self) -> Observed:
        """A copy of what is written before ``guidance``."""
        images = {name: getattr(self.target, name).copy() for name in IMAGES if name != "generated"}
        return Observed(images, self.scale, self.tiers, self.size)

    def guidance(self) -> Guidance:
        """The images, after what was generated has been written where nothing was observed."""
        if self.store.views.generated.any() and self._find_segments(generated=True):
            self._splat_tiers()
        return Guidance(self.camera, *(getattr(self.target, name)[None] for name in IMAGES))

    def _set_scale(self, scale: float) -> None:
        self.scale = scale
        self.target.z_near = np.float32(min(NEAREST * scale, self.store.voxel))
        self.target.unit = np.float32(np.ldexp(1.0, int(np.frexp(scale)[1])))

    def _find_segments(self, *, generated: bool) -> bool:
        """Find the segments in view, of one kind, and rank the views that they come from."""
        store, segments, target = self.store, self.store.segments, self.target
        groups = np.arange(segments.groups)
        group_rect = np.empty((segments.groups, 4), np.int32)
        self._cull_boxes(segments.group_box, groups, group_rect)
        rows = groups[group_rect[:, 1] >= 0, None] * segments.GROUP + np.arange(segments.GROUP)
        rows = rows[rows < segments.count]
        view = segments.view[rows]
        rows = rows[self.shown[view] & (store.views.generated[view] == generated)]
        self.z_range = self._cull_boxes(segments.box, rows, target.rect)
        self.seen = rows[target.rect[rows, 1] >= 0]
        if not len(self.seen):
            return False
        # Of what was observed where there is any: it must not hang on what was added to it.
        if not self.scale:
            self._set_scale(float(np.median(self.z_range[self.seen, 1])))
        self.distance = view_distance(store, self.camera, self.scale)
        present = np.bincount(
            segments.view[self.seen], segments.length[self.seen], minlength=len(store.views)
        )
        order = np.lexsort((self.distance, store.views.scanned))
        self.ranked = order[present[order] > 0]
        return True

    def _cull_boxes(
        self, boxes: NDArray[np.float32], rows: NDArray[np.int64], rect: NDArray[np.int32]
    ) -> NDArray[np.float32]:
        """Rectangles of ``rows`` of boxes go to ``rect``; returns their depth ranges."""
        height, width = self.target.shape
        z_range = np.empty((len(rect), 2), np.float32)
        in_threads(
            culling.cull_segments, len(rows), boxes, rows, self.target.cam_from_local,
            self.K, width, height, self.options.blend_reach, rect, z_range,
        )  # fmt: skip
        return z_range

    def _splat_tiers(self) -> None:
        """Nearest views first, in tiers that double in size; each writes what is still open.

        Generated views come in tiers of their own, after all observed ones, and so do those of
        scans after photographs.
        """
        target = self.target
        members = []
        first = self.tiers
        scanned = self.store.views.scanned[self.ranked]
        for ranked in (self.ranked[~scanned], self.ranked[scanned]):
            at = 0
            while at < len(ranked):
                members.append(ranked[at : at + self.size])
                self.tier[members[-1]] = self.tiers
                self.tiers += 1
                at += self.size
                self.size *= 2
        view = self.store.segments.view[self.seen]
        for number, views in enumerate(members, first):
            open_ = ~target.valid
            limit = np.where(open_, np.float32(np.inf), np.float32(0))
            chosen = self.seen[self.tier[view] == number]
            if number:
                if not open_.any():
                    return
                chosen = culling.touching(target.rect, culling.summed_area(open_), chosen)
            of_scan = bool(self.store.views.scanned[views[0]])
            self._write(chosen, limit, open_, members=views, few=number > 0, scanned=of_scan)

    def _write(
        self,
        chosen: NDArray[np.int64],
        limit: NDArray[np.float32],
        open_: NDArray[np.bool_],
        *,
        members: NDArray[np.int64],
        few: bool,
        scanned: bool,
    ) -> None:
        """Splat and write the pixels ``open_``; weights count from the nearest of ``members``."""
        beyond = np.maximum(self.distance - self.distance[members].min(), 0)
        weight = np.exp(-self.options.view_weight * beyond).astype(np.float32)
        writable = open_ if few else None
        self.splatter.splat(SplatRequest(self.target, chosen, limit, weight, writable))
        views, target = self.store.views, self.target
        before = np.where(target.valid, target.depth, np.float32(0))
        self.splatter.resolve(target, open_, generated=bool(views.generated[members[0]]))
        # What is written has another depth than before.
        target.scanned[open_ & target.valid & (target.depth != before)] = scanned

    def _splat_occluders(self, seen: NDArray[np.int64]) -> None:
        """Let through what unused observations, of one source, know to stand clearly in front.

        A view of the first tier may have looked past an object that only others saw. Where a
        first-tier view saw the object's place to be free, the object is noise or has moved.
        """
        store, target = self.store, self.target
        view = store.segments.view[seen]
        later = seen[self.tier[view] != 0]
        if not len(later):
            return
        grids = store.observed_grids(np.flatnonzero(self.tier == 0))
        tolerance = store.options.free_space_tolerance
        chosen = self._in_front(later, grids)
        if not len(chosen):
            return
        limit = target.depth * np.float32(1 - 2 * self.options.depth_band)
        none = np.zeros(len(store.views), np.float32)
        zbuffer = self.splatter.splat(SplatRequest(target, chosen, limit, none, blend=False))
        front = zbuffer < limit
        front[front] = ~in_free_space(self._lifted(zbuffer, front), grids, tolerance=tolerance)
        # Slivers along silhouettes are what an error of a pixel in a pose looks like.
        front = culling.open_mask(front, OCCLUDER_SIDE)
        if front.any():
            chosen = culling.touching(target.rect, culling.summed_area(front), chosen)
            limit = np.where(front, limit, np.float32(0))
            scanned = bool(store.views.scanned[view[0]])
            self._write(chosen, limit, front, members=self.ranked, few=True, scanned=scanned)

    def _in_front(self, later: NDArray[np.int64], grids: list[FreeGrid]) -> NDArray[np.int64]:
        """Those of some segments that hold something clearly nearer than the depth written so far.

        What the views with free-space ``grids`` saw to be free does not count.
        """
        store, target, margin = self.store, self.target, 2 * self.options.depth_band
        near = np.zeros(len(later), np.bool_)
        in_threads(
            culling.may_be_in_front, len(later), later, target.rect, self.z_range,
            culling.tile_farthest(target.depth), margin, near,
        )  # fmt: skip
        later, free = later[near], stack_grids(grids)
        hit = np.zeros(len(later), np.bool_)
        for part in store.tiles.split(store.segments, later):
            rows = store.tiles.gather(store.segments, later[part])
            in_threads(
                culling.in_front, len(rows.chosen), rows.chosen, rows.start, rows.length,
                rows.columns.positions, target.cam_from_local, self.K, target.depth, margin, *free,
                store.options.free_space_tolerance, hit[part],
            )  # fmt: skip
        return later[hit]

    def _lifted(self, depth: NDArray[np.float32], where: NDArray[np.bool_]) -> NDArray[np.float32]:
        """(N, 3) points of the pixels ``where`` (H, W), in the memory's frame."""
        row, col = np.nonzero(where)
        K, M = self.K, self.target.cam_from_local
        y = (row + 0.5 - K[1, 2]) / K[1, 1]
        x = (col + 0.5 - K[0, 2] - K[0, 1] * y) / K[0, 0]
        rays = np.stack([x, y, np.ones_like(x)], axis=1)
        points = (rays * depth[where, None] - M[:3, 3]) @ M[:3, :3]
        return points.astype(np.float32)
