"""What can be chosen about stereo, and in which ranges."""

from __future__ import annotations

from dataclasses import dataclass

from gvtools.errors import OptionError
from gvtools.options import check_range

BACKENDS = ("cpu", "torch")
DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True, kw_only=True)
class StereoOptions:
    """How depth is computed from photographs.

    Attributes:
        sources: source views of a reference view, at most 8.
        best: how many of the sources, the best at each pixel, make the photometric cost; the others
            may be occluded there. More than there are means all.
        max_side: longer side of the pictures that are compared, pixels; larger ones are reduced.
        planes: inverse-depth hypotheses of the coarsest level; None takes as many as the largest
            baseline resolves, one per pixel of disparity.
        levels: of the pyramid, each half the size of the one below.
        window: side of the compared window, pixels of its level, odd.
        iterations: rounds of propagation on each level finer than the coarsest.
        noise: standard deviation of the pictures' noise, 0 to 1 for black to white; where nothing
            but shading is left below two thirds of it, or below a quarter more than the blankest
            parts of the picture have, there is no texture.
        views: source views whose own depth must confirm a pixel's, at most ``sources``; where a
            view has fewer sources than this, none of its depth is kept.
        tolerance: relative depth difference up to which another view confirms.
        cost: highest photometric cost that is kept, 0 for a perfect match to 1 for none.
        align: adjust the poses to the pictures first; None does so for scenes without sparse
            points, whose poses come from a tracker or a sensor, not from a bundle adjustment.
        trim: take back depth that windows carried past the outlines of the picture; see
            gvtools.depth.stereo.silhouettes.
        regrow: how far depth is then continued, where colour and depth run on, into pixels that
            match but that no other view confirms, pixels of the finest level; 0 for not at all.
        speckle: smallest connected patch of depth that is kept, pixels of the finest level.
        backend: "cpu" (compiled) or "torch" (the reference that defines the result, on ``device``).
        device: where "torch" computes: "cpu", "cuda", or "auto" for CUDA where there is one.
    """

    sources: int = 4
    best: int = 2
    max_side: int = 640
    planes: int | None = None
    levels: int = 3
    window: int = 7
    iterations: int = 1
    noise: float = 0.003
    views: int = 1
    tolerance: float = 0.03
    cost: float = 0.6
    align: bool | None = None
    trim: bool = True
    regrow: int = 20
    speckle: int = 100
    backend: str = "cpu"
    device: str = "auto"

    def __post_init__(self) -> None:
        check_range("stereo.sources", self.sources, least=1, most=8)
        check_range("stereo.best", self.best, least=1, most=8)
        check_range("stereo.max_side", self.max_side, least=64)
        check_range("stereo.planes", self.planes, least=8, most=512)
        check_range("stereo.levels", self.levels, least=1, most=6)
        check_range("stereo.window", self.window, least=3, most=15)
        check_range("stereo.iterations", self.iterations, least=0)
        check_range("stereo.noise", self.noise, above=0, most=1)
        check_range("stereo.views", self.views, least=0, most=8)
        check_range("stereo.tolerance", self.tolerance, above=0, below=1)
        check_range("stereo.cost", self.cost, above=0, most=1)
        check_range("stereo.regrow", self.regrow, least=0)
        check_range("stereo.speckle", self.speckle, least=0)
        if self.views > self.sources:
            raise OptionError(
                f"stereo.views {self.views} is more than stereo.sources {self.sources}; expected "
                "as many sources as views that must confirm; lower the one or raise the other"
            )
        if self.window % 2 == 0:
            raise OptionError(f"stereo.window {self.window}; expected an odd number")
        for name, value, known in (
            ("backend", self.backend, BACKENDS),
            ("device", self.device, DEVICES),
        ):
            if value not in known:
                raise OptionError(f"stereo {name} {value!r}; expected one of {', '.join(known)}")
