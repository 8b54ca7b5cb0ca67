"""What a rendered view is worth: its time, its coverage, and its figures against a picture."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from typing import Any

from gvtools.appearance.appearance import Appearance, applied
from gvtools.cameras import Cameras
from gvtools.evaluation.lpips_distance import Lpips
from gvtools.evaluation.view_figures import FIGURES, view_figures
from gvtools.guidance import Guidance
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.scenes.scene import Frame


def render_view(
    memory: SpatialMemory,
    camera: Cameras,
    options: SplatOptions,
    *,
    appearance: Appearance | None = None,
) -> tuple[Guidance, float]:
    """One projection, with the colours of an appearance if there is one, and its seconds."""
    start = time.perf_counter()
    guidance = memory.project(camera, options=options)
    if appearance is not None:
        guidance = applied(appearance.picture(camera), guidance, blend=appearance.blend)
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

    Args:
        name: the view's.
        guidance: a batch of one.
        frame: the picture, and depth where there is some, of the same camera.
        seconds: what the projection took.
        lpips: the network; None leaves LPIPS out.
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
