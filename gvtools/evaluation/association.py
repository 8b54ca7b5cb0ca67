"""Which pose of one trajectory belongs to which of another: by time, by name, or by index."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import DegenerateError, ShapeError

Rows = NDArray[np.int64]

# Time stamps of one event, recorded by two clocks, may differ by this, seconds.
MAX_DIFFERENCE = 0.01


def by_time(
    reference: ArrayLike,
    estimate: ArrayLike,
    *,
    max_difference: float = MAX_DIFFERENCE,
    offset: float = 0.0,
) -> tuple[Rows, Rows]:
    """Pairs of nearest time stamps, as evo associates TUM and EuRoC trajectories.

    Each pose of the shorter trajectory takes the nearest of the longer one.

    Args:
        reference: (N,) seconds, in any order.
        estimate: (M,) seconds.
        max_difference: seconds; farther pairs are none.
        offset: seconds, added to the estimate's stamps.

    Returns:
        Rows of the reference and of the estimate, (K,) each, in the order of the shorter one.
    """
    first, second = np.asarray(reference, np.float64), np.asarray(estimate, np.float64) + offset
    for name, stamps in (("reference", first), ("estimate", second)):
        if stamps.ndim != 1 or not np.isfinite(stamps).all():
            raise ShapeError(f"{name} stamps {stamps.shape}; expected (N,) finite seconds")
    if not (first.size and second.size):
        raise DegenerateError("association by time: a trajectory without poses")
    swapped = len(second) < len(first)
    short, long = (second, first) if swapped else (first, second)
    order = np.argsort(long, kind="stable")
    right = np.clip(np.searchsorted(long[order], short), 1, max(len(long) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(long) - 1)
    nearer = np.abs(long[order[left]] - short) <= np.abs(long[order[right]] - short)
    match = order[np.where(nearer, left, right)]
    kept = np.flatnonzero(np.abs(long[match] - short) <= max_difference)
    if not len(kept):
        gap = np.abs(long[match] - short).min()
        raise DegenerateError(
            f"association by time: no pair within {max_difference:g} s, the nearest are {gap:.3g} "
            "s apart; give a greater largest difference, or an offset"
        )
    return (match[kept], kept) if swapped else (kept, match[kept])


def by_name(reference: Sequence[str], estimate: Sequence[str]) -> tuple[Rows, Rows]:
    """Pairs of equal names; where no name is equal, of equal file names without folder and suffix.

    Returns:
        Rows of the reference and of the estimate, in the reference's order.
    """
    for form in (str, lambda name: PurePosixPath(name.replace("\\", "/")).stem.split(".")[0]):
        first, second = [form(name) for name in reference], [form(name) for name in estimate]
        row = {name: i for i, name in enumerate(second)}
        pairs = [(i, row[name]) for i, name in enumerate(first) if name in row]
        if not pairs:
            continue
        if len(row) < len(second) or len(set(first)) < len(first):
            raise DegenerateError("association by name: a name occurs twice in one trajectory")
        rows = np.array(pairs, np.int64)
        return rows[:, 0], rows[:, 1]
    raise DegenerateError(
        f"association by name: none of {len(reference)} and {len(estimate)} names is equal (such "
        f"as {next(iter(reference), '')!r} and {next(iter(estimate), '')!r})"
    )


def by_index(reference: int, estimate: int) -> tuple[Rows, Rows]:
    """Row by row.

    Args:
        reference: number of its poses.
        estimate: likewise.
    """
    if reference != estimate or not reference:
        raise DegenerateError(
            f"association by index: {reference} and {estimate} poses; expected as many"
        )
    rows = np.arange(reference)
    return rows, rows
