"""The Gaussians of a fit: where they are added and removed, and random parts of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.project_kernels import LOG_SCALE, LOGIT, QUATERNION, VALUES
from gvtools.poses.views import FitView

# Gaussians of a smaller opacity are removed.
FAINTEST = 0.005
# When a Gaussian is split, the halves' standard deviations are its own divided by this.
SHRINK = 1.6
# Below this share, leaving Gaussians out changes nothing that matters.
NEGLIGIBLE = 0.01
# Opacities that are raised stay below this.
MOST_OPAQUE = 0.995


class Population:
    """The Gaussians of a fit, with the state that the optimiser keeps for each.

    Attributes:
        values: (N, VALUES) float32 parameters.
        moments: (2, N, VALUES) float32, Adam's running means.
        footprint: (N,) float32 width of a pixel where it lies, scene units.
        pull: (N,) sum over pictures of the length of the loss's gradient by the projected centre.
        pulls: (N,) number of pictures in that sum.
    """

    def __init__(self, values: NDArray[np.float32], footprint: NDArray[np.float32]) -> None:
        self.values, self.footprint = values, footprint
        self.moments = np.zeros((2, *values.shape), np.float32)
        self._forget_pulls()

    def __len__(self) -> int:
        return len(self.values)

    def _forget_pulls(self) -> None:
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
    """Some rows of the parameters; their opacities are raised for those that are missing.

    Attributes:
        values: (M, VALUES) rows that are left; the given array where none is left out.
    """

    def __init__(
        self, values: NDArray[np.float32], left_out: float, *, rng: np.random.Generator
    ) -> None:
        """Draw rows.

        Args:
            values: (N, VALUES).
            left_out: share of the rows that is left out, 0 to below 1.
        """
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
        """Numbers of the given rows for those of ``values``.

        Args:
            seen: (K,) numbers of rows of ``values``.
            gradients: (K, at least VALUES) by their parameters; changed to those by the given ones.
        """
        if self._rows is None:
            return seen
        gradients[:, LOGIT] *= self._slope[seen]
        return self._rows[seen]
