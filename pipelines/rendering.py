"""Rendered views: their figures against pictures, and their files.

The files are NAME.rgb.png, NAME.depth.npz, NAME.valid.png and NAME.confidence.png. A confidence c
is drawn as the grey level 255 c / (1 + c): 1 is mid grey, and every c has its own side of it.
``depth.npz`` holds the key ``depth``, float32, scene units, 0 = none.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance, recolor
from gvtools.cameras import Cameras
from gvtools.evaluation.images import FIGURES, view_figures
from gvtools.evaluation.lpips_distance import Lpips
from gvtools.files import replaced_when_written
from gvtools.guidance import Guidance
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.scenes.scene import Frame


def render_view(
    memory: SpatialMemory,
    camera: Cameras,
    options: SplatOptions | None = None,
    *,
    appearance: Appearance | None = None,
) -> tuple[Guidance, float]:
    """One projection, with the colours of an appearance if there is one, and its seconds."""
    start = time.perf_counter()
    guidance = memory.project(camera, options=options)
    if appearance is not None:
        guidance = recolor(guidance, appearance.picture(camera), blend=appearance.blend)
    return guidance, time.perf_counter() - start


def measure(
    name: str,
    guidance: Guidance,
    frame: Frame | None,
    *,
    seconds: float,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """The figures of one view; those that need a picture are None without one.

    A picture's mask limits every comparison and leaves the coverage as it is. On all pixels, holes
    count as black.
    """
    figures: dict[str, Any] = {"view": name, "coverage": guidance.coverage, "seconds": seconds}
    figures |= dict.fromkeys(FIGURES)
    if frame is None:
        return figures
    generated = guidance.generated[0] & guidance.valid[0]
    return figures | view_figures(
        guidance.rgb[0],
        frame,
        observed=guidance.valid[0] & ~generated,
        generated=generated,
        depth=guidance.depth[0],
        lpips=lpips,
    )


def summary(
    views: Sequence[dict[str, Any]], *, compared: bool, no_lpips: str | None
) -> dict[str, Any]:
    """Means over the views that have a figure (time: median), with reasons for what is missing.

    ``no_lpips`` is the reason why there is no LPIPS; None where there is.
    """
    out: dict[str, Any] = {}
    notes: dict[str, str] = {}
    for key in FIGURES:
        values = [view[key] for view in views if view[key] is not None]
        out[key] = statistics.fmean(values) if values else None
        if not compared:
            notes[key] = "not compared: add --against-images"
        elif key.startswith("lpips") and no_lpips is not None:
            notes[key] = no_lpips
        elif not values:
            notes[key] = _reason(key)
        elif len(values) < len(views):
            notes[key] = f"mean of {len(values)} of {len(views)} views; the others have no figure"
        if out[key] == float("inf"):
            notes[key] = "infinite: the pictures are equal"
    out["coverage"] = statistics.fmean(view["coverage"] for view in views)
    out["views"] = len(views)
    out["seconds_per_view"] = statistics.median(view["seconds"] for view in views)
    out["per_view"] = list(views)
    out["notes"] = notes
    return out


def _reason(key: str) -> str:
    if key.endswith("generated"):
        return "no generated content in view, or no reference there"
    if key.startswith("depth"):
        return "no reference depth where the memory is in view"
    return "no pixel to compare"


def write_view(folder: Path, stem: PurePosixPath, guidance: Guidance) -> None:
    """Write the four files of one view; sub-folders of ``stem`` are made, too."""
    confidence = guidance.confidence[0].astype(np.float64)
    grey = np.round(255 * confidence / (1 + confidence)).astype(np.uint8)
    rgb = np.round(np.clip(guidance.rgb[0], 0, 1) * 255).astype(np.uint8)
    base = folder / stem
    _write_png(base.with_name(f"{base.name}.rgb.png"), rgb)
    _write_png(base.with_name(f"{base.name}.valid.png"), guidance.valid[0].astype(np.uint8) * 255)
    _write_png(base.with_name(f"{base.name}.confidence.png"), grey)
    path = base.with_name(f"{base.name}.depth.npz")
    with replaced_when_written(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, depth=guidance.depth[0].astype(np.float32))


def _write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    from PIL import Image

    with replaced_when_written(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG", compress_level=3)
