"""Virtual KITTI 2 as published: ``Scene01/clone/frames/rgb/Camera_0/rgb_00000.jpg`` and others.

Depth lies in ``frames/depth/Camera_0/depth_00000.png``, centimetres, 65535 for the sky. Cameras
are rows of ``intrinsic.txt`` (frame, camera, fx, fy, cx, cy) and ``extrinsic.txt`` (frame, camera,
the 16 numbers of cam_from_world, metres), one for each frame and each of the two cameras. Pixel
centres count as integers: the principal point (620.5, 187) is the middle of 1242x375. The archives
unpack into one folder or into ``vkitti_2.0.3_rgb``, ``_depth`` and ``_textgt`` side by side.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from gvtools.scenes.data_sets.drawn import (
    NO_LENS,
    drawn_lens,
    number_table,
    numbers_in,
    picture_size,
)
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import PosedPicture, natural, posed_scene
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.images import read_depth
from gvtools.scenes.scene import Scene

CENTIMETRES = 0.01
CAMERAS = ("Camera_0", "Camera_1")
IMAGE, DEPTH = "rgb_{:05d}.jpg", "depth_{:05d}.png"


def _part(root: Path, part: str) -> Path:
    """Where one of the archives (rgb, depth, textgt) was unpacked."""
    apart = sorted(root.glob(f"vkitti_*_{part}"))
    return apart[0] if apart else root


def _scenes(root: Path) -> tuple[str, ...]:
    drawn = (
        path.relative_to(_part(root, part)).parts
        for part in ("rgb", "depth")
        for camera in CAMERAS
        for path in _part(root, part).glob(f"Scene*/*/frames/{part}/{camera}")
    )
    return natural(f"{scene}/{variation}/{camera}" for scene, variation, *_, camera in drawn)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    variation, _, camera = scene.rpartition("/")
    images = _part(root, "rgb") / variation / "frames" / "rgb" / camera
    depths = _part(root, "depth") / variation / "frames" / "depth" / camera
    texts = _part(root, "textgt") / variation
    number = CAMERAS.index(camera)
    poses, lenses = (
        {
            int(row[0]): row[2:]
            for row in number_table(path, columns, header=True)
            if row[1] == number and np.isfinite(row[0])
        }
        for path, columns in ((texts / "extrinsic.txt", 18), (texts / "intrinsic.txt", 6))
    )
    frames = sorted(numbers_in(images, IMAGE).union(poses))
    size = picture_size(images / IMAGE.format(i) for i in frames)
    pictures = []
    for i in frames:
        posed = i in poses and i in lenses
        pictures.append(
            PosedPicture(
                IMAGE.format(i),
                images / IMAGE.format(i),
                drawn_lens(lenses[i], size) if posed else NO_LENS,
                poses[i].reshape(4, 4) if posed else None,
                depths / DEPTH.format(i),
                partial(read_depth, unit=CENTIMETRES),
            )
        )
    return posed_scene(texts, pictures, poses="cam_from_world", metric=True, home=root)


LAYOUT = Layout("SceneNN/VARIATION with frames, intrinsic.txt and extrinsic.txt", _scenes, _read)
