"""The options of the generative core as a completer."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from gvtools.completers.settings import CompleterSettings
from gvtools.networks.precision import Precision


class GeoVerseSettings(CompleterSettings):
    """Options of ``geoverse``; none takes the model's own value."""

    weights: str | None = None
    """Folder of a GeoVerse model, see ``gvtools weights list``; none takes the small model that
    ships."""
    steps: int | None = Field(None, ge=0)
    """Level-1 steps, equally spaced in time before the model's time shift; 0 decodes the features
    of the filled projections."""
    cascade_steps: int | None = Field(None, ge=1)
    """Level-0 steps, likewise."""
    cfg_scale: float | None = Field(None, ge=0)
    """Scale of classifier-free guidance over the cameras, of level 1; 1 does without."""
    cascade_cfg_scale: float | None = Field(None, ge=0)
    """Likewise, of level 0."""
    output: Literal["holes", "views"] = "holes"
    """``holes`` keeps what the memory shows of a view and takes the model's pixels elsewhere;
    ``views`` gives whole views as the model decodes them (the paper)."""
    temperature: float | None = Field(None, ge=0)
    """Standard deviation of the noise that level 1 starts from."""
    context_views: int | None = Field(None, ge=1)
    """Most photographs in a pass."""
    context_selection: Literal["covisible", "nearest"] = "covisible"
    """The photographs of a pass: those that show most of what the targets show, or those that
    stand and look most like them."""
    views: int | None = Field(None, ge=2)
    """Most views in a pass, photographs and targets."""
    alignment: Literal["centres", "hint", "field"] | None = None
    """How decoded depth gets the memory's scale: by camera centres, by one factor to the memory's
    depth, or by a smooth field of factors."""
    color_alignment: Literal["unchanged", "field"] | None = None
    """Whether decoded colours follow the memory's by a smooth field."""
    composition: Literal["decoded", "correction"] | None = None
    """``decoded`` shows the decoding itself where the model corrects filled projections."""
    shared_fill: bool = True
    """Whether targets of a call share what their holes are filled with."""
    image_size: int | None = Field(None, ge=1)
    """Longer side of the pictures in a pass, pixels, rounded to whole patches; the model's own is
    also the most."""
    precision: Precision = "auto"
    """``auto`` is float32 on a CPU and bfloat16 on a GPU, float16 before compute capability 8.0."""
    offload: Literal["auto", "always", "never"] = "auto"
    """Whether the video prior's weights leave the GPU between passes; ``auto`` where they would
    leave too little memory for the rest of a pass."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """``auto`` takes a GPU where there is one."""
