"""Mip-NeRF 360: ``SCENE/sparse/0`` with ``images`` and its copies ``images_2``, ``_4``, ``_8``.

The model's cameras are of the pictures in ``images``. The copies have another size, rounded to
whole pixels, so intrinsics follow each picture's own width and height. A scene is read from its
largest pictures; ``SCENE/images_4`` asks for a copy. The unit is COLMAP's, without metric scale.
"""

from __future__ import annotations

from pathlib import Path

from gvtools.scenes.colmap_files import find_model
from gvtools.scenes.colmap_model import RegisteredImage
from gvtools.scenes.data_sets.colmap_pictures import colmap_pictures, colmap_scene, model_in
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.picture_folders import (
    chosen_folder,
    picture_folders,
    pictures_by_stem,
    variants_of,
)
from gvtools.scenes.data_sets.posed_pictures import natural
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.scene import Scene


def _scenes(root: Path) -> tuple[str, ...]:
    folders = [path for path in root.glob("*") if path.is_dir()]
    return natural(p.name for p in folders if find_model(p) is not None and picture_folders(p))


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder, pictures = chosen_folder(root, scene)
    model = model_in(folder)
    by_stem = pictures_by_stem(pictures)

    def picture_of(image: RegisteredImage) -> Path:
        exact = pictures / image.name
        return exact if exact.is_file() else by_stem.get(Path(image.name).stem, exact)

    return colmap_scene(folder, model, colmap_pictures(model, picture_of))


def _variants(root: Path) -> tuple[str, ...]:
    return variants_of(root, _scenes(root))


LAYOUT = Layout("SCENE/sparse/0 with SCENE/images or images_N", _scenes, _read, _variants)
