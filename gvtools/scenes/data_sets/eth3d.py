"""ETH3D, high-resolution multi-view: ``SCENE/dslr_calibration_undistorted`` with ``images``.

The undistorted pictures (``images/dslr_images_undistorted``) are read where they are there, else
the original ones (``dslr_calibration_jpg``, a fisheye model) are undistorted here. Depth
(``ground_truth_depth/dslr_images/NAME``: raw 4-byte floats row by row, infinite for none, metres)
was rendered for the *original* pictures. It goes through the original camera to the undistorted
one, for which ``dslr_calibration_jpg`` is needed.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.colmap_files import has_model
from gvtools.scenes.colmap_model import ColmapModel, load_model
from gvtools.scenes.data_sets.colmap_pictures import colmap_pictures, colmap_scene
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import PosedPicture, natural
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.photographs import Depth
from gvtools.scenes.scene import Finding, Scene
from gvtools.scenes.undistort import Undistortion
from gvtools.untrusted import is_file, regular

UNDISTORTED, ORIGINAL = "dslr_calibration_undistorted", "dslr_calibration_jpg"
DEPTH = Path("ground_truth_depth") / "dslr_images"


def _scenes(root: Path) -> tuple[str, ...]:
    found = [
        path.parent
        for calibration in (UNDISTORTED, ORIGINAL)
        for pattern in (f"*/{calibration}/", f"*/*/{calibration}/")
        for path in root.glob(pattern)
        if has_model(path)
    ]
    return natural(path.relative_to(root).as_posix() for path in found)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    original = load_model(folder / ORIGINAL) if has_model(folder / ORIGINAL) else None
    model = original
    if has_model(folder / UNDISTORTED):
        undistorted = load_model(folder / UNDISTORTED)
        if original is None or _has_pictures(folder, undistorted):
            model = undistorted
    if model is None:
        raise ProjectError(f"{folder}: neither {UNDISTORTED} nor {ORIGINAL}; complete the download")
    pictures = colmap_pictures(model, lambda image: folder / "images" / image.name)
    findings = []
    if (folder / DEPTH).is_dir():
        if original is None:
            line = f"depth is of the original pictures and needs {ORIGINAL}, which is absent"
            findings.append(Finding("warning", line))
        else:
            pictures = _with_depth(folder / DEPTH, pictures, original=original, model=model)
    scene_read = colmap_scene(folder, model, pictures, metric=True)
    return replace(scene_read, findings=(*scene_read.findings, *findings))


def _has_pictures(folder: Path, model: ColmapModel) -> bool:
    return any(is_file(folder / "images" / image.name) for image in model.images)


def _with_depth(
    folder: Path, pictures: list[PosedPicture], *, original: ColmapModel, model: ColmapModel
) -> list[PosedPicture]:
    """The frames with their depth maps, which are of the original cameras."""
    source = {Path(image.name).name: original.lenses[image.camera_id] for image in original.images}
    target = {image.name: model.lenses[image.camera_id] for image in model.images}
    changes: dict[tuple[int, int], Undistortion] = {}
    found = []
    for picture in pictures:
        name = Path(picture.name).name
        if name not in source:
            found.append(picture)
            continue
        recorded = source[name]
        change = None
        if model is not original:
            key = id(recorded), id(target[picture.name])
            if key not in changes:
                changes[key] = Undistortion(recorded.source, target[picture.name].target, False)
            change = changes[key]
        reader = partial(read_raw_depth, size=recorded.source_size, lens=change)
        found.append(replace(picture, depth=folder / name, read_depth=reader))
    return found


def read_raw_depth(path: Path, *, size: tuple[int, int], lens: Undistortion | None = None) -> Depth:
    """A depth map of 4-byte floats without head.

    Args:
        path: the file.
        size: width and height of the original picture, pixels.
        lens: from the original camera to that of the picture at hand; None for the original.

    Returns:
        (H, W) float32 z-depth, metres, 0 where the file says infinity.
    """
    width, height = size
    try:
        values = np.fromfile(regular(path), "<f4")
    except OSError as error:
        raise ProjectError(f"{path}: unreadable ({error}); copy it again") from None
    if values.size != width * height:
        raise ProjectError(
            f"{path}: {values.size} floats; expected {width} x {height}, as the original camera "
            f"in {ORIGINAL} says; copy it again"
        )
    depth = values.reshape(height, width)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    return depth if lens is None else np.ascontiguousarray(lens.nearest(depth))


LAYOUT = Layout(f"SCENE/{UNDISTORTED} with SCENE/images", _scenes, _read)
