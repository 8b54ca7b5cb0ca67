"""Video features on their way to the denoiser: checked, and as keys of the shared attention."""

from __future__ import annotations

from gvtools.completers.geoverse.denoiser import DenoiserConfig
from gvtools.completers.geoverse.plucker import CameraCondition
from gvtools.completers.geoverse.projective import Projective
from gvtools.completers.geoverse.shared_attention import SharedAttention, VideoKeys
from gvtools.completers.geoverse.video_prior.config import VideoPriorConfig
from gvtools.completers.geoverse.video_prior.prior import VideoFeatures
from gvtools.errors import OptionError, ShapeError


def check_features(
    features: VideoFeatures, config: VideoPriorConfig | None, views: tuple[int, ...]
) -> None:
    """Features of the right views, taps and channels.

    Args:
        features: to be injected.
        config: of the model's video prior.
        views: (B, V).

    Raises:
        OptionError: the model has no video prior.
        ShapeError: features of other views, channels or taps.
    """
    if config is None:
        raise OptionError(
            "video features for a GeoVerse without a video prior; expected none, or a "
            "configuration with injection = 'control' or 'shared'"
        )
    shapes = [tuple(level.shape) for level in features.tensors]
    wanted = (*views, config.channels)
    if len(shapes) != len(config.taps) or any(shape[:3] != wanted for shape in shapes):
        raise ShapeError(
            f"video features {shapes}; expected {len(config.taps)} of {wanted} and a grid"
        )


def video_keys(
    shared: SharedAttention | None,
    denoiser: DenoiserConfig,
    camera: CameraCondition,
    features: VideoFeatures,
    grid: tuple[int, int],
) -> dict[int, VideoKeys] | None:
    """Keys and values of the coupled blocks, positioned by the given cameras.

    Args:
        shared: projects the features; None for a model without shared attention.
        denoiser: whose blocks are coupled.
        camera: of the views.
        features: one (B, V, C, h', w') a coupled block.
        grid: (h, w) of the latents, in whose units the positions are.
    """
    if shared is None:
        return None
    positions = [
        Projective(
            camera.cam_from_world,
            camera.K,
            camera.size,
            (level.shape[-2], level.shape[-1]),
            denoiser.width // denoiser.heads,
            position_scale=(grid[0] / level.shape[-2], grid[1] / level.shape[-1]),
            invert_K=denoiser.invert_K,
        )
        for level in features.tensors
    ]
    return shared(features.tensors, positions)
