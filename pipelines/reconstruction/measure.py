"""Figures of a run against the true pictures of its targets, where it has them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.evaluation.view_figures import FIGURES, view_figures
from gvtools.runs.target_files import TargetFiles, read_target
from pipelines.reconstruction.prefetch import prefetch

if TYPE_CHECKING:
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.runs.folder import RunDirectory
    from gvtools.scenes.scene import Frame, View
    from pipelines.console import Console
    from pipelines.reconstruction.plan import Plan

TABLE = ("psnr", "psnr_valid", "psnr_generated", "ssim", "depth_rel_valid", "depth_rel_generated")
NO_LPIPS = "lpips is null here: gvtools evaluate measures it, where its weights are"


def measure_run(
    plan: Plan, memory: SpatialMemory, directory: RunDirectory, *, console: Console
) -> dict[str, Any]:
    """Means over the targets that have a truth, and the figures of each view.

    All figures are of the completed picture: ``_valid`` on the pixels that observations support,
    ``_generated`` on all others that it fills, by a completer's hand in this round or an earlier
    one. ``coverage`` is the share that memory supports before the round, ``coverage_after`` after
    it.
    """
    views = _figures_of_targets(plan, directory)
    notes = [NO_LPIPS]
    if not any("psnr" in view for view in views):
        notes.append("no target has a true picture, so there are no image figures")
    summary: dict[str, Any] = {name: mean_of(views, name) for name in FIGURES}
    summary |= {
        "coverage": mean_of(views, "coverage"),
        "coverage_after": mean_of(views, "coverage_after"),
        "targets": len(views),
        "observations": len(memory),
        "voxels": memory.voxels,
        "views": views,
        "notes": notes,
    }
    if views:
        _print(views, summary, console)
    return summary


def _print(views: list[dict[str, Any]], summary: dict[str, Any], console: Console) -> None:
    columns = ["target", "round", "coverage", "after", *TABLE]
    keys = ["name", "round", "coverage", "coverage_after", *TABLE]
    body = [[view.get(key) for key in keys] for view in views]
    mean = ["mean", None, *(summary[key] for key in keys[2:])]
    console.table(columns, [*body, mean])


def _figures_of_targets(plan: Plan, directory: RunDirectory) -> list[dict[str, Any]]:
    """Name, round, coverage and, where there is a true picture, figures of each target."""
    views: list[dict[str, Any]] = []
    reports = directory.reports()
    # Reports stand in the order of the rows, one entry a target.
    shown = [
        (number, entry, plan.targets.truth[row])
        for number, rows in enumerate(plan.schedule, start=1)
        for row, entry in zip(
            rows, reports[number]["views"] if number < len(reports) else [], strict=False
        )
    ]

    def read(item: tuple[int, dict[str, Any], View | None]) -> tuple[TargetFiles, Frame] | None:
        number, entry, truth = item
        if truth is None:
            return None
        return read_target(directory.round_path(number), entry), truth.load()

    for (number, entry, _), files in zip(shown, prefetch(read, shown), strict=True):
        figures = {
            "name": entry["name"],
            "round": number,
            "coverage": entry["coverage"],
            "coverage_after": entry["coverage_after"],
        }
        if files is not None:
            target, truth = files
            figures |= view_figures(
                target.picture,
                truth,
                observed=target.observed,
                generated=target.generated,
                depth=target.depth,
            )
        views.append(figures)
    return views


def mean_of(views: list[dict[str, Any]], name: str) -> float | None:
    """The mean over the views that have the figure."""
    values = [view[name] for view in views if view.get(name) is not None]
    return float(np.mean(values)) if values else None
