"""The similarity from a scan's frame to the photographs' world, given or estimated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.scenes.calibration import load_matrix

ESTIMATE, IDENTITY = "estimate", "identity"
FORMS = (
    f"{ESTIMATE}, {IDENTITY}, a text file with a 3x4 or 4x4 matrix, or its 12 or 16 numbers row by "
    "row with commas between"
)
# Tolerance of RᵀR = I for a given rotation R.
ORTHONORMAL = 1e-3


@dataclass(frozen=True, eq=False)
class Placement:
    """A similarity, and how well it is supported.

    Attributes:
        world_from_scan: (4, 4) float64, scale times rotation, and translation, for the file's
            coordinates.
        how: "given", "as it is" (an estimate that left the scan where it was) or "estimated".
        fitness: share of the photographs' points that have a point of the scan within
            ``tolerance``; None for a given placement, like the next ones.
        scan_fitness: share of the scan's points that have one of the photographs'.
        rmse: of the distances within ``tolerance``, scene units.
        tolerance: scene units.
    """

    world_from_scan: NDArray[np.float64]
    how: str
    fitness: float | None = None
    scan_fitness: float | None = None
    rmse: float | None = None
    tolerance: float | None = None

    @property
    def scale(self) -> float:
        """Scene units per unit of the scan."""
        return float(np.cbrt(np.linalg.det(self.world_from_scan[:3, :3])))

    def apply(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) points of the file's frame in the world."""
        return positions @ self.world_from_scan[:3, :3].T + self.world_from_scan[:3, 3]

    def summary(self) -> str:
        """A line of text for the user."""
        text = f"{self.how}, scale {self.scale:.6g}"
        if self.fitness is None:
            return text
        return (
            f"{text}, fitness {self.fitness:.2f} of the photographs' and {self.scan_fitness:.2f} "
            f"of the scan's points within {self.tolerance:.3g} (rmse {self.rmse:.2g})"
        )

    def to_json(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "world_from_scan": self.world_from_scan.tolist(),
            "how": self.how,
            "scale": self.scale,
            "fitness": self.fitness,
            "scan_fitness": self.scan_fitness,
            "rmse": self.rmse,
            "tolerance": self.tolerance,
        }


def given_placement(text: str) -> Placement | None:
    """The placement that a text gives, see FORMS; None for "estimate".

    >>> round(given_placement("2,0,0,5, 0,2,0,0, 0,0,2,0").scale, 6)
    2.0
    >>> given_placement("1,0,0,5, 0,1,0,0, 0,0,-1,0")
    Traceback (most recent call last):
        ...
    gvtools.errors.OptionError: scan.placement: a mirror or no similarity; expected scale x rotation
    """
    if text == ESTIMATE:
        return None
    if text == IDENTITY:
        return Placement(np.eye(4), "given")
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        if not Path(text).is_file():
            raise OptionError(f"scan.placement {text!r}; expected {FORMS}") from None
        rows = load_matrix(Path(text), (3, 4), (4, 4))
    else:
        if len(numbers) not in (12, 16):
            raise OptionError(f"scan.placement: {len(numbers)} numbers; expected {FORMS}")
        rows = np.reshape(numbers, (-1, 4))
    matrix = np.vstack([rows[:3], [0, 0, 0, 1]])
    last = rows[3:].ravel()
    scale = np.cbrt(np.linalg.det(matrix[:3, :3])) if np.isfinite(matrix).all() else np.nan
    turn = matrix[:3, :3] / scale if scale > 0 else np.full((3, 3), np.nan)
    whole = not len(last) or np.array_equal(last, [0, 0, 0, 1])
    if not (whole and np.allclose(turn.T @ turn, np.eye(3), atol=ORTHONORMAL)):
        raise OptionError("scan.placement: a mirror or no similarity; expected scale x rotation")
    return Placement(matrix, "given")
