"""The Gaussians of a fit: at the start, where they are added and removed, random parts of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import LOG_SCALE, LOGIT, QUATERNION, VALUES
from gvtools.errors import DegenerateError
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.poses.refinement import FitView

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

    ``positions`` (N, 3) in ``frame``, at least two different ones; ``most`` limits their number, by
    default to about STARTING_GAUSSIANS.
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
    """Gaussians at randomly picked pixels with depth; ``most`` as for ``from_points``."""
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
    """Randomly picked pixels with depth, lifted: positions in the local frame, and colours.

    Views without depth are skipped; the others contribute equal shares of ``count``.
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
    from gvtools.o3d import o3d

    points = o3d.core.Tensor(np.ascontiguousarray(positions - positions.mean(axis=0)))
    search = o3d.core.nns.NearestNeighborSearch(points)
    search.knn_index()
    _, squared = search.knn_search(points, NEIGHBOURS + 1)
    sizes = np.sqrt(squared.numpy()[:, 1:].mean(axis=1))
    positive = sizes[sizes > 0]
    least = float(positive.min()) if positive.size else 1.0
    return np.clip(sizes, least, np.quantile(sizes, LARGEST))


# Gaussians of a smaller opacity are removed.
FAINTEST = 0.005
# When a Gaussian is split, the halves' standard deviations are its own divided by this.
SHRINK = 1.6
# Below this share, leaving Gaussians out changes nothing that matters.
NEGLIGIBLE = 0.01
# Opacities that are raised stay below this.
MOST_OPAQUE = 0.995


class Population:
    """The Gaussians of a fit, with the state that the optimiser keeps for each."""

    def __init__(self, values: NDArray[np.float32], footprint: NDArray[np.float32]) -> None:
        # (N, VALUES), and (N,) width of a pixel where each lies, scene units.
        self.values, self.footprint = values, footprint
        # Adam's running means.
        self.moments = np.zeros((2, *values.shape), np.float32)
        self._forget_pulls()

    def __len__(self) -> int:
        return len(self.values)

    def _forget_pulls(self) -> None:
        # (N,) sums over pictures of the length of the loss's gradient by the projected centre, and
        # numbers of pictures in them.
        self.pull, self.pulls = np.zeros(len(self)), np.zeros(len(self))

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Remove all other rows."""
        self.values, self.footprint = self.values[rows], self.footprint[rows]
        self.moments = np.ascontiguousarray(self.moments[:, rows])
        self._forget_pulls()

    def add(self, values: NDArray[np.float32], footprint: NDArray[np.float32]) -> None:
        """Append Gaussians."""
        self.values = np.concatenate([self.values, values])
        self.footprint = np.concatenate([self.footprint, footprint])
        fresh = np.zeros((2, len(values), VALUES), np.float32)
        self.moments = np.concatenate([self.moments, fresh], axis=1)
        self._forget_pulls()

    def remove_faint(self) -> None:
        """Remove Gaussians of an opacity below FAINTEST."""
        self.keep(self.values[:, LOGIT] >= np.log(FAINTEST / (1 - FAINTEST)))

    def fade(self, share: float, rows: Any = slice(None)) -> None:
        """Reduce all opacities, or those of some rows, by a share of themselves."""
        opacity = (1 - share) / (1 + np.exp(-self.values[rows, LOGIT]))
        self.values[rows, LOGIT] = np.log(opacity / (1 - opacity))

    def grow(self, threshold: float, most: int, *, wide: float, rng: np.random.Generator) -> None:
        """Split or clone the Gaussians with the largest gradients: they cover too much detail.

        Args:
            threshold: least mean gradient by the projected centre, half a picture being 1.
            most: number of Gaussians that there may be afterwards.
            wide: standard deviation in pixels from which a Gaussian is split into two smaller ones;
                a smaller Gaussian is cloned, and the next steps move the two apart.
        """
        pull = self.pull / np.maximum(self.pulls, 1)
        rows = np.flatnonzero(pull > threshold)
        room = max(most - len(self), 0)
        if len(rows) > room:
            rows = np.sort(rows[np.argsort(-pull[rows], kind="stable")[:room]])
        spread = np.exp(self.values[rows, LOG_SCALE:QUATERNION].max(axis=1))
        split = rows[spread > wide * self.footprint[rows]]
        twins = rows[spread <= wide * self.footprint[rows]]
        halves = np.repeat(self.values[split], 2, axis=0)
        offset = rng.standard_normal((len(halves), 3)) * np.exp(halves[:, LOG_SCALE:QUATERNION])
        turn = rotations(halves[:, QUATERNION:LOGIT])
        halves[:, :LOG_SCALE] += np.einsum("nij,nj->ni", turn, offset).astype(np.float32)
        halves[:, LOG_SCALE:QUATERNION] -= np.float32(np.log(SHRINK))
        kept = np.ones(len(self), bool)
        kept[split] = False
        footprint = self.footprint
        new = np.concatenate([self.values[twins], halves])
        self.keep(kept)
        self.add(new, np.concatenate([footprint[twins], np.repeat(footprint[split], 2)]))


def rotations(quaternions: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 3, 3) matrices of quaternions w, x, y, z of any length."""
    import torch
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    q = torch.from_numpy(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
    return quaternion_to_rotation_matrix(q).numpy()


def pixel_width(positions: NDArray[np.float32], views: Sequence[FitView]) -> NDArray[np.float32]:
    """(N,) width of a pixel at each position in the nearest view that sees it, scene units.

    What no view sees gets the median of the others.
    """
    width = np.full(len(positions), np.inf)
    for view in views:
        points = positions @ view.cam_from_local[:3, :3].T + view.cam_from_local[:3, 3]
        z, size = points[:, 2], np.array(view.rgb.shape[1::-1])
        ahead = z > 0
        focal = np.array([view.K[0, 0], view.K[1, 1]])
        xy = points[:, :2] / np.where(ahead, z, 1)[:, None] * focal + view.K[:2, 2]
        inside = ahead & (xy > -0.3 * size).all(axis=1) & (xy < 1.3 * size).all(axis=1)
        width[inside] = np.minimum(width[inside], z[inside] / focal[0])
    seen = np.isfinite(width)
    width[~seen] = np.median(width[seen]) if seen.any() else 1.0
    return width.astype(np.float32)


class Sample:
    """Some rows of the parameters; their opacities are raised for those that are missing."""

    def __init__(
        self, values: NDArray[np.float32], left_out: float, *, rng: np.random.Generator
    ) -> None:
        """Draw rows of ``values`` (N, VALUES) without a share ``left_out``, 0 to below 1."""
        # (M, VALUES) rows that are left; the given array where none is left out.
        self.values, self._rows = values, None
        if left_out < NEGLIGIBLE:
            return
        self._rows = np.flatnonzero(rng.random(len(values)) >= left_out)
        self.values = values[self._rows]
        opacity = 1 / (1 + np.exp(-self.values[:, LOGIT]))
        raised = np.minimum(opacity / (1 - left_out), MOST_OPAQUE)
        self.values[:, LOGIT] = np.log(raised / (1 - raised))
        # d raised / d logit, over that by the raised opacity's own logit.
        self._slope = opacity * (1 - opacity) / (1 - left_out) / (raised * (1 - raised))
        self._slope[raised >= MOST_OPAQUE] = 0

    def back(self, seen: NDArray[np.int64], gradients: NDArray[np.float32]) -> NDArray[np.int64]:
        """Numbers of the given rows for ``seen`` (K,) ones of ``values``.

        ``gradients`` (K, at least VALUES) by their parameters are changed to those by the given
        ones.
        """
        if self._rows is None:
            return seen
        gradients[:, LOGIT] *= self._slope[seen]
        return self._rows[seen]
