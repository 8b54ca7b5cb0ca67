"""Splatting of a memory in tiles: the chosen segments are gathered from those that hold them."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.splat.cpu import CpuSplatter
from gvtools.memory.store.columns import Columns, Segments
from gvtools.memory.tiles.gathering import Gathered, gather, parts_of
from gvtools.memory.tiles.thinned_copies import DOUBLINGS

if TYPE_CHECKING:
    from gvtools.memory.splat.api import FrameBuffers, SplatOptions, Splatter
    from gvtools.memory.store.store import Store
    from gvtools.memory.tiles.tile_set import TileSet


class PagedSplatter:
    """Splats segments of a memory in tiles; see splat.api.Splatter.

    What is gathered lies in the order of the segments, and several parts are first all asked for
    their depth, then all blended: the result is that of a memory in RAM.
    """

    def __init__(self, store: Store, options: SplatOptions) -> None:
        assert store.tiles is not None
        self.store, self.options = store, options
        self.tiles: TileSet = store.tiles
        self.inner: Splatter | None = None

    def splat(
        self,
        target: FrameBuffers,
        chosen: NDArray[np.int64],
        limit: NDArray[np.float32],
        *,
        weight: NDArray[np.float32],
        writable: NDArray[np.bool_] | None,
        blend: bool,
    ) -> NDArray[np.float32]:
        """See gvtools.memory.splat.api.Splatter."""
        if self.options.backend == "torch":
            from gvtools.memory.splat.torch_splatter import TorchSplatter

            found = self._gathered(target, chosen)
            self.inner = TorchSplatter(self._store_of(found, chosen), self.options)
            return self.inner.splat(
                replace(target, rect=target.rect[chosen]), np.arange(len(chosen)), limit,
                weight=weight, writable=writable, blend=blend,
            )  # fmt: skip
        if not isinstance(self.inner, CpuSplatter):
            self.inner = CpuSplatter(self.store, self.options)
        parts = list(parts_of(chosen, self.store.segments.length[chosen], self.tiles))
        depth, inner = limit, self.inner

        def once(
            part: NDArray[np.int64], *, blend: bool, fresh: bool = True
        ) -> NDArray[np.float32]:
            inner.store = self._store_of(self._gathered(target, part), part)
            return inner.splat(
                replace(target, rect=target.rect[part]), np.arange(len(part)), depth,
                weight=weight, writable=writable, blend=blend, fresh=fresh,
            )  # fmt: skip

        if len(parts) == 1:
            return once(parts[0], blend=blend)
        for part in parts:
            depth = once(part, blend=False).copy()
        for i, part in enumerate(parts if blend else ()):
            once(part, blend=True, fresh=not i)
        return depth

    def resolve(self, target: FrameBuffers, open_: NDArray[np.bool_], *, generated: bool) -> None:
        """See gvtools.memory.splat.api.Splatter."""
        assert self.inner is not None
        self.inner.resolve(target, open_, generated=generated)

    def _gathered(self, target: FrameBuffers, part: NDArray[np.int64]) -> Gathered:
        doublings = None
        if self.options.far_detail_px:
            doublings = thinning(self.store, target, part, px=self.options.far_detail_px)
        return gather(self.tiles, part, self.store.segments.length[part], doublings=doublings)

    def _store_of(self, gathered: Gathered, part: NDArray[np.int64]) -> Store:
        """A store of gathered rows alone, for a back end to read."""
        store, segments = copy(self.store), self.store.segments
        store.tiles, store.segments, store.columns = None, Segments(), Columns()
        store.segments.append(
            gathered.start, gathered.length, segments.view[part], box=segments.box[part]
        )
        store.columns.take_drawn(gathered.rows._asdict())
        return store


def thinning(
    store: Store, target: FrameBuffers, part: NDArray[np.int64], *, px: float
) -> NDArray[np.uint8]:
    """(n,) which thinned copy of each segment has cubes that are at most ``px`` pixels wide."""
    assert store.tiles is not None
    box, M, K = store.segments.box[part].astype(np.float64), target.cam_from_local, target.camera.K
    nearest = np.full(len(part), M[2, 3])
    for k in range(3):
        nearest += np.minimum(M[2, k] * box[:, k], M[2, k] * box[:, 3 + k])
    edge = store.voxel * np.ldexp(1.0, store.tiles.places.level[part].astype(np.int32))
    with np.errstate(divide="ignore"):
        wide = np.where(nearest > 0, edge * max(K[0, 0, 0], K[0, 1, 1]) / nearest, np.inf)
    out = np.zeros(len(part), np.uint8)
    for doublings in DOUBLINGS:
        out[wide * 2**doublings <= px] = doublings
    return out
