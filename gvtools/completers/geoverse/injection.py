"""Video features on their way to the denoiser, as keys of the shared attention."""

from __future__ import annotations

from gvtools.completers.geoverse.denoiser import DenoiserConfig
from gvtools.completers.geoverse.plucker import CameraCondition
from gvtools.completers.geoverse.projective import Projective
from gvtools.completers.geoverse.shared_attention import SharedAttention, VideoKeys
from gvtools.completers.geoverse.video_prior.prior import VideoFeatures


def video_keys(
    shared: SharedAttention | None,
    denoiser: DenoiserConfig,
    camera: CameraCondition,
    *,
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
            grid=(level.shape[-2], level.shape[-1]),
            head_dim=denoiser.width // denoiser.heads,
            position_scale=(grid[0] / level.shape[-2], grid[1] / level.shape[-1]),
            invert_K=denoiser.invert_K,
        )
        for level in features.tensors
    ]
    return shared(features.tensors, positions)
