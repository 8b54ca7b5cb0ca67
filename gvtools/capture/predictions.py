"""Cameras and points as feed-forward networks save them: arrays by name, or a COLMAP model.

VGGT (``predictions.npz``, ``sparse``), Depth Anything 3 (``exports/npz``, ``mini_npz``, COLMAP),
MapAnything (``predictions.npz``, ``sparse``), DUSt3R and MASt3R (poses, focal lengths, ``pts3d``).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras, invert_rigid, rigid_transform
from gvtools.errors import ProjectError
from gvtools.scenes.colmap_model import find_model, load_model
from gvtools.scenes.matching import named
from gvtools.untrusted import archive, load_array, load_arrays, reading

Arrays = dict[str, NDArray[Any]]

# What the arrays are called. Poses map from the world to the camera, or back.
FROM_WORLD = ("extrinsics", "extrinsic", "cam_from_world", "w2c")
TO_WORLD = ("camera_poses", "cam2world", "cams2world", "world_from_cam", "c2w", "im_poses", "poses")
INTRINSICS, FOCALS = ("intrinsics", "intrinsic", "K", "Ks"), ("focals", "focal", "im_focals")
DEPTH = ("depth", "depth_map", "depthmaps", "depths", "depth_z")
POINTS = ("world_points", "pts3d", "points")
SURE = ("depth_conf", "world_points_conf", "conf", "confs", "im_conf")
PICTURES = ("images", "image", "imgs", "img_no_norm")
EVERY = (*FROM_WORLD, *TO_WORLD, *INTRINSICS, *FOCALS, *DEPTH, *POINTS, *SURE, *PICTURES)
# Points that are kept, of those no less certain than the median.
MOST_POINTS = 50_000
EXPECTED = (
    "expected poses (extrinsics, extrinsic, camera_poses, cam2world) and intrinsics in .npz or "
    ".npy, or a COLMAP model, as VGGT, Depth Anything 3, MapAnything, DUSt3R or MASt3R save them"
)


@dataclass(frozen=True, eq=False)
class Predictions:
    """V cameras of the pictures that a network saw, and M points that it sees in them."""

    cameras: Cameras  # of the network's pictures
    has_names: bool  # whether the cameras' names are those of pictures
    pictures: NDArray[np.uint8] | None  # (V, h, w, 3) what the network saw
    stretched: bool  # how photographs became its pictures, where it shows none: else cut
    view: NDArray[np.int64]  # (M,) the camera of each point
    xy: NDArray[np.float64]  # (M, 2) where that sees it [px of the network's picture]
    points: NDArray[np.float64]  # (M,) z-depth in that camera, or (M, 3) in the world


def read_predictions(path: Path) -> Predictions:
    """What a network saved in a file or a folder."""
    model = find_model(path) if path.is_dir() else None
    if model is not None:
        return _from_colmap(model)
    # Of several files, as Depth Anything 3 writes, the one that tells most.
    fullest: Arrays = {}
    with reading(f"--poses {path}", EXPECTED):
        files = sorted(path.rglob("*.np[yz]")) if path.is_dir() else [path]
        for folder in sorted({file.parent for file in files}):
            alone = [file for file in files if file.parent == folder and file.stem in EVERY]
            arrays = {file.stem: load_array(file) for file in alone if file.suffix == ".npy"}
            fullest = max(fullest, arrays, key=len)
        for file in files:
            if file.suffix != ".npy":
                with archive(file) as opened:
                    held = {name.removesuffix(".npy") for name in opened.namelist()} & {*EVERY}
                # Of points that depth tells as well, VGGT's would take gigabytes.
                held -= {*POINTS} if held & {*DEPTH} else set()
                if len(held) > len(fullest):
                    fullest = load_arrays(file, *sorted(held))
        return _from_arrays(fullest)


def _from_arrays(arrays: Arrays) -> Predictions:
    def one(names: tuple[str, ...], *ndim: int) -> NDArray[Any] | None:
        name = next((name for name in names if name in arrays), None)
        if name is None:
            return None
        found = arrays[name]
        while found.ndim > max(ndim) and found.shape[0] == 1:
            found = found[0]
        if found.ndim not in ndim or not found.size or found.dtype.kind not in "fiub":
            raise ValueError(f"{name} is of shape {arrays[name].shape} and type {found.dtype}")
        return found

    poses, K = one((*FROM_WORLD, *TO_WORLD), 3), one(INTRINSICS, 3)
    depth, world, pictures = one(DEPTH, 3, 4), one(POINTS, 4), one(PICTURES, 4)
    if poses is None:
        raise ValueError(f"no poses among {named(sorted(arrays)) or 'its arrays'}")
    rigid = np.stack([
        rigid_transform(pose, what=f"pose {row}")[0] for row, pose in enumerate(poses)
    ])  # fmt: skip
    # MapAnything names so what maps to the world, as 4x4.
    to_world = not arrays.keys() & {*FROM_WORLD}
    to_world |= "extrinsic" in arrays and poses.shape[1:] == (4, 4)
    if depth is not None and depth.ndim == 4:
        depth = depth[..., 0]
    if pictures is not None:
        if pictures.shape[1] == 3:
            pictures = pictures.transpose(0, 2, 3, 1)
        if pictures.dtype.kind == "f":
            low = -1 if np.nanmin(pictures) < -0.05 else 0
            pictures = np.clip((pictures - low) / (1 - low), 0, 1) * 255
    shaped = next((array for array in (depth, world, pictures) if array is not None), None)
    focals = None if shaped is None else one(FOCALS, 1, 2)
    if K is None and (focals is None or shaped is None):
        raise ValueError("no intrinsics, nor focal lengths with depth, points or pictures")
    if K is None or shaped is not None:
        assert shaped is not None
        height, width = shaped.shape[1:3]
    else:
        width, height = np.rint(2 * K[0, :2, 2]).astype(int)
    if K is None:
        assert focals is not None
        K = np.tile([[1.0, 0, width / 2], [0, 1.0, height / 2], [0, 0, 1]], (len(focals), 1, 1))
        K[:, [0, 1], [0, 1]] = focals.reshape(len(focals), -1)
    if not (K.shape[1:] == (3, 3) and len(K) == len(poses) and np.isfinite(K).all()):
        raise ValueError(f"{len(poses)} poses, and intrinsics of shape {K.shape} or not finite")
    if not (K[:, [0, 1], [0, 1]] > 0).all():
        raise ValueError("focal lengths that are not above 0")
    for array in (depth, world, pictures):
        if array is not None and array.shape[:3] != (len(poses), height, width):
            raise ValueError(f"{len(poses)} poses of {width}x{height} pixels beside {array.shape}")
    K = np.where([[1, 0, 1], [0, 1, 1], [0, 0, 1]], K, 0).astype(np.float64)
    cameras = Cameras(
        K, invert_rigid(rigid) if to_world else rigid, np.array(width), np.array(height), ()
    )
    seen = sample_points(depth if depth is not None else world, one(SURE, 3, 4))
    stretched = not to_world and not np.allclose(K[:, 0, 0], K[:, 1, 1], rtol=1e-6)
    shown = None if pictures is None else pictures.astype(np.uint8)
    return Predictions(cameras, False, shown, stretched, *seen)


def sample_points(
    values: NDArray[Any] | None, sure: NDArray[Any] | None
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Of the more certain pixels of depth or points: camera, place, and value."""
    if values is None:
        return np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0)
    usable = np.isfinite(values) & (values > 0) if values.ndim == 3 else (
        np.isfinite(values).all(axis=3)
    )  # fmt: skip
    if sure is not None and sure.size == usable.size:
        usable &= sure.reshape(usable.shape) >= np.nanmedian(sure)
    rows = np.flatnonzero(usable)
    rows = np.random.default_rng(0).permutation(rows)[:MOST_POINTS]
    view, y, x = np.unravel_index(np.sort(rows), usable.shape)
    xy = np.column_stack([x, y]).astype(np.float64) + 0.5
    return view.astype(np.int64), xy, values[view, y, x].astype(np.float64)


def _from_colmap(folder: Path) -> Predictions:
    """A model whose pictures may be the network's, reduced and cut."""
    loaded = load_model(folder)
    model, images = loaded.reconstruction, loaded.images
    lenses = [model.cameras[image.camera_id] for image in images]
    bent = sorted({lens.model_name for lens in lenses} - {"PINHOLE", "SIMPLE_PINHOLE"})
    if bent:
        raise ProjectError(
            f"--poses {folder}: cameras of the model {named(bent)}; expected PINHOLE, as networks "
            "save; with the photographs in 'images' beside it, it is a project already"
        )
    cameras = Cameras(
        np.array([lens.calibration_matrix() for lens in lenses]),
        np.array([image.cam_from_world for image in images]),
        np.array([lens.width for lens in lenses]), np.array([lens.height for lens in lenses]),
        tuple(image.name for image in images),
    )  # fmt: skip
    # Each point as the first picture shows it.
    found: dict[int, tuple[int, Any, Any]] = {}
    for row, image in enumerate(images):
        for seen in model.images[image.image_id].get_observation_points2D():
            key = int(seen.point3D_id)
            if key not in found and key in model.points3D:
                found[key] = row, seen.xy, model.points3D[key].xyz
    kept = list(found.values())[:: max(1, -(-len(found) // MOST_POINTS))]
    view = np.array([row for row, _, _ in kept], np.int64)
    xy, points = (np.array([item[at] for item in kept]).reshape(-1, at + 1) for at in (1, 2))
    return Predictions(cameras, True, None, False, view, xy, points)
