"""The compiled back end of projection: numba kernels over bands of image rows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np
from numpy.typing import NDArray

from gvtools.memory import culling
from gvtools.memory.splat import cpu_kernels as splat_kernels

if TYPE_CHECKING:
    from gvtools.memory.splat.api import FrameBuffers, SplatOptions
    from gvtools.memory.store.store import Store


class CpuSplatter:
    """Splats segments of a memory on the processor's cores; see gvtools.memory.splat.api.Splatter."""

    def __init__(self, store: Store, options: SplatOptions) -> None:
        self.store, self.options = store, options
        self.zbuffer = np.empty((0, 0), np.float32)
        self.total = np.empty((0, 0, 0), np.float32)

    def splat(
        self,
        target: FrameBuffers,
        chosen: NDArray[np.int64],
        limit: NDArray[np.float32],
        *,
        weight: NDArray[np.float32],
        table: NDArray[np.int32] | None,
        blend: bool,
    ) -> NDArray[np.float32]:
        """See gvtools.memory.splat.api.Splatter."""
        height, width = target.shape
        if self.zbuffer.shape != target.shape:
            self.zbuffer = np.empty(target.shape, np.float32)
            self.total = np.empty((height, width, splat_kernels.CHANNELS), np.float32)
        columns, options = self.store.columns.arrays, self.options
        segments = self.store.segments
        reachable = np.empty(0, np.bool_) if table is None else culling.near_to(table)
        splat_kernels.splat_segments(
            chosen, segments.start, segments.length, segments.view, target.rect,
            columns.positions, columns.colors, columns.confidence, columns.spacing, weight,
            target.cam_from_local.astype(np.float32), target.camera.K[0], target.z_near, target.unit,
            limit.reshape(-1), reachable,
            np.float32(options.depth_band), np.float32(options.depth_reach),
            np.float32(options.blend_reach), np.float32(options.max_splat_px),
            numba.get_num_threads(), blend,
            width, height, self.zbuffer.reshape(-1),
            self.total.reshape(-1, splat_kernels.CHANNELS),
        )  # fmt: skip
        return self.zbuffer

    def resolve(self, target: FrameBuffers, open_: NDArray[np.bool_], *, generated: bool) -> None:
        """See gvtools.memory.splat.api.Splatter."""
        splat_kernels.resolve(
            self.total, open_, np.float32(self.options.support), target.unit, generated,
            target.rgb, target.depth, target.valid, target.confidence, target.generated,
        )  # fmt: skip
