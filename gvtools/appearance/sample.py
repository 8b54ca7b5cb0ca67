"""A random part of the Gaussians, which stands for all of them in one step of a fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.project_kernels import LOGIT

# Below this share, leaving Gaussians out changes nothing that matters.
NEGLIGIBLE = 0.01
# Opacities that are raised stay below this.
MOST_OPAQUE = 0.995


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
            rng: draws them.
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
