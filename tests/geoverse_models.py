"""A GeoVerse of a few hundred thousand random numbers, and views with real cameras for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gvtools.cameras import Cameras, concatenate
from gvtools.completers import ContextView
from gvtools.completers.geoverse.conditioning import HintConfig, ViewBatch
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.control import ControlConfig
from gvtools.completers.geoverse.denoiser import Conditions, Denoiser, DenoiserConfig
from gvtools.completers.geoverse.depth_anything.encoder import EncoderConfig
from gvtools.completers.geoverse.depth_anything.geometry_head import GeometryHeadConfig
from gvtools.completers.geoverse.depth_anything.network import DepthAnythingConfig
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.plucker import CENTRED, camera_condition
from gvtools.completers.geoverse.rgb_head import RGBHeadConfig
from gvtools.completers.geoverse.shared_attention import SharedAttentionConfig
from gvtools.completers.geoverse.video_prior.config import VideoPriorConfig
from gvtools.completers.geoverse.video_prior.prior import VideoFeatures
from gvtools.guidance import Guidance

PATCH = 8
SIZE = (24, 32)  # H, W
GRID = (3, 4)
CHANNELS = 64
VIDEO = VideoPriorConfig(channels=24, taps=(0, 1, 2, 3), prompt="zeros")
LAYERS = (0, 1, 3, 4)  # of the denoiser's five: not the one in the middle

DENOISER = DenoiserConfig(
    channels=CHANNELS,
    width=32,
    depth=5,
    heads=2,
    head_width=48,
    head_depth=1,
    head_heads=2,
    frequencies=16,
    camera_patch=PATCH,
    invert_K=True,
    depth_condition=True,
)

CONFIG = GeoVerseConfig(
    name="micro",
    image_size=32,
    views=5,
    context=2,
    geometry=DepthAnythingConfig(
        encoder=EncoderConfig(
            width=CHANNELS // 2,
            depth=8,
            heads=2,
            mlp_ratio=2.0,
            patch=PATCH,
            base_grid=4,
            alternate_from=0,
            qk_norm_from=0,
            rotary_from=0,
            taps=(1, 3, 5, 7),
        ),
        head=GeometryHeadConfig(
            channels=CHANNELS, features=16, projected=(8, 8, 16, 16), patch=PATCH
        ),
        camera_heads=2,
        camera_depth=1,
        camera_layer_scale=1.0,
    ),
    rgb=RGBHeadConfig(
        in_channels=4 * CHANNELS, width=32, depth=1, heads=2, mlp=48, patch=PATCH, base_grid=(4, 4)
    ),
    level1=DENOISER,
    cascade=replace(
        DENOISER,
        depth=2,
        head_depth=1,
        source=True,
        separate_embedders=False,
        depth_condition=False,
    ),
    video=None,
    injection="none",
    control=ControlConfig(LAYERS),
    shared=SharedAttentionConfig(LAYERS),
)


def config(*, hints: dict[str, Any] | None = None, **changes: Any) -> GeoVerseConfig:
    """``CONFIG`` with changes; ``injection`` other than "none" brings the video prior with it."""
    if changes.get("injection", "none") != "none":
        changes.setdefault("video", VIDEO)
    return replace(CONFIG, hints=HintConfig(**(hints or {})), **changes)


def awake(module: nn.Module, *, seed: int = 0, size: float = 0.5) -> Any:
    """What starts at zero (gates, outputs, biases, tokens) becomes random, so that it counts."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in module.parameters():
        if not parameter.any():
            noise = torch.randn(parameter.shape, generator=generator)
            inputs = parameter[0].numel() if parameter.ndim in (2, 4) else 1
            parameter.data.copy_(size * noise / inputs**0.5)
    return module


def model(configuration: GeoVerseConfig = CONFIG, *, seed: int = 0) -> Any:
    """A model in which everything contributes, GeoVerse's extensions as well."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        built = GeoVerse(configuration)
    for part in built.children():
        awake(part, seed=seed)
    if built.control is not None:
        built.control.copy_from(built.level1)
    generator = torch.Generator().manual_seed(seed + 1)
    for statistics in built.level_statistics:
        statistics.mean.normal_(generator=generator)
        statistics.var.uniform_(0.2, 1.2, generator=generator)
    return built.eval()


def denoiser(configuration: DenoiserConfig | None = DENOISER, *, seed: int = 0) -> Any:
    """A level-1 denoiser with non-zero gates and output."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        built = Denoiser(configuration or DENOISER)
    return awake(built, seed=seed).eval()


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """(3, 3) by Rodrigues' formula."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def cameras(
    count: int, *, size: tuple[int, int] = SIZE, seed: int = 0, name: str = "view"
) -> Cameras:
    """About (0, 0, 0), at unit distances, looking at a point near (0, 0, 3); no two alike."""
    rng = np.random.default_rng(seed)
    poses, intrinsics = [], []
    for _ in range(count):
        centre = rng.uniform(-0.8, 0.8, 3)
        forward = np.array([0, 0, 3]) + rng.uniform(-0.3, 0.3, 3) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(np.array([0, 1, 0]), forward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack((right, np.cross(forward, right), forward))
        pose[:3, 3] = -pose[:3, :3] @ centre
        poses.append(pose)
        focal = max(size) * rng.uniform(0.9, 1.2)
        middle = np.array(size) / 2 + rng.uniform(-1, 1, 2)
        intrinsics.append([[focal, 0, middle[1]], [0, focal, middle[0]], [0, 0, 1]])
    names = tuple(f"{name}_{seed}_{index}" for index in range(count))
    height, width = np.full(count, size[0]), np.full(count, size[1])
    return Cameras(np.array(intrinsics), np.array(poses), width, height, names)


def batch(
    samples: int = 1,
    *,
    context: int = 2,
    targets: int = 2,
    size: tuple[int, int] = SIZE,
    seed: int = 0,
    share: float = 0.6,
) -> ViewBatch:
    """Random views; ``share`` of the targets' pixels is valid, in blocks, never the first token."""
    views = context + targets
    generator = torch.Generator().manual_seed(seed)
    rows = [cameras(views, size=size, seed=seed + 100 * sample) for sample in range(samples)]
    images = torch.rand(samples, views, 3, *size, generator=generator)
    depth = 2 + torch.rand(samples, views, 1, *size, generator=generator)
    coarse = torch.rand(samples * views, 1, size[0] // 4, size[1] // 4, generator=generator)
    valid = nn.functional.interpolate(coarse, size=size, mode="nearest") < share
    valid = valid.unflatten(0, (samples, views))
    valid[..., :PATCH, :PATCH] = False
    valid[:, :context] = True
    return ViewBatch(
        images=images * valid,
        depth=depth * valid,
        valid=valid,
        cam_from_world=torch.from_numpy(np.stack([r.cam_from_world for r in rows])).float(),
        K=torch.from_numpy(np.stack([r.K for r in rows])).float(),
        context=context,
    )


def video_features(
    samples: int, views: int, *, grid: tuple[int, int] = (2, 3), seed: int = 0
) -> VideoFeatures:
    """What a video prior could have given."""
    generator = torch.Generator().manual_seed(seed)
    shape = (samples, views, VIDEO.channels, *grid)
    levels = tuple(torch.randn(shape, generator=generator) for _ in VIDEO.taps)
    return VideoFeatures(levels, tuple(range(views)))


def conditions(
    samples: int = 2,
    *,
    context: int = 2,
    targets: int = 3,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
) -> tuple[Tensor, Tensor, Conditions]:
    """Noisy latents (B, V, C, h, w), times (B,) and conditions of a denoiser."""
    views = context + targets
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(samples, *shape, generator=generator).to(dtype)

    rows = [cameras(views, seed=seed + 100 * sample) for sample in range(samples)]
    camera = camera_condition(
        torch.from_numpy(np.stack([r.world_from_cam for r in rows])).to(dtype),
        torch.from_numpy(np.stack([r.K for r in rows])).to(dtype),
        SIZE,
        context=context,
        pixel_offset=CENTRED,
    )
    noisy, latents = normal(views, CHANNELS, *GRID), normal(views, CHANNELS, *GRID)
    t = torch.linspace(0.3, 0.9, samples).to(dtype)
    return noisy, t, Conditions(latents, camera, depth=normal(views, 2, *SIZE))


def context_views(
    count: int, *, size: tuple[int, int] = (30, 40), seed: int = 0, depth: bool = True
) -> list[ContextView]:
    """Photographs of a noisy wall some three units away."""
    rng = np.random.default_rng(seed + 50)
    found = []
    for camera in cameras(count, size=size, seed=seed, name="photo"):
        rgb = rng.random((*size, 3), np.float32)
        wall = rng.uniform(2.9, 3.1, size).astype(np.float32)
        found.append(ContextView(camera.names[0], camera, rgb, wall if depth else None))
    return found


def guidance(
    count: int, *, size: tuple[int, int] = (30, 40), seed: int = 1, share: float = 0.6
) -> Guidance:
    """The wall projected into target cameras, in blocks of which ``share`` is known."""
    rng = np.random.default_rng(seed)
    coarse = rng.random((count, -(-size[0] // 5), -(-size[1] // 5))) < share
    valid = coarse.repeat(5, axis=1).repeat(5, axis=2)[:, : size[0], : size[1]]
    rgb = rng.random((count, *size, 3), np.float32) * valid[..., None]
    depth = rng.uniform(2.9, 3.1, (count, *size)).astype(np.float32) * valid
    confidence = rng.uniform(0.2, 1, (count, *size)).astype(np.float32) * valid
    return Guidance(
        cameras(count, size=size, seed=seed, name="target"),
        rgb.astype(np.float32),
        depth,
        valid,
        confidence,
        np.zeros_like(valid),
    )


def moved(
    views: list[ContextView],
    known: Guidance,
    *,
    scale: float = 1.0,
    turn: np.ndarray | None = None,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[list[ContextView], Guidance]:
    """The same scene in another world frame: x -> scale (turn x + shift)."""
    turn = np.eye(3) if turn is None else turn

    def camera(old: Cameras) -> Cameras:
        pose = old.cam_from_world.copy()
        pose[:, :3, :3] = pose[:, :3, :3] @ turn.T
        centres = scale * (old.centers @ turn.T + np.asarray(shift))
        pose[:, :3, 3] = -np.einsum("vij,vj->vi", pose[:, :3, :3], centres)
        return replace(old, cam_from_world=pose)

    factor = np.float32(scale)
    return (
        [
            replace(v, camera=camera(v.camera), depth=None if v.depth is None else v.depth * factor)
            for v in views
        ],
        replace(known, cameras=camera(known.cameras), depth=known.depth * factor),
    )


def weights_folder(folder: Path, configuration: GeoVerseConfig = CONFIG, *, seed: int = 0) -> Path:
    """A weights folder of the micro model."""
    model(configuration, seed=seed).save_pretrained(folder)
    return folder


def joined(views: list[ContextView], known: Guidance) -> Cameras:
    """All cameras, context first."""
    return concatenate([*(view.camera for view in views), known.cameras])
