"""Cameras and depth of photographs by Depth Anything 3, all of them in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from gvtools.cameras import Cameras, invert_rigid, rigid_poses
from gvtools.capture.photographs import CapturedPhotograph
from gvtools.capture.predictions import Predictions, sample_points
from gvtools.completers.geoverse.views import model_size, resample
from gvtools.depth.options import FoundationOptions
from gvtools.errors import OptionError
from gvtools.networks.compute import autocast, inference_type
from gvtools.networks.depth_anything.network import load_depth_anything
from gvtools.scenes.images import read_image

# Memory grows with the square of the pictures in a pass.
MOST_PICTURES = 64


@torch.no_grad()
def predict(photographs: Sequence[CapturedPhotograph], weights: Path) -> Predictions:
    """What the network of a folder of weights tells of photographs of about one aspect."""
    if len(photographs) > MOST_PICTURES:
        raise OptionError(
            f"--poses {weights}: {len(photographs)} pictures; one pass takes at most "
            f"{MOST_PICTURES}; give fewer, or what the network's own program saved"
        )
    place = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    dtype = inference_type("auto", place)
    network = load_depth_anything(weights, device=place, dtype=dtype)
    width, height = np.median([item.size for item in photographs], axis=0)
    size = model_size(
        int(height), int(width), longest=FoundationOptions().longest,
        patch=network.config.encoder.patch,
    )  # fmt: skip
    pictures = [torch.from_numpy(read_image(item.path).rgb) for item in photographs]
    small = torch.cat([
        resample(rgb.permute(2, 0, 1)[None].float() / 255, size) for rgb in pictures
    ]).clamp(0, 1)  # fmt: skip
    with autocast(place, dtype):
        levels = network.encode(small[None].to(place))
        geometry = network.geometry(levels, network.encoder.grid(*size))
        encoding = network.cam_dec(levels[-1][:, :, 0])
    names = tuple(item.name for item in photographs)
    depth, sure = (
        array[0].float().cpu().numpy() for array in (geometry.depth, geometry.depth_confidence)
    )
    cameras = decode_cameras(encoding[0], size, names=names)
    shown = (small.permute(0, 2, 3, 1) * 255).byte().numpy()
    return Predictions(cameras, True, shown, True, *sample_points(depth, sure))


def decode_cameras(encoding: Tensor, size: tuple[int, int], *, names: tuple[str, ...]) -> Cameras:
    """Cameras of (V, 9) encodings, see ``encode_cameras``; ``size`` is height and width [px]."""
    values = encoding.double().cpu().numpy()
    pose = rigid_poses(Rotation.from_quat(values[:, 3:7]).as_matrix(), values[:, :3])
    K = np.tile(np.eye(3), (len(values), 1, 1))
    half = np.array(size[::-1]) / 2
    K[:, :2, 2] = half
    K[:, [0, 1], [0, 1]] = half / np.tan(np.clip(values[:, [8, 7]], 0.05, 3.0) / 2)
    return Cameras(K, invert_rigid(pose), np.array(size[1]), np.array(size[0]), names)
