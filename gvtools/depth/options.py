"""Options of computed depth: the plane sweep and Depth Anything 3."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from gvtools.errors import OptionError
from gvtools.networks import Precision
from gvtools.settings import Settings


class StereoOptions(Settings):
    """How depth is computed from photographs."""

    section = "stereo"

    sources: int = Field(4, ge=1, le=8)
    """Source views of a reference view."""
    best: int = Field(2, ge=1, le=8)
    """How many of the sources, the best at each pixel, make the photometric cost; the others may be
    occluded there. More than there are means all."""
    max_side: int = Field(640, ge=64)
    """Longer side of the pictures that are compared; larger ones are reduced. [px]"""
    planes: int | None = Field(None, ge=8, le=512)
    """Inverse-depth hypotheses of the coarsest level; none takes as many as the largest baseline
    resolves, one per pixel of disparity."""
    levels: int = Field(3, ge=1, le=6)
    """Levels of the pyramid, each half the size of the one below."""
    window: int = Field(7, ge=3, le=15)
    """Side of the compared window on each level, odd. [px]"""
    iterations: int = Field(1, ge=0)
    """Rounds of propagation on each level finer than the coarsest."""
    noise: float = Field(0.003, gt=0, le=1)
    """Standard deviation of the pictures' noise, 0 to 1 for black to white; where nothing but
    shading is left below two thirds of it, or below a quarter more than the blankest parts of the
    picture have, there is no texture."""
    views: int = Field(1, ge=0, le=8)
    """Source views whose own depth must confirm a pixel's, at most ``sources``; where a view has
    fewer sources than this, none of its depth is kept."""
    tolerance: float = Field(0.03, gt=0, lt=1)
    """Relative depth difference up to which another view confirms."""
    cost: float = Field(0.6, gt=0, le=1)
    """Highest photometric cost that is kept, 0 for a perfect match to 1 for none."""
    align: bool | None = None
    """Adjust the poses to the pictures first; none does so for scenes without sparse points, whose
    poses come from a tracker or a sensor, not from a bundle adjustment."""
    trim: bool = True
    """Take back depth that windows carried past the outlines of the picture; see
    gvtools.depth.stereo.filtering."""
    regrow: int = Field(20, ge=0)
    """How far depth is then continued, where colour and depth run on, into pixels of the finest
    level that match but that no other view confirms; 0 for not at all. [px]"""
    speckle: int = Field(100, ge=0)
    """Smallest connected patch of depth that is kept, on the finest level. [px]"""
    backend: Literal["cpu", "torch"] = "cpu"
    """Compiled ("cpu") or the reference that defines the result ("torch", on ``device``)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where "torch" computes; "auto" takes CUDA where there is one."""

    @model_validator(mode="after")
    def _check(self) -> StereoOptions:
        if self.views > self.sources:
            raise OptionError(
                f"stereo.views {self.views} is more than stereo.sources {self.sources}; expected "
                "as many sources as views that must confirm; lower the one or raise the other"
            )
        if self.window % 2 == 0:
            raise OptionError(f"stereo.window {self.window}; expected an odd number")
        return self


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
    min_centres: int = Field(4, ge=2)
    """A pass whose scale rests on camera centres alone needs so many; 2 are the fewest that have a
    scale (the paper), and any two fit."""
    min_confidence: float = Field(0.2, ge=0, lt=1)
    """Pixels below this, of 1 - 1 / (the head's confidence), are left empty."""
    precision: Precision = "auto"
    """``auto`` is float32 on a CPU and bfloat16 on a GPU, float16 before compute capability 8.0.
    The geometry head is float32 everywhere."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the network runs; "auto" takes CUDA where there is one."""
