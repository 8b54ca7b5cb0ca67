"""Settings of Depth Anything 3 as a depth source."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from gvtools.networks import Precision
from gvtools.settings import Settings


class FoundationOptions(Settings):
    """How Depth Anything 3 is run."""

    section = "da3"

    weights: str | None = None
    """Folder with ``model.safetensors`` of DA3-SMALL or DA3-BASE, or a GeoVerse folder."""
    longest: int = Field(504, ge=28)
    """Longer side of the network's pictures, rounded to its patch. 504 is what the released models
    are used with. [px]"""
    views: int = Field(8, ge=1)
    """Most views a pass; memory grows with its square."""
    cameras: bool = True
    """The known cameras go into the network. Without them every pass has a unit of its own, and
    each needs its own support for a scale."""
    min_confidence: float = Field(0.2, ge=0, lt=1)
    """Pixels below this, of 1 - 1 / (the head's confidence), are left empty."""
    precision: Precision = "auto"
    """``auto`` is float32 on a CPU and bfloat16 on a GPU, float16 before compute capability 8.0.
    The geometry head is float32 everywhere."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the network runs; "auto" takes CUDA where there is one."""
