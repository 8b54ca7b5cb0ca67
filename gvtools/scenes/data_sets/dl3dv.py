"""DL3DV: ``[SUBSET/]HASH/transforms.json`` of nerfstudio, with ``images_4`` or ``images_8``.

The file's intrinsics are of the full pictures and its paths name the folder ``images``, also where
only ``images_4`` (960P) or ``images_8`` (480P) was downloaded: paths are taken below the folder
that is there, and intrinsics follow each picture's own size. The benchmark keeps all of this in
``HASH/nerfstudio``. A download of the COLMAP cache alone (``HASH/colmap/sparse/0`` beside the
pictures) is read through the model. The unit is COLMAP's, without metric scale.
"""

from __future__ import annotations

from pathlib import Path

from gvtools.errors import ProjectError
from gvtools.scenes.colmap_files import find_model
from gvtools.scenes.colmap_model import RegisteredImage
from gvtools.scenes.data_sets.colmap_pictures import colmap_pictures, colmap_scene, model_in
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.nerfstudio_pictures import nerfstudio_pictures
from gvtools.scenes.data_sets.picture_folders import chosen_folder, picture_folders, variants_of
from gvtools.scenes.data_sets.posed_pictures import natural, posed_scene
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.scene import Scene
from gvtools.scenes.transforms_json import FILE

INSIDE = "nerfstudio"  # where the benchmark keeps a scene


def _scenes(root: Path) -> tuple[str, ...]:
    found = []
    for folder in (*root.glob("*"), *root.glob("*/*")):
        if not folder.is_dir() or folder.name == INSIDE:
            continue
        home = _home(folder)
        cameras = (home / FILE).is_file() or find_model(folder) is not None
        if cameras and picture_folders(home):
            found.append(folder.relative_to(root).as_posix())
    return natural(found)


def _home(folder: Path) -> Path:
    return folder / INSIDE if (folder / INSIDE).is_dir() else folder


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    inside = INSIDE if _is_benchmark(root, scene) else ""
    folder, pictures = chosen_folder(root, scene, inside=inside)
    file = folder / inside / FILE
    if file.is_file():
        frames = nerfstudio_pictures(file, lambda name: pictures / Path(name).name)
        return posed_scene(folder, frames, poses="world_from_cam", metric=False)
    if find_model(folder) is None:
        raise ProjectError(f"{folder}: neither {FILE} nor a COLMAP model; complete the download")
    model = model_in(folder)

    def picture_of(image: RegisteredImage) -> Path:
        return pictures / Path(image.name).name

    return colmap_scene(folder, model, colmap_pictures(model, picture_of))


def _is_benchmark(root: Path, scene: str) -> bool:
    named = root / scene
    return any((folder / INSIDE).is_dir() for folder in (named, named.parent) if folder != root)


def _variants(root: Path) -> tuple[str, ...]:
    scenes = _scenes(root)
    return tuple(
        name
        for scene in scenes
        for name in variants_of(
            root, [scene], inside=INSIDE if (root / scene / INSIDE).is_dir() else ""
        )
    )


LAYOUT = Layout("HASH/transforms.json with HASH/images_4 or images_8", _scenes, _read, _variants)
