"""TartanAir (the first) as published: ``ENV/Easy/P000/image_left/000000_left.png`` and others.

Depth lies in ``depth_left/000000_left_depth.npy``, metres; row i of ``pose_left.txt`` is the pose
of frame i: ``tx ty tz qx qy qz qw``, metres, camera to world. Both frames are NED, as aircraft have
them: a camera's x axis looks forward, y to the right, z down. The world stays as it is here; the
cameras get OpenCV axes. Intrinsics are in no file: 90 degrees wide, 640x480, the principal point in
the middle, (320, 240), of pixels whose first centre is (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.drawn import folders_with, number_table, numbers_in, pose_of
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import (
    PosedPicture,
    natural,
    pinhole_lens,
    posed_scene,
)
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.images import read_depth
from gvtools.scenes.photographs import Depth
from gvtools.scenes.scene import Scene
from gvtools.scenes.transforms_frame import LensParameters

LENS = pinhole_lens([320.0, 320.0, 320.0, 240.0], (640, 480))
# The sky is a sphere some kilometres away, at depths such as 10000 (metres).
SKY_FROM = 1000.0

# Camera axes: OpenCV's x (right), y (down), z (forward) as NED's y, z, x.
NED_FROM_OPENCV = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def ned_poses(path: Path) -> NDArray[np.float64]:
    """(N, 4, 4) float64 world_from_cam of a TartanAir pose file: OpenCV cameras in a NED world.

    Args:
        path: rows ``tx ty tz qx qy qz qw``; where it is absent there are no poses.
    """
    from scipy.spatial.transform import Rotation

    rows = number_table(path, 7)
    usable = np.isfinite(rows).all(axis=1) & (np.abs(rows[:, 3:]).max(axis=1, initial=0) > 0)
    if len(rows) and not usable.any():
        raise ProjectError(f"{path}: no row is a pose; expected tx ty tz qx qy qz qw in each")
    poses = np.full((len(rows), 4, 4), np.nan)
    turns = Rotation.from_quat(rows[usable, 3:]).as_matrix()
    poses[usable] = pose_of(turns @ NED_FROM_OPENCV, rows[usable, :3])
    return poses


def trajectory_scenes(
    root: Path, trajectories: Sequence[str], cameras: Sequence[str]
) -> tuple[str, ...]:
    """Names such as "ENV/Easy/P000/left": one scene for each camera of each trajectory.

    Args:
        root: of the download.
        trajectories: patterns of their folders, such as "*/Easy/P*".
        cameras: that a trajectory may have.
    """
    return natural(
        f"{folder}/{camera}"
        for camera in cameras
        for held in (f"image_{camera}", f"pose_{camera}.txt")
        for folder in folders_with(root, [f"{place}/{held}" for place in trajectories])
    )


def read_trajectory(
    root: Path,
    scene: str,
    *,
    lens: LensParameters,
    depth_suffix: str,
    read_depth: Callable[[Path], Depth],
) -> Scene:
    """One camera of one trajectory, in metres, in its NED world.

    Args:
        root: of the download.
        scene: as ``trajectory_scenes`` names it.
        lens: of all pictures.
        depth_suffix: of depth maps, such as ".npy".
        read_depth: how one is read.
    """
    trajectory, _, camera = scene.rpartition("/")
    folder = root / trajectory
    images, depths = folder / f"image_{camera}", folder / f"depth_{camera}"
    poses = ned_poses(folder / f"pose_{camera}.txt")
    present = numbers_in(images, f"{{:06d}}_{camera}.png")
    stems = {i: f"{i:06d}_{camera}" for i in sorted(present.union(range(len(poses))))}
    pictures = [
        PosedPicture(
            f"{stem}.png",
            images / f"{stem}.png",
            lens,
            poses[i] if i < len(poses) else None,
            depths / f"{stem}_depth{depth_suffix}",
            read_depth,
        )
        for i, stem in stems.items()
    ]
    return posed_scene(folder, pictures, poses="world_from_cam", metric=True)


def _scenes(root: Path) -> tuple[str, ...]:
    # The archives hold the environment's folder once more: ENV/ENV/Easy/P000 is as common.
    places = [f"{above}{level}/P*" for above in ("", "*/", "*/*/") for level in ("Easy", "Hard")]
    return trajectory_scenes(root, places, ("left", "right"))


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    reader = partial(read_depth, maximum=SKY_FROM)
    return read_trajectory(root, scene, lens=LENS, depth_suffix=".npy", read_depth=reader)


LAYOUT = Layout("ENV/Easy/P000 or ENV/Hard/P000 with image_left and pose_left.txt", _scenes, _read)
