"""The torch back end of projection, for CUDA: every (observation, pixel) pair is a row.

Depth is a scatter with ``amin``, blending an indexed sum, so the result is the compiled back end's
but for rounding. Sums are added in the order of the rows on the CPU and, through the sorting form
of ``index_put_``, on CUDA too: the same memory and cameras give the same bytes on the same device.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.utils.dlpack
from numpy.typing import NDArray

from gvtools.memory.culling import summed_area
from gvtools.memory.splat.api import SplatRequest, thinning
from gvtools.memory.splat.cpu import CHANNELS, FAINTEST, SMALLEST
from gvtools.memory.store.observations import SplatColumns
from gvtools.networks.compute import named_device

if TYPE_CHECKING:
    from gvtools.memory.splat.api import FrameBuffers, SplatOptions
    from gvtools.memory.store.store import Store

# Pairs held at a time: about 120 bytes each.
PAIRS = {"cpu": 1 << 20, "cuda": 1 << 24}


class TorchSplatter:
    """Splats segments of a memory on one device; see splat.api.Splatter."""

    def __init__(self, store: Store, options: SplatOptions) -> None:
        self.store, self.options = store, options
        self.device = named_device(options.device, option="splat.device")
        if store.in_ram:
            # In the store's own memory where that is on this device.
            columns, shared = store.columns, torch.utils.dlpack.from_dlpack
            xyz, color, confidence, spacing = (
                shared(columns.tensor(name).to_dlpack()).to(self.device)
                if len(store)
                else self._tensor(columns.tensor(name).cpu().numpy())
                for name in SplatColumns._fields
            )
            self._take((xyz, color, confidence[:, 0], spacing[:, 0]), **store.segments.rows())
        self.total = torch.empty(0)

    def _take(
        self, columns: tuple[torch.Tensor, ...], *, start: NDArray, length: NDArray, view: NDArray,
        **_: NDArray,
    ) -> None:  # fmt: skip
        """The observations, and the table of their segments."""
        self.xyz, self.color, self.confidence, self.spacing = columns
        self.start, self.length = self._tensor(start), self._tensor(length.astype(np.int64))
        self.segment_view = self._tensor(view.astype(np.int64))

    def _tensor(self, array: NDArray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)

    def splat(self, request: SplatRequest) -> NDArray[np.float32]:
        """See splat.api.Splatter."""
        target, chosen, limit = request.target, request.chosen, request.limit
        if not self.store.in_ram:
            segments = self.store.segments
            detail = thinning(self.store, target, chosen, px=self.options.far_detail_px)
            found = self.store.tiles.gather(segments, chosen, doublings=detail)
            self._take(
                tuple(self._tensor(column) for column in found.columns), start=found.start,
                length=found.length, view=found.of(segments.view),
            )  # fmt: skip
            chosen = found.chosen
        height, width = target.shape
        limits = self._tensor(limit.reshape(-1))
        writable = request.writable
        sums = None if writable is None else self._tensor(summed_area(writable))
        zbuffer = limits.clone()
        rows, view = self._observations(chosen)
        u, v, z, size = self._project(target, rows)
        ahead = z > target.z_near
        rows, view, u, v, z, size = (column[ahead] for column in (rows, view, u, v, z, size))
        for i, row, col in self._pairs(
            u, v, self.options.depth_reach * size, shape=target.shape, table=sums
        ):
            cell = row * width + col
            use = z[i] < limits[cell]
            zbuffer.scatter_reduce_(0, cell[use], z[i[use]], "amin")
        if request.blend:
            farthest = zbuffer * (1 + self.options.depth_band)
            scale = self.confidence[rows] * self._tensor(request.weight)[view]
            scale = scale.clamp(min=float(FAINTEST))
            self.total = torch.zeros((height * width, CHANNELS), device=self.device)
            reach = self.options.blend_reach * size
            for i, row, col in self._pairs(u, v, reach, shape=target.shape, table=sums):
                cell = row * width + col
                use = z[i] <= farthest[cell]
                i, row, col, cell = i[use], row[use], col[use], cell[use]
                squared = (col - u[i]) ** 2 + (row - v[i]) ** 2
                kernel = (1 - squared / reach[i] ** 2).clamp(min=0) ** 2
                self._add(cell, kernel, scale[i], rows=rows[i], z=z[i] / float(target.unit))
        return zbuffer.reshape(height, width).cpu().numpy()

    def resolve(self, target: FrameBuffers, open_: NDArray[np.bool_], *, generated: bool) -> None:
        """See splat.api.Splatter."""
        kernel, weight = self.total[:, 5], self.total[:, 3]
        done = self._tensor(open_.reshape(-1)) & (kernel >= self.options.support)
        done &= weight >= float(SMALLEST)
        cells = torch.nonzero(done)[:, 0]
        total = self.total[cells]
        kernel, weight = total[:, 5], total[:, 3]
        at = cells.cpu().numpy()
        target.rgb.reshape(-1, 3)[at] = (total[:, :3] / weight[:, None] / 255).cpu().numpy()
        target.depth.reshape(-1)[at] = (total[:, 4] / weight * float(target.unit)).cpu().numpy()
        target.confidence.reshape(-1)[at] = (weight / kernel).cpu().numpy()
        target.generated.reshape(-1)[at] = generated
        target.valid.reshape(-1)[at] = True

    def _observations(self, chosen: NDArray[np.int64]) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows of the chosen segments' observations, and the view of each."""
        segments = self._tensor(chosen)
        length = self.length[segments]
        which = torch.repeat_interleave(length)
        within = torch.arange(len(which), device=self.device) - (length.cumsum(0) - length)[which]
        return self.start[segments][which] + within, self.segment_view[segments][which]

    def _project(self, target: FrameBuffers, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Centre-of-pixel coordinates, depth and footprint width (pixels) of observations."""
        M = self._tensor(target.cam_from_local[:3].astype(np.float32))
        K = target.camera.K[0]
        # Component by component: a matrix product may be computed in TF32.
        x, y, w = self.xyz[rows].unbind(1)
        px, py, z = (M[k, 0] * x + M[k, 1] * y + M[k, 2] * w + M[k, 3] for k in range(3))
        inverse = 1 / z.clamp(min=float(target.z_near))
        u = (float(K[0, 0]) * px + float(K[0, 1]) * py) * inverse + float(K[0, 2] - 0.5)
        v = float(K[1, 1]) * py * inverse + float(K[1, 2] - 0.5)
        size = self.spacing[rows] * float(np.sqrt(K[0, 0] * K[1, 1])) * inverse
        return u, v, z, size.clamp(1, self.options.max_splat_px)

    def _pairs(
        self,
        u: torch.Tensor,
        v: torch.Tensor,
        half: torch.Tensor,
        *,
        shape: tuple[int, int],
        table: torch.Tensor | None,
    ) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Yield (observation, row, column) of the pixel centres within ``half``, in parts."""
        height, width = shape
        # Clamped as floats: far outside the image, the integers would overflow.
        left = torch.ceil(u - half).clamp(0, width).long()
        right = torch.floor(u + half).clamp(-1, width - 1).long()
        top = torch.ceil(v - half).clamp(0, height).long()
        bottom = torch.floor(v + half).clamp(-1, height - 1).long()
        across = (right - left + 1).clamp(min=0)
        count = across * (bottom - top + 1).clamp(min=0)
        if table is not None:
            # Footprints without a pixel to be written are most of those of a late tier.
            r0, r1, c0, c1 = top, bottom + 1, left, right + 1
            opened = table[r1, c1] - table[r0, c1] - table[r1, c0] + table[r0, c0]
            count = count * (opened > 0)
        inside = torch.nonzero(count)[:, 0]
        left, top, across, count = (c[inside] for c in (left, top, across, count))
        end = count.cumsum(0)
        budget = PAIRS[self.device.type]
        first = 0
        while first < len(inside):
            done = int(end[first - 1]) if first else 0
            last = int(torch.searchsorted(end, done + budget, right=True))
            part = slice(first, max(last, first + 1))
            which = torch.repeat_interleave(count[part])
            offset = end[part] - count[part] - done
            within = torch.arange(len(which), device=self.device) - offset[which]
            wide = across[part][which]
            row, col = top[part][which] + within // wide, left[part][which] + within % wide
            yield inside[part][which], row, col
            first = part.stop

    def _add(
        self,
        cell: torch.Tensor,
        kernel: torch.Tensor,
        scale: torch.Tensor,
        *,
        rows: torch.Tensor,
        z: torch.Tensor,
    ) -> None:
        """Add the pairs' contributions to the sums of their pixels."""
        w = scale * kernel
        channels = torch.empty((len(cell), CHANNELS), device=self.device)
        channels[:, :3] = w[:, None] * self.color[rows]
        channels[:, 3] = w
        channels[:, 4] = w * z
        channels[:, 5] = kernel
        if self.device.type == "cuda":
            # index_add_ adds in no fixed order on CUDA; index_put_ sorts first.
            self.total.index_put_((cell,), channels, accumulate=True)
        else:
            self.total.index_add_(0, cell, channels)
