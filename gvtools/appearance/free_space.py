"""Free space between a camera and the nearest known surfaces, and the Gaussians that float in it.

Floaters match the photographs that they were fitted to and are fog in all others.
Only the space before every known surface in a part of the picture counts as free: points that one
photograph detected through a gap, or past a thing without texture, say nothing about what is
before them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.project_kernels import LOG_SCALE
from gvtools.appearance.splat.splat import Lens
from gvtools.kernels import compiled, in_threads

# Cells along the longer side of a picture.
CELLS = 24
# Space is free up to this share of the depth of the nearest surface in a cell and the eight around
# it; where these have none, up to a smaller share of that of the nearest cells that have one.
SHARE, UNKNOWN_SHARE = 0.8, 0.5
# Cells on either side of such a cell whose nearest ones count, too.
AROUND = 2


def free_depth(points: NDArray[np.float32], lens: Lens) -> NDArray[np.float32] | None:
    """(rows, columns) z-depth up to which space is free, by cells; None without a point.

    ``points`` (N, 3) on surfaces, in the frame of the lens.

    >>> lens = Lens.of(np.eye(4), np.diag([24.0, 24.0, 1]), size=(24, 24), near=0.1)
    >>> wall = np.array([[0.25, 0.25, 2.0]], np.float32)
    >>> free_depth(wall, lens)[[3, 23], [3, 23]].tolist()
    [1.600000023841858, 1.0]
    """
    from scipy.ndimage import distance_transform_edt, minimum_filter

    n = lens.numbers
    local = points @ n[:9].reshape(3, 3).T + n[9:12]
    local = local[local[:, 2] > lens.near]
    xy = local[:, :2] / local[:, 2:] * n[12:14] + n[14:]
    inside = ((xy >= 0) & (xy < (lens.width, lens.height))).all(axis=1)
    if not inside.any():
        return None
    scale = CELLS / max(lens.width, lens.height)
    shape = max(round(lens.height * scale), 1), max(round(lens.width * scale), 1)
    cell = np.minimum((xy[inside] * scale).astype(int), (shape[1] - 1, shape[0] - 1))
    nearest = np.full(shape, np.inf, np.float32)
    np.minimum.at(nearest, (cell[:, 1], cell[:, 0]), local[inside, 2].astype(np.float32))
    nearest = minimum_filter(nearest, 3, mode="nearest")
    known = np.isfinite(nearest)
    from_where = distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = minimum_filter(nearest[tuple(from_where)], 2 * AROUND + 1, mode="nearest")
    return np.where(known, SHARE * nearest, UNKNOWN_SHARE * filled).astype(np.float32)


def floaters(
    values: NDArray[np.float32],
    lens: Lens,
    free: NDArray[np.float32],
    *,
    rows: NDArray[np.int64] | None = None,
) -> NDArray[np.bool_]:
    """(M,) which of ``rows`` (None: all) have their centres in the ``free`` space of a camera.

    Beside the picture its outermost cells hold.
    """
    if rows is None:
        rows = np.arange(len(values))
    out = np.empty(len(rows), np.bool_)
    scale = CELLS / max(lens.width, lens.height)
    in_threads(
        _find_floaters, len(rows), rows, values[:, :LOG_SCALE], lens.numbers, scale, free, out
    )
    return out


@compiled()
def _find_floaters(first, last, rows, positions, camera, scale, free, out):
    bottom, right = free.shape[0] - 1, free.shape[1] - 1
    c = camera
    for j in range(first, last):
        p = positions[rows[j]]
        z = c[6] * p[0] + c[7] * p[1] + c[8] * p[2] + c[11]
        if z <= 0:
            out[j] = False
            continue
        x = (c[0] * p[0] + c[1] * p[1] + c[2] * p[2] + c[9]) / z * c[12] + c[14]
        y = (c[3] * p[0] + c[4] * p[1] + c[5] * p[2] + c[10]) / z * c[13] + c[15]
        column = int(min(max(x * scale, 0.0), right))
        row = int(min(max(y * scale, 0.0), bottom))
        out[j] = z < free[row, column]
