"""The outcome of bringing generated depth into scene units, with its figures."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from gvtools.similarity import ScaleFit


class ScaleStatus(str, Enum):
    """How a view's generated depth was brought into scene units, or why it was refused."""

    MEMORY_DEPTH = "memory_depth"
    """One factor, fitted to the memory's depth on the pixels that both know."""
    MEMORY_FIELD = "memory_field"
    """A smooth field of factors, fitted to the memory's depth."""
    MEMORY_SURFACES = "memory_surfaces"
    """No factor needed: the memory's surfaces, in scene units, were continued into the holes."""
    CONTEXT_DEPTH = "context_depth"
    """One factor, fitted to the depth of the context views."""
    CAMERA_CENTRES = "camera_centres"
    """One factor, fitted between predicted and given camera centres."""
    NOTHING_TO_COMPLETE = "nothing_to_complete"
    """The view has no hole."""
    UNSUPPORTED = "unsupported"
    """Refused: too few pixels or camera centres to fit a factor."""
    CONTRADICTED = "contradicted"
    """Refused: the depth differs from known depth by more than a factor."""

    @property
    def accepted(self) -> bool:
        """Whether the view's generated depth may be fused."""
        return self not in (ScaleStatus.UNSUPPORTED, ScaleStatus.CONTRADICTED)


_IN_WORDS = {
    ScaleStatus.MEMORY_DEPTH: "one factor to the memory's depth",
    ScaleStatus.MEMORY_FIELD: "a smooth field of factors to the memory's depth",
    ScaleStatus.MEMORY_SURFACES: "the memory's own surfaces, continued",
    ScaleStatus.CONTEXT_DEPTH: "the depth of the context views",
    ScaleStatus.CAMERA_CENTRES: "the camera centres",
    ScaleStatus.NOTHING_TO_COMPLETE: "nothing to complete",
    ScaleStatus.UNSUPPORTED: "refused: too little to find a scale from",
    ScaleStatus.CONTRADICTED: "refused: known depth contradicts it",
}


@dataclass(frozen=True)
class ScaleAlignment:
    """The outcome of bringing one view's generated depth into scene units.

    Attributes:
        status: see ``ScaleStatus``.
        scale: multiply the completion's depth by this to get scene units; 1 if the completer's
            depth is in scene units already, NaN if refused.
        residual: median relative deviation from the memory's depth (0.01 = 1 %); NaN if unknown.
        overlap_px: pixels with both depths; 0 also where they were not counted.
        inlier_share: weighted share of these within the fit's tolerance, 0 to 1; NaN if unknown.
        centres: number of camera centres in the fit; 0 if none were used.
        correlation: between predicted and given camera centres, -1 to 1; NaN if unknown.
    """

    status: ScaleStatus
    scale: float = 1.0
    residual: float = float("nan")
    overlap_px: int = 0
    inlier_share: float = float("nan")
    centres: int = 0
    correlation: float = float("nan")

    @classmethod
    def of_fit(cls, fit: ScaleFit) -> ScaleAlignment:
        """The outcome of comparing a completion's depth with the memory's."""
        status = ScaleStatus.MEMORY_DEPTH
        if not fit.ok:
            compared = np.isfinite(fit.residual)
            status = ScaleStatus.CONTRADICTED if compared else ScaleStatus.UNSUPPORTED
        return cls(status, fit.scale, fit.residual, fit.support, fit.inlier_share)

    @property
    def accepted(self) -> bool:
        """Whether the depth may be fused."""
        return self.status.accepted

    def describe(self) -> str:
        """One line with the figures that are known."""
        figures = [f"{self.overlap_px} common pixels"]
        if np.isfinite(self.residual):
            figures.append(f"median deviation {self.residual:.1%}")
        if self.centres:
            figures.append(f"{self.centres} camera centres")
        if np.isfinite(self.correlation):
            figures.append(f"correlation {self.correlation:.2f}")
        return f"{_IN_WORDS[self.status]} ({', '.join(figures)})"

    def to_json(self) -> dict[str, Any]:
        """As a round's report holds it."""
        return {
            "status": self.status.value,
            "accepted": self.accepted,
            "description": self.describe(),
            "scale": self.scale,
            "residual": self.residual,
            "overlap_px": self.overlap_px,
            "inlier_share": self.inlier_share,
            "centres": self.centres,
            "correlation": self.correlation,
        }
