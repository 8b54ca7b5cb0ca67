"""Figures of a run against the true pictures of its targets, where it has them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.round_files import SUPPORT_OBSERVED, read_png

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory
    from pipelines.console import Console
    from pipelines.plan import Plan
    from pipelines.run_directory import RunDirectory

FIGURES = (
    "psnr", "psnr_valid", "psnr_generated", "ssim", "depth_rel_valid", "depth_rel_generated",
)  # fmt: skip


def measure_run(
    plan: Plan, memory: SpatialMemory, directory: RunDirectory, console: Console
) -> dict[str, Any]:
    """Means over the targets that have a truth, and the figures of each view.

    ``psnr`` and ``ssim`` are of the completed picture, on all pixels. ``_valid`` is of the memory,
    on the pixels that observations support; ``_generated`` of the completed picture, on all others
    that it fills, by a completer's hand in this round or an earlier one. ``coverage`` is the share
    that memory supports before the round, ``coverage_after`` after it.
    """
    views: list[dict[str, Any]] = []
    reports = directory.reports()
    for number, rows in enumerate(plan.schedule, start=1):
        # Reports stand in the order of the rows, one entry a target.
        entries = reports[number]["views"] if number < len(reports) else []
        for row, entry in zip(rows, entries, strict=False):
            truth = plan.targets.truth[row]
            figures = {
                "name": entry["name"],
                "round": number,
                "coverage": entry["coverage"],
                "coverage_after": entry["coverage_after"],
            }
            if truth is not None:
                figures |= _against(truth, directory.round_path(number), entry["stem"])
            views.append(figures)
    notes = ["lpips is null: no perceptual network is part of this version"]
    if not any("psnr" in view for view in views):
        notes.append("no target has a true picture, so there are no image figures")
    summary: dict[str, Any] = {name: mean_of(views, name) for name in FIGURES}
    summary |= {
        "lpips": None,
        "coverage": mean_of(views, "coverage"),
        "coverage_after": mean_of(views, "coverage_after"),
        "targets": len(views),
        "observations": len(memory),
        "voxels": memory.voxels,
        "views": views,
        "notes": notes,
    }
    if views:
        columns = ["target", "round", "coverage", "after", *FIGURES]
        keys = ["name", "round", "coverage", "coverage_after", *FIGURES]
        body = [[view.get(key) for key in keys] for view in views]
        mean = ["mean", None, *(summary[key] for key in keys[2:])]
        console.table(columns, [*body, mean])
    return summary


def mean_of(views: list[dict[str, Any]], name: str) -> float | None:
    """The mean over the views that have the figure."""
    values = [view[name] for view in views if view.get(name) is not None]
    return float(np.mean(values)) if values else None


def _against(truth: Any, folder: Path, stem: str) -> dict[str, Any]:
    from gvtools.evaluation.images import psnr, relative_depth_error, ssim

    frame = truth.load()
    reference = frame.rgb.astype(np.float32) / 255
    completed = read_png(folder / f"generated_{stem}.png").astype(np.float32) / 255
    guidance = read_png(folder / f"guidance_{stem}.png").astype(np.float32) / 255
    observed = read_png(folder / f"valid_{stem}.png") == SUPPORT_OBSERVED
    usable = np.ones_like(observed) if frame.mask is None else frame.mask
    with np.load(folder / f"depth_{stem}.npz", allow_pickle=False) as stored:
        known, made = stored["guidance"], stored["completion"]
    figures: dict[str, Any] = {
        "psnr": psnr(completed, reference, mask=usable),
        "psnr_valid": psnr(guidance, reference, mask=observed & usable),
        "psnr_generated": psnr(completed, reference, mask=~observed & (made > 0) & usable),
        "ssim": ssim(completed, reference, mask=usable),
    }
    if frame.depth is not None:
        for key, depth, mask in (("valid", known, observed), ("generated", made, ~observed)):
            error = relative_depth_error(depth, frame.depth, mask=mask & usable)
            figures[f"depth_rel_{key}"] = error
    return figures
