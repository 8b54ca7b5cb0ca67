"""nerfstudio's pictures: ``ns-render dataset`` and ``ns-eval --render-output-path``.

``ns-render dataset`` writes ``OUT/SPLIT/OUTPUT/NAME`` for the outputs rgb, gt-rgb, depth and more,
NAME being the photograph's path below the folder that all photographs have in common, ending in
.jpg or .png (nerfstudio/scripts/render.py, DatasetRender). ``ns-eval`` writes ``NNNNNN-img.jpg``,
the truth on the left and the render on the right, and ``NNNNNN-depth.jpg``,
``NNNNNN-accumulation.jpg`` (VanillaPipeline.get_average_image_metrics; get_image_metrics_and_images
of nerfacto and splatfacto). NNNNNN counts the views of the split as the data set has them:
nerfstudio's own format in alphabetical order of the photographs' paths, which is taken here,
COLMAP's in the order of the images' numbers. The truths beside the renders tell where it differs.
Pictures of ``ns-render`` along a path (``00000.jpg``) are a plain folder.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.evaluation.picture_sets.pictures import (
    Picture,
    PictureSet,
    image_files,
    in_natural_order,
    left_half,
    read_rgb,
    right_half,
)
from gvtools.scenes.scene import Frame

SPLITS = ("test", "val", "train")
_CANVAS = re.compile(r"(\d{6})-img\.(jpg|png)", re.IGNORECASE)


def dataset_renders(path: Path) -> PictureSet | None:
    """The pictures of ``ns-render dataset``; None where the folder is none.

    Args:
        path: the folder of all splits, or of one.
    """
    splits = {split: path / split for split in SPLITS if (path / split / "rgb").is_dir()}
    folder = next(iter(splits.values()), path)
    if not (folder / "rgb").is_dir():
        return None
    notes = []
    if len(splits) > 1:
        notes.append(f"split {folder.name} taken; also there: {', '.join(list(splits)[1:])}")
    return PictureSet(
        path,
        "nerfstudio, ns-render dataset",
        tuple(_render(file, folder) for file in image_files(folder / "rgb")),
        notes=tuple(notes),
    )


def evaluation_renders(path: Path) -> PictureSet | None:
    """The pictures of ``ns-eval --render-output-path``; None where the folder is none."""
    canvases = [file for file in path.iterdir() if _CANVAS.fullmatch(file.name)]
    if not canvases:
        return None
    return PictureSet(
        path,
        "nerfstudio, ns-eval",
        tuple(canvas_picture(file, path) for file in in_natural_order(canvases, path)),
        alphabetical=True,
        notes=("renders are the right halves of the pictures, which are JPEG",),
    )


def canvas_picture(file: Path, folder: Path) -> Picture:
    """A picture whose left half is the truth and whose right half is the render."""
    name = file.relative_to(folder).as_posix()
    return Picture(name, partial(_right, file), partial(_left, file))


def _right(file: Path) -> Frame:
    return Frame(right_half(read_rgb(file), str(file)))


def _left(file: Path) -> NDArray[np.uint8]:
    return left_half(read_rgb(file), str(file))


def _render(file: Path, folder: Path) -> Picture:
    name = file.relative_to(folder / "rgb")
    truth = folder / "gt-rgb" / name
    return Picture(
        name.as_posix(),
        lambda: Frame(read_rgb(file)),
        partial(read_rgb, truth) if truth.is_file() else None,
    )
