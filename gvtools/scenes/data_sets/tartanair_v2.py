"""TartanAir v2 as published: ``ENV/Data_easy/P000/image_lcam_front/000000_lcam_front.png``.

Twelve pinhole cameras, a stereo pair in each of six directions, each with its own pose file in the
first TartanAir's form. Depth is float32, metres, whose four bytes are the four channels of a PNG in
OpenCV's order: blue, green, red, alpha.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import pinhole_lens
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.data_sets.tartanair import SKY_FROM, read_trajectory, trajectory_scenes
from gvtools.scenes.images import UNREADABLE
from gvtools.scenes.scene import Scene
from gvtools.untrusted import open_picture

LENS = pinhole_lens([320.0, 320.0, 320.0, 320.0], (640, 640))
DIRECTIONS = ("front", "back", "left", "right", "top", "bottom")
CAMERAS = tuple(f"{side}cam_{direction}" for side in "lr" for direction in DIRECTIONS)


def packed_depth(path: Path) -> NDArray[np.float32]:
    """(H, W) float32 z-depth, metres, 0 = none, of a PNG whose channels are a float's bytes."""
    try:
        with open_picture(path) as image:
            mode, pixels = image.mode, np.asarray(image)
    except UNREADABLE as error:
        raise ProjectError(f"{path}: unreadable ({error}); download it again") from None
    if mode != "RGBA":
        raise ProjectError(f"{path}: depth as {mode}; expected the four bytes of a float as RGBA")
    packed = np.ascontiguousarray(pixels[..., [2, 1, 0, 3]])
    depth = packed.view("<f4")[..., 0].astype(np.float32)
    valid = np.isfinite(depth) & (depth > 0) & (depth <= SKY_FROM)
    return np.where(valid, depth, np.float32(0))


def _scenes(root: Path) -> tuple[str, ...]:
    return trajectory_scenes(root, ["Data_*/P*", "*/Data_*/P*"], CAMERAS)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    return read_trajectory(root, scene, lens=LENS, depth_suffix=".png", read_depth=packed_depth)


LAYOUT = Layout("ENV/Data_easy/P000 with image_lcam_front and pose_lcam_front.txt", _scenes, _read)
