"""Observations of a memory or of one of its tiles: columns, segments, voxel index, agreements."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy, deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.memory.store.columns import ATTRIBUTES, Columns, Segments
from gvtools.memory.store.voxel_index import VoxelIndex, link_records, voxel_keys

# Rows, confidence added and confidence before, of one view that agreed.
Agreement = tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]
# Placeholder for the column ``next``: rebuild_index links the chains again.
NONE = np.full(1, -1, np.int32)


class Observations:
    """What was seen of a part of space; ``voxel`` is the edge of the finest voxels."""

    def __init__(self, voxel: float, weight_cap: float, device: str = "cpu") -> None:
        self.voxel, self.weight_cap = voxel, weight_cap
        self.columns = Columns(device)
        self.segments = Segments()
        self.index = VoxelIndex()
        # By round, one entry for each fused view that saw what earlier rounds had observed.
        self.agreements: dict[int, list[Agreement]] = {}

    def __len__(self) -> int:
        return self.columns.count

    @property
    def nbytes(self) -> int:
        """Bytes in use, without spare capacity."""
        agreed = sum(array.nbytes for log in self.agreements.values() for e in log for array in e)
        return self.columns.nbytes + self.segments.nbytes + self.index.nbytes + agreed

    def agree(self, rows: NDArray[np.int32], weights: NDArray[np.float32], *, round: int) -> None:
        """Raise the confidence of ``rows``, each once, up to the cap; ``drop_views`` undoes it."""
        confidence = self.columns.arrays.confidence
        before = confidence[rows]
        with np.errstate(over="ignore"):
            confidence[rows] = np.minimum(before + weights, np.float32(self.weight_cap))
        self.agreements.setdefault(round, []).append((rows, weights, before))

    def agreement_log(self) -> list[tuple[int, Agreement]]:
        """The agreements with their rounds, in order."""
        return [(r, entry) for r in sorted(self.agreements) for entry in self.agreements[r]]

    def own_confidence(self) -> NDArray[np.float32]:
        """(N,) float32, a copy: confidence without what later rounds added."""
        own = self.columns.confidence.copy()
        for _, (rows, _, before) in reversed(self.agreement_log()):
            own[rows] = before
        return own

    def drop_views(self, keep_view: NDArray[np.bool_], *, round: int) -> None:
        """Remove the views, all those of a round, that are not in ``keep_view`` (views,)."""
        columns = self.columns
        new_view = (np.cumsum(keep_view) - 1).astype(np.int32)
        keep = keep_view[columns.view]
        new_row = (np.cumsum(keep) - 1).astype(np.int32)
        # Reset confidence to what each observation had in its own round, remove the round's rows
        # and renumber the rest, then repeat what the other rounds added.
        columns.arrays.confidence[: len(self)] = self.own_confidence()
        log, self.agreements = self.agreement_log(), {}
        columns.replace(int(keep.sum()), lambda name: getattr(columns, name)[keep])
        columns.view[:] = new_view[columns.view]
        for number, (rows, weights, _) in log:
            if number != round:
                self.agree(new_row[rows[keep[rows]]], weights[keep[rows]], round=number)
        self.segments = self.segments.without_views(keep_view)
        self.rebuild_index()

    def rebuild_index(self) -> None:
        """Make the voxel index anew from the columns."""
        count, columns = len(self), self.columns
        keys, locals_ = np.empty(count, np.int64), np.empty(count, np.uint16)
        inverse = 1.0 / self.voxel
        if voxel_keys(columns.positions, columns.level, inverse, keys, locals_):
            raise OptionError(f"observations lie beyond the reach of voxels of {self.voxel:g}")
        self.index = VoxelIndex()
        self.index.top = int(columns.level.max(initial=0))
        blocks = self.index.block_numbers(keys)
        self.index.reserve_voxels(count, np.unique(blocks))
        link_records(locals_, self.index.arrays, blocks, columns.arrays.next)
        self.index.voxels = int(self.index.block_count[: self.index.blocks].sum())

    def part(self, rows: NDArray[np.int64]) -> Observations:
        """A copy of some segments, ``rows`` of their table, ascending."""
        segments, columns = self.segments, self.columns
        length = segments.length[rows]
        chosen = rows_of(segments.start[rows], length.astype(np.int64))
        part = Observations(self.voxel, self.weight_cap)
        part._fill(len(chosen), lambda name: getattr(columns, name).take(chosen, axis=0))
        part.segments.follow(length, segments.view[rows], segments.box[rows])
        new_row = np.full(len(self), -1, np.int32)
        new_row[chosen] = np.arange(len(chosen), dtype=np.int32)
        for number, log in self.agreements.items():
            for agreed, weights, before in log:
                there = new_row[agreed]
                keep = there >= 0
                if keep.any():
                    entry = (there[keep], weights[keep], before[keep])
                    part.agreements.setdefault(number, []).append(entry)
        part.rebuild_index()
        return part

    @staticmethod
    def concatenate(parts: Sequence[Observations]) -> Observations:
        """Copies of observations that share no voxel, one behind the other."""
        whole = Observations(parts[0].voxel, parts[0].weight_cap)
        first = np.cumsum([0, *(len(part) for part in parts)])
        whole._fill(
            int(first[-1]),
            lambda name: np.concatenate([getattr(part.columns, name) for part in parts]),
        )
        for at, part in zip(first.tolist(), parts, strict=False):
            segments = part.segments.rows()
            whole.segments.follow(segments["length"], segments["view"], segments["box"])
            for number, log in part.agreements.items():
                whole.agreements.setdefault(number, []).extend(
                    ((rows + at).astype(np.int32), weights, before) for rows, weights, before in log
                )
        whole.rebuild_index()
        return whole

    def _fill(self, count: int, values: Any) -> None:
        self.columns.replace(count, lambda name: values(name) if name in ATTRIBUTES else NONE)

    def snapshot(self) -> Observations:
        """The rows of now, in the same memory."""
        other = copy(self)
        other.columns, other.segments = copy(self.columns), copy(self.segments)
        return other

    def to(self, device: str) -> Observations:
        """A copy on a device, independent of this one."""
        other = copy(self)
        other.columns = self.columns.to(device)
        other.segments, other.index = deepcopy(self.segments), deepcopy(self.index)
        other.agreements = {round_: list(log) for round_, log in self.agreements.items()}
        return other


def rows_of(start: NDArray[np.int64], length: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the observations of segments (start, length), one segment after the other."""
    ends = np.cumsum(length)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total) + np.repeat(start - (ends - length), length)
