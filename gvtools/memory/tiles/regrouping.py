"""Cutting a store into parts, and joining stores, by whole segments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.store.columns import ATTRIBUTES
from gvtools.memory.store.store import Store

# Placeholder for the column ``next``: rebuild_index links the chains again.
NONE = np.full(1, -1, np.int32)


def part_of(store: Store, rows: NDArray[np.int64], part: Store) -> Store:
    """Copy the segments ``rows`` (ascending) of a store's table into the empty store ``part``."""
    segments = store.segments
    length = segments.length[rows].astype(np.int64)
    chosen = rows_of(segments.start[rows], length)
    columns = store.columns
    part.columns.replace(
        len(chosen),
        lambda name: getattr(columns, name).take(chosen, axis=0) if name in ATTRIBUTES else NONE,
    )
    part.segments.append(
        np.cumsum(length) - length, segments.length[rows], segments.view[rows],
        box=segments.box[rows],
    )  # fmt: skip
    new_row = np.full(len(store), -1, np.int32)
    new_row[chosen] = np.arange(len(chosen), dtype=np.int32)
    for number, log in store.agreements.items():
        for agreed, weights, before in log:
            there = new_row[agreed]
            keep = there >= 0
            if keep.any():
                part.agreements.setdefault(number, []).append(
                    (there[keep], weights[keep], before[keep])
                )
    part.rebuild_index()
    return part


def joined(stores: Sequence[Store], whole: Store) -> Store:
    """Copy stores that share no voxel into the empty store ``whole``, one behind the other."""
    first = np.cumsum([0, *(len(store) for store in stores)])
    whole.columns.replace(
        int(first[-1]),
        lambda name: (
            np.concatenate([getattr(store.columns, name) for store in stores])
            if name in ATTRIBUTES
            else NONE
        ),
    )
    for at, store in zip(first.tolist(), stores, strict=False):
        segments, n = store.segments, store.segments.count
        whole.segments.append(
            segments.start[:n] + at, segments.length[:n], segments.view[:n], box=segments.box[:n]
        )
        for number, log in store.agreements.items():
            whole.agreements.setdefault(number, []).extend(
                ((rows + at).astype(np.int32), weights, before) for rows, weights, before in log
            )
    whole.rebuild_index()
    return whole


def rows_of(start: NDArray[np.int64], length: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the observations of segments (start, length), one segment after the other."""
    ends = np.cumsum(length)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total) + np.repeat(start - (ends - length), length)
