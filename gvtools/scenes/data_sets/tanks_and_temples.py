"""Tanks and Temples: the official trajectory, MVSNet's cameras, or a COLMAP model.

- ``SCENE/*.log`` (blocks of a number and a 4x4 world_from_cam) with the pictures in ``SCENE`` or
  ``SCENE/images`` in the order of their names. The data set publishes no intrinsics:
  ``SCENE/intrinsics.txt`` (3x3 or 4x4, pixels of the pictures) has to be given.
- ``SCENE/cams/NNNNNNNN_cam.txt`` or ``cams_1`` with ``SCENE/images`` (MVSNet).
- ``SCENE/sparse/0`` with ``SCENE/images`` or ``images_N``.

The unit is that of the reconstruction, without metric scale.
"""

from __future__ import annotations

from pathlib import Path

from gvtools.errors import ProjectError
from gvtools.scenes.colmap_files import find_model
from gvtools.scenes.data_sets import mipnerf360
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.mvsnet_cameras import (
    SUFFIX,
    picture_size,
    posed_picture,
    read_camera,
    size_of_intrinsics,
)
from gvtools.scenes.data_sets.picture_folders import pictures_by_stem
from gvtools.scenes.data_sets.posed_pictures import (
    PosedPicture,
    natural,
    pinhole_lens,
    posed_scene,
)
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.redwood import read_log
from gvtools.scenes.rgbd_recording import load_matrix
from gvtools.scenes.scene import Finding, Scene

INTRINSICS = "intrinsics.txt"
CAMS = ("cams", "cams_1")
# MVSNet's inputs are reduced from these sizes.
SIZES = ((1920, 1080), (1920, 1056), (2048, 1080))


def _scenes(root: Path) -> tuple[str, ...]:
    found = []
    for folder in (*root.glob("*"), *root.glob("*/*")):
        if folder.is_dir() and (_cams_of(folder) or find_model(folder) or _log_of(folder)):
            found.append(folder)
    # A model's own folders are no scenes.
    inner = {"sparse", "images", *CAMS}
    kept = [path for path in found if path.name not in inner and path.parent.name not in inner]
    return natural(path.relative_to(root).as_posix() for path in kept)


def _cams_of(folder: Path) -> Path | None:
    return next((folder / name for name in CAMS if (folder / name).is_dir()), None)


def _log_of(folder: Path) -> Path | None:
    return next(iter(sorted(folder.glob("*.log"))), None)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    cams = _cams_of(folder)
    if cams is not None:
        return posed_scene(folder, _mvsnet(folder, cams), poses="cam_from_world", metric=False)
    log = _log_of(folder)
    if find_model(folder) is not None or log is None:
        return mipnerf360.LAYOUT.read(root, scene, spec)
    pictures, findings = _official(folder, log)
    return posed_scene(folder, pictures, poses="world_from_cam", metric=False, findings=findings)


def _mvsnet(folder: Path, cams: Path) -> list[PosedPicture]:
    home = folder / "images"
    found = pictures_by_stem(home) if home.is_dir() else {}
    pictures = []
    for file in sorted(cams.glob(f"*{SUFFIX}")):
        stem = file.name.removesuffix(SUFFIX)
        image = found.get(stem, home / f"{stem}.jpg")
        pictures.append(posed_picture(image.name, image, read_camera(file), sizes=SIZES, unit=1.0))
    return pictures


def _official(folder: Path, log: Path) -> tuple[list[PosedPicture], list[Finding]]:
    """Pictures in natural order; a pose's first number says which, counted from 0."""
    home = folder / "images" if (folder / "images").is_dir() else folder
    files = list(pictures_by_stem(home).values())
    numbers, poses = read_log(log)
    if not (folder / INTRINSICS).is_file():
        raise ProjectError(
            f"{folder}: a trajectory without intrinsics, which the data set does not publish; "
            f"expected {INTRINSICS} with 3x3 numbers in pixels; write it, or give a COLMAP model"
        )
    K = load_matrix(folder / INTRINSICS, (3, 3), (4, 4))[:3, :3]
    if len(files) < len(numbers):
        files = _numbered(files, home, numbers)
    by_number = dict(zip(numbers, poses, strict=True))
    size = size_of_intrinsics(
        K, next((s for f in files if (s := picture_size(f)) > (2, 2)), (2, 2))
    )
    pictures = [
        PosedPicture(file.name, file, pinhole_lens(K, size), by_number.get(i))
        for i, file in enumerate(files)
    ]
    return pictures, [Finding("info", f"poses: {log.name}; intrinsics: {INTRINSICS}")]


def _numbered(files: list[Path], home: Path, numbers: list[int]) -> list[Path]:
    """Pictures by the numbers in their names, from the official 000001 on, where some are gone."""
    known = {int(path.stem): path for path in files if path.stem.isdecimal()}
    if len(known) < len(files) or 0 in known or max(known, default=0) > len(numbers):
        raise ProjectError(
            f"{home}: {len(files)} pictures for {len(numbers)} poses, which follow the pictures' "
            "order; complete the pictures, or name them 000001.jpg and so on"
        )
    return [known.get(i + 1, home / f"{i + 1:06d}.jpg") for i in range(len(numbers))]


LAYOUT = Layout(
    f"SCENE/*.log with {INTRINSICS}, SCENE/cams with images, or SCENE/sparse/0 with images",
    _scenes,
    _read,
)
