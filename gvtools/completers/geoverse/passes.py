"""What a pass of the model hands from one stage to the next."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gvtools.completers.geoverse.conditioning import Hints, ViewBatch
from gvtools.completers.geoverse.denoiser import Conditions, Positions
from gvtools.completers.geoverse.shared_attention import VideoKeys
from gvtools.completers.geoverse.video_prior.prior import VideoFeatures
from gvtools.errors import ShapeError
from gvtools.networks.depth_anything.geometry_head import Geometry


@dataclass(frozen=True)
class Prepared:
    """What stays constant over the denoising steps of a pass.

    Attributes:
        batch: the views, holes filled where the configuration says so.
        hints: features of context and projections.
        level1: conditions of the level-1 denoiser.
        positions: its projective transforms.
        adapted: video features at the control branch's width.
        video: video features, where keys have to be made of them again for other cameras.
        keys: their keys and values for the coupled blocks.
    """

    batch: ViewBatch
    hints: Hints
    level1: Conditions
    positions: Positions
    adapted: list[Tensor] | None = None
    video: VideoFeatures | None = None
    keys: dict[int, VideoKeys] | None = None


@dataclass(frozen=True)
class Decoded:
    """Pictures and geometry of generated features.

    Attributes:
        rgb: (B, T, 3, H, W) of the target views, not clipped to [0, 1].
        depth: (B, T, H, W) z-depth of the target views, in the model's unit.
        depth_confidence: (B, T, H, W) > 1.
        all_views: the geometry of all V views; None where the targets' depth alone was decoded.
    """

    rgb: Tensor
    depth: Tensor
    depth_confidence: Tensor
    all_views: Geometry | None = None

    @property
    def geometry(self) -> Geometry:
        """Of all V views, in the frame of the first view."""
        if self.all_views is None:
            raise ShapeError("the targets' depth alone was decoded, not the geometry of all views")
        return self.all_views


@dataclass(frozen=True)
class Generated:
    """The result of a pass.

    Attributes:
        level1: (B, V, C, h, w) normalised latents.
        level0: (B, V, C, h, w) normalised latents.
        decoded: pictures and geometry.
        hint: of the filled projections' own features; None where nothing is composed of it.
    """

    level1: Tensor
    level0: Tensor
    decoded: Decoded
    hint: Decoded | None = None
