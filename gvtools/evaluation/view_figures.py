"""All figures of one view against its true picture: whole, on observed and on generated pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.errors import ShapeError
from gvtools.evaluation.images import image_figures, relative_depth_error

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from gvtools.scenes.scene import Frame

# Of each: the whole picture, what stands on observations, what a completer made.
SMALLEST = 32  # pixels a side, of a picture that LPIPS can be taken of
REGIONS = {"": "whole", "_valid": "observed", "_generated": "generated"}
FIGURES = (
    *(f"{figure}{region}" for region in REGIONS for figure in ("psnr", "ssim", "lpips")),
    "depth_rel_valid",
    "depth_rel_generated",
)


def view_figures(
    picture: NDArray[Any],
    truth: Frame,
    *,
    observed: NDArray[np.bool_],
    generated: NDArray[np.bool_],
    others: Mapping[str, NDArray[np.bool_]] | None = None,
    depth: ArrayLike | None = None,
    lpips: Lpips | None = None,
) -> dict[str, float | None]:
    """PSNR, SSIM, LPIPS and depth error of one picture.

    Args:
        picture: (H, W, 3) uint8, or floats in [0, 1]; holes are black, and count so on the whole
            picture.
        truth: the true picture; its mask limits every comparison, its depth is the reference.
        observed: (H, W) bool, pixels that stand on observations.
        generated: (H, W) bool, pixels that a completer made; never observed ones.
        others: (H, W) bool each, more regions by name; their figures end in ``_NAME``.
        depth: (H, W) z-depth of the picture, scene units, 0 = none.
        lpips: the network; None leaves LPIPS out. On a region it is the mean of the distance's
            map, which has no meaning for regions much smaller than the network's view. Pictures
            below 32 x 32 pixels have none.

    Returns:
        FIGURES by name, and those of ``others``; None where there is nothing to compare.
    """
    if picture.shape != truth.rgb.shape:
        raise ShapeError(f"the picture is {picture.shape}; its truth is {truth.rgb.shape}")
    shape = picture.shape[:2]
    use = np.ones(shape, np.bool_) if truth.mask is None else truth.mask
    generated = generated & ~observed
    regions = {"": use, "_valid": observed & use, "_generated": generated & use}
    regions |= {f"_{name}": mask & use for name, mask in (others or {}).items()}
    out: dict[str, float | None] = dict.fromkeys(FIGURES)
    found = image_figures(picture, truth.rgb, regions)
    for region, figures in found.items():
        out |= {f"{name}{region}": value for name, value in figures.items()}
    if lpips is not None and min(shape) >= SMALLEST:
        if picture.dtype != np.uint8:
            picture = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
        whole, spread = lpips.distance(picture, truth.rgb)
        for region, mask in regions.items():
            out[f"lpips{region}"] = float(spread[mask].mean()) if mask.any() else None
        if use.all():
            out["lpips"] = whole
    if depth is not None and truth.depth is not None:
        for region in ("_valid", "_generated"):
            error = relative_depth_error(depth, truth.depth, mask=regions[region])
            out[f"depth_rel{region}"] = error
    return out
