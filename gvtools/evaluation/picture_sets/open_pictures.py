"""Whose layout a folder of pictures has, and its pictures."""

from __future__ import annotations

from pathlib import Path

from gvtools.errors import ProjectError
from gvtools.evaluation.picture_sets import gsplat, nerfbaselines, nerfstudio
from gvtools.evaluation.picture_sets.pictures import (
    Picture,
    PictureSet,
    image_files,
    plain_picture,
    read_rgb,
)
from gvtools.scenes.images import read_depth
from gvtools.scenes.scene import Frame

# Recognised in this order, by what no other layout has.
READERS = (
    nerfbaselines.predictions,
    gsplat.renders,
    nerfstudio.dataset_renders,
    nerfstudio.evaluation_renders,
)
RENDERED = ".rgb.png"


def open_pictures(path: Path) -> PictureSet:
    """The pictures at ``path``, in the layout of nerfstudio, gsplat, NerfBaselines, or a plain one.

    A plain folder holds the pictures, perhaps in folders of its own. Beside ``NAME.rgb.png`` a
    ``NAME.depth.npz`` (z-depth, scene units, key ``depth``) is read, as ``gvtools render`` writes
    them; a picture ``NAME.png`` may have a ``NAME.depth.npz`` as well.

    Args:
        path: a folder, or a .tar.gz of NerfBaselines.
    """
    if not path.exists():
        raise ProjectError(f"{path}: no such folder; expected a folder of pictures")
    if path.is_file() and not path.name.endswith(".tar.gz"):
        raise ProjectError(
            f"{path}: is a file; expected a folder of pictures, or predictions.tar.gz of "
            "NerfBaselines"
        )
    for reader in READERS:
        if found := reader(path):
            return found
    files = image_files(path)
    rendered = [file for file in files if file.name.endswith(RENDERED)]
    if rendered:
        pictures = tuple(_rendered(file, path, RENDERED) for file in rendered)
        return PictureSet(path, "gvtools render", pictures)
    if not files:
        raise ProjectError(f"{path}: no pictures; expected PNG or JPEG files")
    return PictureSet(path, "plain folder", tuple(_plain(file, path) for file in files))


def _plain(file: Path, folder: Path) -> Picture:
    if file.with_suffix(".depth.npz").is_file():
        return _rendered(file, folder, file.suffix)
    return plain_picture(file, folder)


def _rendered(file: Path, folder: Path, ending: str) -> Picture:
    """A picture with its depth beside it, if there is any; named without ``ending``."""
    stem = file.name.removesuffix(ending)
    depth = file.with_name(f"{stem}.depth.npz")
    return Picture(
        file.relative_to(folder).with_name(stem + file.suffix).as_posix(),
        lambda: Frame(read_rgb(file), read_depth(depth) if depth.is_file() else None),
    )
