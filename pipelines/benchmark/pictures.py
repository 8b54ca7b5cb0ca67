"""Pictures of a benchmark's targets: compared within masks, and kept small for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.errors import ProjectError
from gvtools.files import make_folder, replaced_when_written
from pipelines.benchmark.scenes import object_mask_path

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from gvtools.evaluation.published import Benchmark
    from gvtools.scenes.scene import Scene

# Longer side of a thumbnail, pixels.
SIDE = 400


def pictures_folder(folder: Path, scene: str, *, views: int) -> Path:
    """Where another method's pictures of a scene lie: DIR/SCENE/N_views, DIR/SCENE or DIR."""
    places = (folder / scene / f"{views}_views", folder / scene)
    return next((place for place in places if place.is_dir()), folder)


def object_mask(
    benchmark: Benchmark, root: Path, *, scene: str, index: int, shape: tuple[int, int]
) -> np.ndarray | None:
    """(H, W) bool, the object in a view; None where the benchmark has no mask of it.

    White is the object, as RegNeRF's evaluation reads it; the nearest pixel is taken.
    """
    from PIL import Image

    path = object_mask_path(benchmark, root, scene=scene, index=index)
    if path is None:
        return None
    try:
        with Image.open(path) as picture:
            levels = picture.convert("RGB").resize(shape[::-1], Image.Resampling.NEAREST)
            return np.array(levels).min(axis=2) == 255
    except (OSError, SyntaxError, ValueError) as error:
        raise ProjectError(f"{path}: no readable mask ({error})") from None


def masked_figures(
    pictures: Mapping[str, np.ndarray],
    scene: Scene,
    masks: Mapping[str, np.ndarray | None],
    *,
    lpips: Lpips | None,
) -> dict[str, float | None]:
    """PSNR of the object's pixels; SSIM and LPIPS of pictures that are white outside it.

    Args:
        pictures: (H, W, 3) uint8 by target.
        scene: with the true pictures.
        masks: (H, W) bool by target; None where there is none.
        lpips: the network; None leaves LPIPS out.

    Returns:
        Means over the targets; nothing where a target has no mask.
    """
    from gvtools.evaluation.images import psnr, ssim

    if not masks or any(mask is None for mask in masks.values()):
        return {}
    rows: list[dict[str, float | None]] = []
    for name, picture in pictures.items():
        truth, mask = scene[name].load().rgb, masks[name]
        assert mask is not None
        outside = ~mask[..., None]
        ours, true = (np.where(outside, np.uint8(255), p) for p in (picture, truth))
        distance = None if lpips is None else lpips.distance(ours, true)[0]
        row = {"psnr": psnr(picture, truth, mask=mask), "ssim": ssim(ours, true), "lpips": distance}
        rows.append(row)
    return {f"{name}_masked": _mean([row[name] for row in rows]) for name in rows[0]}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def write_thumbnails(
    result: Path, pictures: Mapping[str, np.ndarray], scene: Scene, *, context: Sequence[str]
) -> None:
    """Small pictures of the middle target beside a cell's figures, for the page.

    ``METHOD.jpg`` and ``METHOD.error.jpg`` are the method's, ``.truth.jpg`` and ``.context.jpg``
    are shared by all methods.

    Args:
        result: the cell's file of figures.
        pictures: (H, W, 3) uint8 by target, in their order.
        scene: with the true pictures.
        context: names of the given views, in order.
    """
    from viz.report.contact_sheet import error_map

    name = middle(list(pictures))
    truth = scene[name].load()
    error = error_map(pictures[name], truth.rgb, mask=truth.mask)
    given = scene[middle(context)].load().rgb
    for ending, picture in {
        f"{result.stem}.jpg": pictures[name],
        f"{result.stem}.error.jpg": error,
        ".truth.jpg": truth.rgb,
        ".context.jpg": given,
    }.items():
        _write(result.parent / ending, picture)


def middle(names: Sequence[str]) -> str:
    """The one in the middle: chosen before anything is measured."""
    return names[len(names) // 2]


def _write(path: Path, picture: Any) -> None:
    from PIL import Image

    make_folder(path.parent)
    image = Image.fromarray(picture)
    image.thumbnail((SIDE, SIDE), Image.Resampling.BOX)
    with replaced_when_written(path) as temporary:
        image.save(temporary, format="JPEG", quality=85)
