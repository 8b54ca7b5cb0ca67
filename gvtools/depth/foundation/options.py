"""Settings of Depth Anything 3 as a depth source; light, so that a configuration can hold them."""

from __future__ import annotations

from dataclasses import dataclass

from gvtools.errors import OptionError
from gvtools.options import check_range


@dataclass(frozen=True, kw_only=True)
class FoundationOptions:
    """How Depth Anything 3 is run.

    Attributes:
        weights: folder with ``model.safetensors`` of DA3-SMALL or DA3-BASE, or a GeoVerse folder.
        longest: longer side of the network's pictures, px; rounded to its patch. 504 is what the
            released models are used with.
        views: most views a pass; memory grows with its square.
        cameras: the known cameras go into the network. Without them every pass has a unit of its
            own, and each needs its own support for a scale.
        min_confidence: pixels below this, of 1 - 1 / (the head's confidence), are left empty.
        device: "auto", "cpu" or "cuda".
    """

    weights: str | None = None
    longest: int = 504
    views: int = 8
    cameras: bool = True
    min_confidence: float = 0.2
    device: str = "auto"

    def __post_init__(self) -> None:
        check_range("da3.longest", self.longest, least=28)
        check_range("da3.views", self.views, least=1)
        check_range("da3.min_confidence", self.min_confidence, least=0, below=1)
        if self.device not in ("auto", "cpu", "cuda"):
            raise OptionError(f"da3.device = {self.device!r}; expected auto, cpu or cuda")
