"""DTU and Tanks and Temples in the forms in which they are passed on, MVSNet's among them.

Camera files of MVSNet and its relatives, ``cams/NNNNNNNN_cam.txt`` beside ``images``, hold the word
"extrinsic" with a 4x4 cam_from_world, the word "intrinsic" with a 3x3 matrix in pixels, and the
range of depth. Which pixel a principal point counts from is not stated: it is taken from the
picture's corner.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gvtools.cameras import rigid_poses
from gvtools.errors import ProjectError
from gvtools.scenes.calibration import MILLIMETRES, Float64, load_matrix, pinhole_lens
from gvtools.scenes.colmap_model import find_model
from gvtools.scenes.data_sets.reconstructed import mipnerf360
from gvtools.scenes.images import read_pfm_depth
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import natural, pictures_by_stem
from gvtools.scenes.photographs import PosedFrame, first_size, posed_scene
from gvtools.scenes.rgbd_layouts import read_log
from gvtools.scenes.scene import Finding, Scene
from gvtools.untrusted import load_arrays, read_text, reading

SUFFIX = "_cam.txt"
# How far a principal point may be from the middle, as a share of a side, to be of that picture.
CENTRED = 0.2


class MvsCamera(NamedTuple):
    """A camera as stored: (3, 3) K, pixels, and (4, 4) cam_from_world in the stored unit."""

    K: Float64
    cam_from_world: Float64

    def frame(
        self, image: Path, *, sizes: tuple[tuple[int, int], ...], unit: float = 1.0
    ) -> PosedFrame:
        """A frame of this camera, in units of ``unit`` scene units."""
        size = size_of_intrinsics(self.K, first_size([image]) or (2, 2), *sizes)
        pose = self.cam_from_world.copy()
        pose[:3, 3] *= unit
        return PosedFrame(image.name, image, pinhole_lens(self.K, size), pose)


def read_camera(path: Path) -> MvsCamera:
    """A camera file of MVSNet."""
    form = "expected 'extrinsic' with 4x4 and 'intrinsic' with 3x3 numbers"
    with reading(path, f"{form}; copy it again"):
        words = read_text(path).split()
        at = words.index("extrinsic") + 1
        pose = np.array(words[at : at + 16], np.float64).reshape(4, 4)
        at = words.index("intrinsic") + 1
        return MvsCamera(np.array(words[at : at + 9], np.float64).reshape(3, 3), pose)


def size_of_intrinsics(
    K: Float64, picture: tuple[int, int], *others: tuple[int, int]
) -> tuple[int, int]:
    """Which pictures intrinsics are of: the first size in whose middle the principal point lies.

    ``picture`` is the size of the one at hand, ``others`` are further ones of the data set's files.

    >>> size_of_intrinsics([[361, 0, 82], [0, 360, 66], [0, 0, 1]], (640, 512), (160, 128))
    (160, 128)
    """
    matrix = np.asarray(K, np.float64)
    for width, height in (picture, *others):
        off = np.abs(matrix[:2, 2] / (width, height) - 0.5)
        if off.max() <= CENTRED:
            return width, height
    return picture


def mvsnet_frames(
    folder: Path, cams: Path, *, sizes: tuple[tuple[int, int], ...], unit: float = 1.0
) -> list[PosedFrame]:
    """Frames of the camera files in ``cams``, their pictures in ``images`` of the folder."""
    found = pictures_by_stem(folder / "images")
    frames = []
    for file in sorted(cams.glob(f"*{SUFFIX}")):
        stem = file.name.removesuffix(SUFFIX)
        image = found.get(stem, folder / "images" / f"{stem}.jpg")
        frames.append(read_camera(file).frame(image, sizes=sizes, unit=unit))
    return frames


# --- DTU MVS, in millimetres ------------------------------------------------------------------
#
# MVSNet's training form has pictures VVV from 1 of seven lights (the fourth, L = 3, is read) and
# cameras N from 0, of 1600x1200 or, in ``Cameras/train``, of 160x128; its form for testing has
# ``cams``. IDR's and pixelNeRF's ``world_mat_i`` is K [R t]; ``scale_mat_i`` would shrink the
# scene and is left aside.

RECTIFIED, NPZ = "Rectified", "cameras.npz"
LIGHT = "3"
# Sizes of published pictures and of the maps that MVSNet computes, which cameras may be of.
DTU_SIZES = ((1600, 1200), (640, 512), (400, 300), (160, 128))


def _dtu_scenes(root: Path) -> tuple[str, ...]:
    found = list(root.glob(f"{RECTIFIED}/scan*/"))
    for pattern in (f"scan*/{NPZ}", f"*/scan*/{NPZ}", "scan*/cams/", "*/scan*/cams/"):
        found += [path.parent for path in root.glob(pattern)]
    return natural(path.relative_to(root).as_posix() for path in found)


@Layout.of_reader(
    "Rectified/scanN with Cameras, or scanN/cams with images, or scanN/cameras.npz with image",
    _dtu_scenes,
)
def _dtu(root: Path, scene: str) -> Scene:
    folder = root / scene
    if scene.startswith(f"{RECTIFIED}/"):
        frames = _rectified(root, folder)
    elif (folder / NPZ).is_file():
        frames = _idr(folder)
    else:
        frames = mvsnet_frames(folder, folder / "cams", sizes=DTU_SIZES, unit=MILLIMETRES)
    return posed_scene(folder, frames, poses="cam_from_world", metric=True, home=root)


def _rectified(root: Path, folder: Path) -> list[PosedFrame]:
    """Of MVSNet's training form."""
    reduced = folder.name.endswith("_train")
    cameras = root / "Cameras" / "train" if reduced else root / "Cameras"
    files = sorted(cameras.glob(f"*{SUFFIX}"))
    if not files:
        raise ProjectError(f"{cameras}: no camera files NNNNNNNN{SUFFIX}; complete the download")
    depths = root / ("Depths" if reduced else "Depths_raw") / folder.name
    # What stands for the light in the pictures' names; the fourth where it is there.
    names = (path.name for path in folder.glob("rect_*.png"))
    matches = (re.fullmatch(r"rect_\d{3}_(\w+)\.png", name) for name in names)
    lights = sorted({match[1] for match in matches if match})
    preferred = [light for light in lights if light.partition("_")[0] == LIGHT]
    light = next(iter(preferred or lights), f"{LIGHT}_r5000")
    frames = []
    for file in files:
        number = int(file.name.removesuffix(SUFFIX))
        image = folder / f"rect_{number + 1:03d}_{light}.png"
        frame = read_camera(file).frame(image, sizes=DTU_SIZES, unit=MILLIMETRES)
        if depths.is_dir():
            reader = partial(read_pfm_depth, unit=MILLIMETRES)
            depth = depths / f"depth_map_{number:04d}.pfm"
            frame = replace(frame, depth=depth, read_depth=reader)
        frames.append(frame)
    return frames


def _idr(folder: Path) -> list[PosedFrame]:
    """Of IDR's form."""
    prefix = "world_mat_"
    with reading(folder / NPZ, f"expected projection matrices {prefix}0, ...; copy it again"):
        matrices = {
            int(key.removeprefix(prefix)): np.asarray(matrix, np.float64)[:3, :4].reshape(3, 4)
            for key, matrix in load_arrays(folder / NPZ).items()
            if re.fullmatch(prefix + r"\d{1,9}", key)
        }
    home = folder / "image"
    by_stem = pictures_by_stem(home).items()
    by_number = {int(stem): path for stem, path in by_stem if stem.isdecimal()}
    frames = []
    for number in sorted(matrices):
        image = by_number.get(number, home / f"{number:06d}.png")
        with reading(f"{folder / NPZ}: {prefix}{number}", "expected a projection; copy it again"):
            camera = decomposed(matrices[number])
        frames.append(camera.frame(image, sizes=DTU_SIZES, unit=MILLIMETRES))
    return frames


def decomposed(projection: Float64) -> MvsCamera:
    """K and cam_from_world of a (3, 4) projection matrix K [R t], whatever its scale and sign."""
    from scipy.linalg import rq

    K, R = rq(projection[:, :3])
    sign = np.sign(np.diag(K))
    K, R = K * sign, R * sign[:, None]
    K = K / K[2, 2]
    if np.linalg.det(R) < 0:
        R = -R
    # K [R t] is the matrix up to a factor, which the first block tells.
    unit = K @ R
    scale = float((unit * projection[:, :3]).sum() / (unit * unit).sum())
    pose = rigid_poses(R, np.linalg.solve(K, projection[:, 3]) / scale)
    # Text and double precision leave a trace of skew.
    K[0, 1] = 0.0 if abs(K[0, 1]) < 1e-3 * K[0, 0] else K[0, 1]
    return MvsCamera(K, pose)


# --- Tanks and Temples ------------------------------------------------------------------------
#
# The official trajectory (``.log``) counts pictures in the order of their names, in ``SCENE`` or
# ``SCENE/images``; intrinsics are not published and have to be given. Or MVSNet's cameras, or a
# COLMAP model.

GIVEN = "intrinsics.txt"
CAMS = ("cams", "cams_1")
# MVSNet's inputs are reduced from these sizes.
TANKS_SIZES = ((1920, 1080), (1920, 1056), (2048, 1080))


def _tanks_scenes(root: Path) -> tuple[str, ...]:
    found = [
        folder
        for folder in (*root.glob("*"), *root.glob("*/*"))
        if folder.is_dir() and (_cams_of(folder) or find_model(folder) or _log_of(folder))
    ]
    # A model's own folders are no scenes.
    inner = {"sparse", "images", *CAMS}
    outer = [path for path in found if path.name not in inner and path.parent.name not in inner]
    return natural(path.relative_to(root).as_posix() for path in outer)


def _cams_of(folder: Path) -> Path | None:
    return next((folder / name for name in CAMS if (folder / name).is_dir()), None)


def _log_of(folder: Path) -> Path | None:
    return next(iter(sorted(folder.glob("*.log"))), None)


@Layout.of_reader(
    f"SCENE/*.log with {GIVEN}, SCENE/cams with images, or SCENE/sparse/0 with images",
    _tanks_scenes,
)
def _tanks_and_temples(root: Path, scene: str) -> Scene:
    folder = root / scene
    cams, log = _cams_of(folder), _log_of(folder)
    if cams is not None:
        frames = mvsnet_frames(folder, cams, sizes=TANKS_SIZES)
        return posed_scene(folder, frames, poses="cam_from_world", metric=False)
    if find_model(folder) is not None or log is None:
        return mipnerf360.read(root, scene)
    findings = [Finding("info", f"poses: {log.name}; intrinsics: {GIVEN}")]
    frames = _official(folder, log)
    return posed_scene(folder, frames, poses="world_from_cam", metric=False, findings=findings)


def _official(folder: Path, log: Path) -> list[PosedFrame]:
    """Pictures in natural order; a pose's first number says which, counted from 0."""
    home = folder / "images" if (folder / "images").is_dir() else folder
    files = list(pictures_by_stem(home).values())
    numbers, poses = read_log(log)
    if not (folder / GIVEN).is_file():
        raise ProjectError(
            f"{folder}: a trajectory without intrinsics, which the data set does not publish; "
            f"expected {GIVEN} with 3x3 numbers in pixels; write it, or give a COLMAP model"
        )
    K = load_matrix(folder / GIVEN, (3, 3), (4, 4))[:3, :3]
    if len(files) < len(numbers):
        # By the numbers in their names, from the official 000001 on, where some are gone.
        known = {int(path.stem): path for path in files if path.stem.isdecimal()}
        if len(known) < len(files) or 0 in known or max(known, default=0) > len(numbers):
            raise ProjectError(
                f"{home}: {len(files)} pictures for {len(numbers)} poses, which follow the "
                "pictures' order; complete the pictures, or name them 000001.jpg and so on"
            )
        files = [known.get(i + 1, home / f"{i + 1:06d}.jpg") for i in range(len(numbers))]
    by_number = dict(zip(numbers, poses, strict=True))
    lens = pinhole_lens(K, size_of_intrinsics(K, first_size(files) or (2, 2)))
    return [PosedFrame(file.name, file, lens, by_number.get(i)) for i, file in enumerate(files)]


LAYOUTS = (_dtu, _tanks_and_temples)
