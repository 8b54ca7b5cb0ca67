"""Spring as published, its training part: ``spring/train/0001/frame_left/frame_left_0001.png``.

Depth comes from ``disp1_left/disp1_left_0001.dsp5``, HDF5 with the disparity to the right camera,
0.065 m beside the left one: in pixels of the frame, but at twice its resolution. Row i of
``cam_data/intrinsics.txt`` (fx, fy, cx, cy) and ``cam_data/extrinsics.txt`` (the 16 numbers of
cam_from_world, metres, OpenCV axes) belongs to frame i, counted from 1. Pixels that
``maps/skymap_left`` calls sky have no depth.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.array_files import hdf5_array
from gvtools.scenes.data_sets.drawn import (
    NO_LENS,
    drawn_lens,
    folders_with,
    number_table,
    numbers_in,
    picture_size,
)
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import PosedPicture, posed_scene
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.images import read_mask
from gvtools.scenes.scene import Finding, Scene

BASELINE = 0.065  # metres
LEAST_DISPARITY = 1e-9  # pixels
SAME_SURFACE = 0.05  # relative disparity between neighbours of one surface

IMAGE, DISPARITY = "frame_left_{:04d}.png", "disp1_left_{:04d}.dsp5"
SKY = "skymap_left_{:04d}.png"


def spring_depth(path: Path, *, focal: float, sky: Path | None) -> NDArray[np.float32]:
    """(H, W) float32 z-depth, metres, 0 = none, of a disparity map of (2 H, 2 W).

    Args:
        path: the map.
        focal: horizontal focal length, pixels of the frame.
        sky: the map of the sky, of (2 H, 2 W) or (H, W); None where there is none.
    """
    disparity = hdf5_array(path, "disparity").astype(np.float64)
    if disparity.ndim != 2 or disparity.shape[0] % 2 or disparity.shape[1] % 2:
        raise ProjectError(f"{path}: disparity {disparity.shape}; expected twice the frame's size")
    disparity = np.where(np.isfinite(disparity) & (disparity > 0), disparity, 0)
    if sky is not None:
        mask = read_mask(sky)
        times = disparity.shape[0] // mask.shape[0]
        if times not in (1, 2) or tuple(times * n for n in mask.shape) != disparity.shape:
            raise ProjectError(
                f"{sky}: {mask.shape}; expected {disparity.shape}, or half of it; copy it again"
            )
        disparity[np.repeat(np.repeat(mask, times, axis=0), times, axis=1)] = 0
    middle = halved(disparity)
    # Nearer to nothing than any disparity is, it gives no depth that float32 holds.
    near = middle > LEAST_DISPARITY
    near &= focal * BASELINE / np.where(near, middle, 1) < np.finfo(np.float32).max
    depth = np.divide(focal * BASELINE, middle, out=np.zeros_like(middle), where=near)
    return depth.astype(np.float32)


def halved(disparity: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W) disparity at the centres of blocks of 2 x 2 of (2 H, 2 W).

    The median of four is exact on planes, whose disparity is affine in the picture. Where an edge
    halves the block, it is the nearer surface's, so that no depth between two is made up.

    >>> halved(np.array([[1.0, 1.125], [1.125, 1.25]]) + 16).item()
    17.125
    """
    height, width = disparity.shape[0] // 2, disparity.shape[1] // 2
    blocks = disparity.reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)
    ordered = np.sort(blocks, axis=-1)
    far, near = ordered[..., 1], ordered[..., 2]
    return np.where(near - far > SAME_SURFACE * near, near, (far + near) / 2)


def _scenes(root: Path) -> tuple[str, ...]:
    places = ("", "train/", "spring/train/")
    return folders_with(
        root, [f"{p}[0-9]*/{held}" for p in places for held in ("frame_left", "cam_data")]
    )


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    images, skies = folder / "frame_left", folder / "maps" / "skymap_left"
    poses = number_table(folder / "cam_data" / "extrinsics.txt", 16)
    lenses = number_table(folder / "cam_data" / "intrinsics.txt", 4)
    posed, drawn = min(len(poses), len(lenses)), numbers_in(skies, SKY)
    frames = sorted(numbers_in(images, IMAGE).union(range(1, posed + 1)))
    size = picture_size(images / IMAGE.format(i) for i in frames)
    pictures = []
    for i in frames:
        lens = drawn_lens(lenses[i - 1], size) if 1 <= i <= posed else NO_LENS
        sky = skies / SKY.format(i) if i in drawn else None
        pictures.append(
            PosedPicture(
                IMAGE.format(i),
                images / IMAGE.format(i),
                lens,
                poses[i - 1].reshape(4, 4) if 1 <= i <= posed else None,
                folder / "disp1_left" / DISPARITY.format(i),
                partial(spring_depth, focal=lens.values[0], sky=sky),
            )
        )
    findings = []
    if len(drawn.intersection(frames)) < len(frames):
        line = f"{len(frames) - len(drawn.intersection(frames))} frames have no map of the sky"
        findings.append(Finding("info", f"{line}: their sky is as far as its disparity says"))
    return posed_scene(folder, pictures, poses="cam_from_world", metric=True, findings=findings)


LAYOUT = Layout("train/NNNN with frame_left, disp1_left and cam_data", _scenes, _read)
