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
    """Splats segments of a memory on the processor's cores; see splat.api.Splatter."""

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
        writable: NDArray[np.bool_] | None,
        blend: bool,
        fresh: bool = True,
    ) -> NDArray[np.float32]:
        """See gvtools.memory.splat.api.Splatter; not ``fresh`` adds to the last splat's sums."""
        height, width = target.shape
        if self.zbuffer.shape != target.shape:
            self.zbuffer = np.empty(target.shape, np.float32)
            self.total = np.empty((height, width, splat_kernels.CHANNELS), np.float32)
        columns, options = self.store.columns.arrays, self.options
        segments = self.store.segments
        reachable = np.empty(0, np.bool_)
        if writable is not None:
            reachable = culling.near_to(writable).ravel()
        K, single = target.camera.K[0], np.float32
        lens = splat_kernels.Lens(
            target.cam_from_local.astype(single), single(K[0, 0]), single(K[1, 1]),
            single(K[0, 1]), single(K[0, 2] - 0.5), single(K[1, 2] - 0.5),
            single(np.sqrt(K[0, 0] * K[1, 1])), target.z_near, target.unit, width, height,
        )  # fmt: skip
        rules = splat_kernels.SplatRules(
            single(options.depth_band), single(options.depth_reach),
            single(options.blend_reach), single(options.max_splat_px),
        )  # fmt: skip
        table_of = splat_kernels.SegmentColumns(
            segments.start, segments.length, segments.view, target.rect
        )
        splat_kernels.splat_segments(
            chosen, table_of, columns, weight, lens, rules, limit.reshape(-1), reachable,
            numba.get_num_threads(), blend, fresh, self.zbuffer.reshape(-1),
            self.total.reshape(-1, splat_kernels.CHANNELS),
        )  # fmt: skip
        return self.zbuffer

    def resolve(self, target: FrameBuffers, open_: NDArray[np.bool_], *, generated: bool) -> None:
        """See gvtools.memory.splat.api.Splatter."""
        splat_kernels.resolve(
            self.total, open_, np.float32(self.options.support), target.unit, generated,
            target.rgb, target.depth, target.valid, target.confidence, target.generated,
        )  # fmt: skip
