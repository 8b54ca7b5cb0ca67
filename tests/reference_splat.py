"""A slow, plain reference of projection: every observation against every pixel, in float64.

The fast back ends cut, cull and share work; here each rule stands once, over whole images.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gvtools.cameras import Cameras
from gvtools.guidance import Guidance
from gvtools.memory.culling import SAMPLE
from gvtools.memory.occlusion import in_free_space
from gvtools.memory.projection import NEAREST, OCCLUDER_SIDE
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat import SplatOptions


@dataclass
class Projected:
    """All observations in one camera: pixel-centre coordinates, depth, footprint, trust."""

    u: np.ndarray
    v: np.ndarray
    z: np.ndarray
    size: np.ndarray
    trust: np.ndarray
    color: np.ndarray
    run: np.ndarray
    view: np.ndarray


def reference_project(
    memory: SpatialMemory, camera: Cameras, options: SplatOptions | None = None
) -> Guidance:
    """The guidance of one camera, by the definitions."""
    return Reference(memory, camera, options or SplatOptions()).run()


class Reference:
    def __init__(self, memory: SpatialMemory, camera: Cameras, options: SplatOptions) -> None:
        self.memory, self.camera, self.options = memory, camera, options
        self.height, self.width = int(camera.height[0]), int(camera.width[0])
        self.rows, self.cols = np.mgrid[: self.height, : self.width].astype(np.float64)
        shape = self.rows.shape
        self.rgb = np.zeros((*shape, 3))
        self.depth = np.zeros(shape)
        self.valid = np.zeros(shape, bool)
        self.confidence = np.zeros(shape)
        self.generated = np.zeros(shape, bool)

    def run(self) -> Guidance:
        if self._rank_views():
            self.tiers = self._ranked_tiers()
            for tier in self.tiers:
                if tier[0] in self.observed:
                    self._tier(tier)
            if self.observed and self.options.occluders:
                self._occluders(self.tiers[0])
            for tier in self.tiers:
                if tier[0] in self.made:
                    self._tier(tier)
        return Guidance(
            self.camera,
            self.rgb[None].astype(np.float32),
            self.depth[None].astype(np.float32),
            self.valid[None],
            self.confidence[None].astype(np.float32),
            self.generated[None],
        )

    def _local(self, positions: np.ndarray) -> np.ndarray:
        """Camera-frame coordinates of positions that are relative to the memory's origin."""
        world = positions.astype(np.float64) + self.memory.origin
        pose = self.camera.cam_from_world[0]
        return world @ pose[:3, :3].T + pose[:3, 3]

    def _rank_views(self) -> bool:
        """Which views have runs in view, observed first, and then by their distance."""
        memory, runs, K = self.memory, self.memory.runs, self.camera.K[0]
        seen, farthest = [], []
        for r in range(runs.count):
            low, high, spacing = runs.box[r, :3], runs.box[r, 3:6], float(runs.box[r, 6])
            corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, 8).T
            local = self._local(corners)
            if local[:, 2].max() <= 0:
                continue
            if local[:, 2].min() > 0:
                xy = local @ K.T
                xy = xy[:, :2] / xy[:, 2:]
                reach = self.options.blend_reach * spacing * max(K[0, 0], K[1, 1])
                pad = max(1.0, reach / local[:, 2].min()) + 1.0
                size = (self.width, self.height)
                if (xy.max(0) + pad < 0).any() or (xy.min(0) - pad >= size).any():
                    continue
            seen.append(r)
            farthest.append(local[:, 2].max())
        if not seen:
            return False
        self.seen = np.array(seen)
        made = [bool(memory.views.generated[runs.view[r]]) for r in seen]
        observed = [z for z, generated in zip(farthest, made, strict=True) if not generated]
        scale = float(np.median(observed or farthest))
        self.near = min(NEAREST * scale, memory.voxel)
        views = memory.views
        axes = np.array([views[i].camera.cam_from_world[0, 2, :3] for i in range(len(views))])
        centers = np.array([views[i].camera.centers[0] for i in range(len(views))])
        cosine = np.clip(axes @ self.camera.cam_from_world[0, 2, :3], -1, 1)
        apart = np.linalg.norm(centers - self.camera.centers[0], axis=1)
        self.distance = np.degrees(np.arccos(cosine)) / 15 + apart / (0.15 * scale)
        present = sorted(set(runs.view[self.seen].tolist()))
        self.observed = sorted(
            (i for i in present if not views.generated[i]), key=lambda i: (self.distance[i], i)
        )
        self.made = sorted(
            (i for i in present if views.generated[i]), key=lambda i: (self.distance[i], i)
        )
        self._project(K)
        return True

    def _project(self, K: np.ndarray) -> None:
        memory, records, n = self.memory, self.memory.records, len(self.memory)
        runs = memory.runs
        run = np.repeat(np.arange(runs.count), runs.length[: runs.count])
        local = self._local(records.position)
        z = local[:, 2]
        depth = np.maximum(z, self.near)
        u = (K[0, 0] * local[:, 0] + K[0, 1] * local[:, 1]) / depth + K[0, 2] - 0.5
        v = K[1, 1] * local[:, 1] / depth + K[1, 2] - 0.5
        size = records.spacing[:n] * np.sqrt(K[0, 0] * K[1, 1]) / depth
        self.points = Projected(
            u, v, z,
            np.minimum(np.maximum(size, 1), self.options.size_cap),
            np.minimum(records.confidence[:n] + records.agreement[:n], memory.options.weight_cap),
            records.color[:n].astype(np.float64) / 255,
            run, runs.view[run],
        )  # fmt: skip

    def _ranked_tiers(self) -> list[list[int]]:
        """Tiers of views, nearest first, twice as many each time; observed and generated apart."""
        size = self.options.nearest_views
        tiers = []
        for ranked in (self.observed, self.made):
            at = 0
            while at < len(ranked):
                tiers.append(ranked[at : at + size])
                at += size
                size *= 2
        return tiers

    def _tier(self, tier: list[int]) -> None:
        chosen = np.isin(self.points.view, tier) & np.isin(self.points.run, self.seen)
        limit = np.where(self.valid, 0, np.inf)
        weight = self._proximity(min(self.distance[i] for i in tier))
        self._write(chosen, limit, ~self.valid, weight)

    def _proximity(self, nearest: float) -> np.ndarray:
        return np.exp(-self.options.proximity * (self.distance - nearest))

    def _nearest_depth(self, chosen: np.ndarray, limit: np.ndarray) -> np.ndarray:
        p = self.points
        zbuffer = np.full(self.rows.shape, np.inf)
        for i in np.flatnonzero(chosen & (p.z > self.near)):
            half = self.options.depth_reach * p.size[i]
            covered = (abs(self.cols - p.u[i]) <= half) & (abs(self.rows - p.v[i]) <= half)
            covered &= p.z[i] < limit
            zbuffer[covered] = np.minimum(zbuffer[covered], p.z[i])
        return zbuffer

    def _write(
        self, chosen: np.ndarray, limit: np.ndarray, open_: np.ndarray, weight: np.ndarray
    ) -> None:
        """Depth first, then blend what lies inside the band behind it."""
        p, views = self.points, self.memory.views
        zbuffer = self._nearest_depth(chosen, limit)
        shape = self.rows.shape
        total, support = np.zeros(shape), np.zeros(shape)
        depth, made, rgb = np.zeros(shape), np.zeros(shape), np.zeros((*shape, 3))
        for i in np.flatnonzero(chosen & (p.z > self.near)):
            reach = self.options.blend_reach * p.size[i]
            squared = (self.cols - p.u[i]) ** 2 + (self.rows - p.v[i]) ** 2
            kernel = np.maximum(1 - squared / reach**2, 0) ** 2
            kernel[p.z[i] > np.minimum(zbuffer, limit) * (1 + self.options.band)] = 0
            w = kernel * p.trust[i] * weight[p.view[i]]
            rgb += w[..., None] * p.color[i]
            depth += w * p.z[i]
            made += w * views.generated[p.view[i]]
            total += w
            support += kernel
        done = open_ & (support >= self.options.support) & (total > 0)
        self.rgb[done] = rgb[done] / total[done][:, None]
        self.depth[done] = depth[done] / total[done]
        self.confidence[done] = total[done] / support[done]
        self.generated[done] = made[done] > 0.5 * total[done]
        self.valid |= done

    def _occluders(self, first: list[int]) -> None:
        """Observed things clearly in front, unless a view of ``first`` saw their place free."""
        p, K, memory = self.points, self.camera.K[0], self.memory
        margin = 1 - 2 * self.options.band
        sampled = np.zeros(len(p.z), bool)
        for r in self.seen:
            start = memory.runs.start[r]
            sampled[start : start + memory.runs.length[r] : SAMPLE] = True
        col, row = np.floor(p.u + 0.5), np.floor(p.v + 0.5)
        sampled &= (col >= 0) & (col < self.width) & (row >= 0) & (row < self.height) & (p.z > 0)
        sampled &= ~np.isin(p.view, first) & ~memory.views.generated[p.view]
        at = np.flatnonzero(sampled)
        front = p.z[at] < margin * self.depth[row[at].astype(int), col[at].astype(int)]
        n = len(p.z)
        front &= ~in_free_space(
            memory.records.position[:n][at],
            memory.observed_grids(first),
            tolerance=memory.options.free_space_tolerance,
        )
        chosen = np.isin(p.run, p.run[at[front]])
        zbuffer = self._nearest_depth(chosen, margin * self.depth)
        keep = np.isfinite(zbuffer)
        if not keep.any():
            return
        rays = np.stack([self.cols[keep] + 0.5, self.rows[keep] + 0.5, np.ones(keep.sum())], 1)
        local = rays @ np.linalg.inv(K).T * zbuffer[keep][:, None]
        pose = self.camera.cam_from_world[0]
        world = (local - pose[:3, 3]) @ pose[:3, :3]
        free = in_free_space(
            (world - memory.origin).astype(np.float32),
            memory.observed_grids(first),
            tolerance=memory.options.free_space_tolerance,
        )
        keep[keep] = ~free
        opened = np.zeros_like(keep)
        half = OCCLUDER_SIDE // 2
        for r in range(half, self.height - half):
            for c in range(half, self.width - half):
                square = np.s_[r - half : r + half + 1, c - half : c + half + 1]
                if keep[square].all():
                    opened[square] = True
        if opened.any():
            nearest = min(self.distance[i] for i in self.observed)
            limit = np.where(opened, margin * self.depth, 0)
            self._write(chosen, limit, opened, self._proximity(nearest))
