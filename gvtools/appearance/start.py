"""The Gaussians that a fit begins with, at sparse points or at pixels with depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.gaussians import Gaussians
from gvtools.errors import DegenerateError
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.poses.views import FitView

# Points are thinned to fewer than twice as many: few Gaussians are fitted faster, and the fit adds
# more where they are needed.
STARTING_GAUSSIANS = 25_000
# Least red, green and blue (of 255) that a Gaussian begins with: colours are clipped at 0, where
# their gradient is 0, too.
DARKEST = 8
# A Gaussian is as wide as its NEIGHBOURS nearest neighbours are away, at most this quantile of all.
NEIGHBOURS, LARGEST = 3, 0.99


def from_points(
    positions: NDArray[np.float64],
    colors: NDArray[np.uint8],
    *,
    frame: LocalFrame,
    most: int | None = None,
) -> Gaussians:
    """Gaussians at coloured points, as wide as the points lie apart.

    Args:
        positions: (N, 3) in ``frame``, scene units, at least two different ones.
        colors: (N, 3) uint8.
        most: limit of their number; None: about STARTING_GAUSSIANS.
    """
    every = max(1, len(positions) // STARTING_GAUSSIANS)
    if most is not None:
        every = max(every, -(-len(positions) // most))
    rows = slice(None, None, every)
    positions, colors = positions[rows], np.maximum(colors[rows], DARKEST)
    return Gaussians.at(positions, colors, sizes=_sizes(positions), frame=frame)


def from_depth(
    views: Sequence[FitView], *, frame: LocalFrame, seed: int, most: int | None = None
) -> Gaussians:
    """Gaussians at randomly picked pixels with depth.

    Args:
        views: those without depth are skipped.
        most: as for ``from_points``.
    """
    count = STARTING_GAUSSIANS if most is None else min(most, STARTING_GAUSSIANS)
    positions, colors = pixels_with_depth(views, seed=seed, count=count)
    if len(positions) <= NEIGHBOURS:
        raise DegenerateError(
            f"{len(positions)} pixels with depth in {len(views)} views; expected more"
        )
    return from_points(positions, colors, frame=frame, most=most)


def pixels_with_depth(
    views: Sequence[FitView], *, seed: int, count: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Randomly picked pixels with depth, lifted to 3D.

    Args:
        views: those without depth are skipped; the others contribute equal shares of ``count``.

    Returns:
        (N, 3) float64 positions in the local frame, and (N, 3) uint8 colours.
    """
    rng = np.random.default_rng(seed)
    share = max(count // max(sum(view.depth is not None for view in views), 1), 1)
    positions, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for view in views:
        if view.depth is None:
            continue
        usable = view.depth > 0 if view.mask is None else (view.depth > 0) & view.mask
        row, column = np.nonzero(usable)
        picked = rng.permutation(len(row))[:share]
        row, column = row[picked], column[picked]
        rays = np.stack([column + 0.5, row + 0.5, np.ones(len(row))]).T @ np.linalg.inv(view.K).T
        points = rays * view.depth[row, column, None]
        pose = view.cam_from_local
        positions.append((points - pose[:3, 3]) @ pose[:3, :3])
        colors.append(view.rgb[row, column])
    return np.concatenate(positions), np.concatenate(colors)


def _sizes(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) root mean squared distance to the nearest neighbours, scene units."""
    import open3d as o3d

    points = o3d.core.Tensor(np.ascontiguousarray(positions - positions.mean(axis=0)))
    search = o3d.core.nns.NearestNeighborSearch(points)
    search.knn_index()
    _, squared = search.knn_search(points, NEIGHBOURS + 1)
    sizes = np.sqrt(squared.numpy()[:, 1:].mean(axis=1))
    positive = sizes[sizes > 0]
    least = float(positive.min()) if positive.size else 1.0
    return np.clip(sizes, least, np.quantile(sizes, LARGEST))
