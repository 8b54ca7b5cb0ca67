"""Guidance: the memory projected into target cameras, the hint that completers receive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvtools import cameras as camera_batches
from gvtools.cameras import Cameras
from gvtools.errors import ShapeError

# The fields of Guidance that hold a value for each pixel, in order.
IMAGES = ("rgb", "depth", "valid", "confidence", "generated", "scanned")


@dataclass(frozen=True, eq=False)
class Guidance:
    """Memory projected into V cameras of one image size."""

    cameras: Cameras
    rgb: NDArray[np.float32]  # (V, H, W, 3) in [0, 1]; 0 where not valid
    depth: NDArray[np.float32]  # (V, H, W) z-depth, scene units; 0 where not valid
    valid: NDArray[np.bool_]  # (V, H, W) where memory supports the pixel
    confidence: NDArray[np.float32]  # (V, H, W) >= 0; 0 where not valid
    generated: NDArray[np.bool_]  # (V, H, W) where the support is generated content
    # (V, H, W) where it is a scan's alone, which no photograph saw; None is nowhere.
    scanned: NDArray[np.bool_] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.scanned is None:
            object.__setattr__(self, "scanned", np.zeros_like(self.valid))

    def __len__(self) -> int:
        return len(self.rgb)

    def __getitem__(self, index: int) -> Guidance:
        """One view, as a batch of one."""
        return self.select([index])

    def select(self, index: Sequence[int] | slice) -> Guidance:
        """Some views, in that order; a slice copies no image."""
        rows = index if isinstance(index, slice) else list(index)
        return Guidance(self.cameras[rows], *(getattr(self, name)[rows] for name in IMAGES))

    def blank(self) -> Guidance:
        """The same cameras, and a memory that knows nothing."""
        return Guidance(self.cameras, *(np.zeros_like(getattr(self, name)) for name in IMAGES))

    @property
    def coverage(self) -> float:
        """The share of pixels that memory supports."""
        return float(self.valid.mean()) if self.valid.size else 0.0


def concatenate(views: Sequence[Guidance]) -> Guidance:
    """Several guidances of one picture size as one batch, in their order."""
    sizes = sorted({guidance.valid.shape[1:] for guidance in views})
    if len(sizes) != 1:
        raise ShapeError(f"guidance of {len(sizes)} picture sizes {sizes}; expected one")
    return Guidance(
        camera_batches.concatenate([guidance.cameras for guidance in views]),
        *(np.concatenate([getattr(guidance, name) for guidance in views]) for name in IMAGES),
    )
