"""DTU MVS in the three forms in which it is passed on; all of them are in millimetres.

- MVSNet's: ``Rectified/scanN[_train]/rect_VVV_L_r5000.png`` (picture VVV from 1, light L) with
  ``Cameras/NNNNNNNN_cam.txt`` (of 1600x1200) or ``Cameras/train/`` (of 160x128 for pictures of
  640x512), N from 0, and depth in ``Depths[_raw]/scanN[_train]/depth_map_NNNN.pfm``. Of the seven
  lights the fourth (L = 3) is read.
- MVSNet's for testing: ``scanN/images/NNNNNNNN.jpg`` with ``scanN/cams/NNNNNNNN_cam.txt``.
- IDR's and pixelNeRF's: ``scanN/image/NNNNNN.png`` with ``scanN/cameras.npz``: ``world_mat_i`` is
  K [R t]; ``scale_mat_i`` would shrink the scene and is left aside.

Poses and depth become metres. Which pixel a principal point counts from is not stated: it is taken
from the picture's corner.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.mvsnet_cameras import (
    SUFFIX,
    MvsCamera,
    posed_picture,
    read_camera,
)
from gvtools.scenes.data_sets.pfm import read_pfm_depth
from gvtools.scenes.data_sets.picture_folders import pictures_by_stem
from gvtools.scenes.data_sets.posed_pictures import Float64, PosedPicture, natural, posed_scene
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.rgbd_recording import MILLIMETRES
from gvtools.scenes.scene import Scene
from gvtools.untrusted import load_arrays

RECTIFIED, CAMERAS, NPZ = "Rectified", "Cameras", "cameras.npz"
LIGHT = "3"
RECT = re.compile(r"rect_(\d{3})_(\w+?)(?:_r5000)?\.png")
# Sizes of published pictures and of the maps that MVSNet computes, which cameras may be of.
SIZES = ((1600, 1200), (640, 512), (400, 300), (160, 128))


def _scenes(root: Path) -> tuple[str, ...]:
    found = [path.relative_to(root).as_posix() for path in root.glob(f"{RECTIFIED}/scan*/")]
    for pattern in (f"scan*/{NPZ}", f"*/scan*/{NPZ}"):
        found += [path.parent.relative_to(root).as_posix() for path in root.glob(pattern)]
    for pattern in ("scan*/cams/", "*/scan*/cams/"):
        found += [path.parent.relative_to(root).as_posix() for path in root.glob(pattern)]
    return natural(found)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    if scene.startswith(f"{RECTIFIED}/"):
        pictures = _rectified(root, folder)
    elif (folder / NPZ).is_file():
        pictures = _idr(folder)
    else:
        pictures = _cams(folder)
    return posed_scene(folder, pictures, poses="cam_from_world", metric=True, home=root)


def _rectified(root: Path, folder: Path) -> list[PosedPicture]:
    """Of MVSNet's training form."""
    reduced = folder.name.endswith("_train")
    cameras = root / CAMERAS / "train" if reduced else root / CAMERAS
    files = sorted(cameras.glob(f"*{SUFFIX}"))
    if not files:
        raise ProjectError(f"{cameras}: no camera files NNNNNNNN{SUFFIX}; complete the download")
    depths = root / ("Depths" if reduced else "Depths_raw") / folder.name
    light = _light(folder)
    pictures = []
    for file in files:
        number = int(file.name.removesuffix(SUFFIX))
        name = f"rect_{number + 1:03d}_{light}.png"
        picture = posed_picture(
            name, folder / name, read_camera(file), sizes=SIZES, unit=MILLIMETRES
        )
        pictures.append(_with_depth(picture, depths, number))
    return pictures


def _light(folder: Path) -> str:
    """What stands for the light in the pictures' names; the fourth where it is there."""
    lights = {
        name[len("rect_000_") : -len(".png")]
        for name in (path.name for path in folder.glob("rect_*.png"))
        if RECT.fullmatch(name)
    }
    preferred = [light for light in sorted(lights) if light.partition("_")[0] == LIGHT]
    return next(iter(preferred or sorted(lights)), f"{LIGHT}_r5000")


def _with_depth(picture: PosedPicture, folder: Path, number: int) -> PosedPicture:
    from dataclasses import replace

    if not folder.is_dir():
        return picture
    reader = partial(read_pfm_depth, unit=MILLIMETRES)
    return replace(picture, depth=folder / f"depth_map_{number:04d}.pfm", read_depth=reader)


def _cams(folder: Path) -> list[PosedPicture]:
    """Of MVSNet's form for testing."""
    found = pictures_by_stem(folder / "images") if (folder / "images").is_dir() else {}
    pictures = []
    for file in sorted((folder / "cams").glob(f"*{SUFFIX}")):
        stem = file.name.removesuffix(SUFFIX)
        image = found.get(stem, folder / "images" / f"{stem}.jpg")
        camera = read_camera(file)
        pictures.append(posed_picture(image.name, image, camera, sizes=SIZES, unit=MILLIMETRES))
    return pictures


def _idr(folder: Path) -> list[PosedPicture]:
    """Of IDR's form."""
    try:
        prefix = "world_mat_"
        matrices = {
            int(key.removeprefix(prefix)): np.asarray(matrix, np.float64)[:3, :4].reshape(3, 4)
            for key, matrix in load_arrays(folder / NPZ).items()
            if re.fullmatch(prefix + r"\d{1,9}", key)
        }
    except (OSError, ValueError, TypeError, IndexError) as error:
        raise ProjectError(f"{folder / NPZ}: {error}; expected world_mat_0, ...") from None
    home = folder / "image"
    found = pictures_by_stem(home) if home.is_dir() else {}
    by_number = {int(stem): path for stem, path in found.items() if stem.isdecimal()}
    pictures = []
    for number in sorted(matrices):
        image = by_number.get(number, home / f"{number:06d}.png")
        try:
            camera = decomposed(matrices[number])
        except ValueError as error:  # of NumPy's linear algebra, too
            raise ProjectError(
                f"{folder / NPZ}: {prefix}{number} is no projection matrix ({error}); copy it again"
            ) from None
        pictures.append(posed_picture(image.name, image, camera, sizes=SIZES, unit=MILLIMETRES))
    return pictures


def decomposed(projection: NDArray[np.float64]) -> MvsCamera:
    """K and cam_from_world of a projection matrix K [R t], whatever its scale and sign.

    Args:
        projection: (3, 4).
    """
    from scipy.linalg import rq

    K, R = rq(projection[:, :3])
    sign = np.sign(np.diag(K))
    K, R = K * sign, R * sign[:, None]
    K = K / K[2, 2]
    if np.linalg.det(R) < 0:
        R = -R
    # K [R t] is the matrix up to a factor, which the first block tells.
    scale = _factor(K @ R, projection[:, :3])
    pose = np.eye(4)
    pose[:3, :3] = R
    pose[:3, 3] = np.linalg.solve(K, projection[:, 3]) / scale
    # Text and double precision leave a trace of skew.
    K[0, 1] = 0.0 if abs(K[0, 1]) < 1e-3 * K[0, 0] else K[0, 1]
    return MvsCamera(K, pose)


def _factor(unit: Float64, scaled: Float64) -> float:
    """The number that ``unit`` has to be multiplied with to give ``scaled``."""
    return float((unit * scaled).sum() / (unit * unit).sum())


LAYOUT = Layout(
    "Rectified/scanN with Cameras, or scanN/cams with images, or scanN/cameras.npz with image",
    _scenes,
    _read,
)
