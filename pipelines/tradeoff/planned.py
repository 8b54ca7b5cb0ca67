"""What a trade-off tries: the run that was asked for, the profiles, single settings changed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from gvtools.depth.source import RecordedDepth
from gvtools.training.tune_options import FEWEST_VIEWS
from pipelines.tradeoff.trial import applied

if TYPE_CHECKING:
    from pipelines.reconstruction.plan import Plan

Settings = Mapping[str, Any]
START = "start"


def planned_trials(
    plan: Plan, profiles: Mapping[str, Settings], *, budget: float | None = None
) -> dict[str, Settings]:
    """Settings of each trial by its label, the start first; those that are like another are absent.

    Every trial completes pictures of the start's size.

    Args:
        plan: of a run with the settings that the sweep starts from and a voxel edge.
        profiles: settings that make the start to each of them.
        budget: seconds of a run; longer fits are not planned.
    """
    trials: dict[str, Settings] = {
        f"profile {name}": {key: value for key, value in settings.items() if key != "max_side"}
        for name, settings in profiles.items()
    }
    for key, values in _values(plan, budget or math.inf).items():
        trials |= {f"{key} {_shown(value)}": {key: value} for value in values}
    differing: dict[str, Settings] = {START: {}}
    made = [plan.config]
    for label, settings in trials.items():
        config = applied(plan.config, settings).replaced(profile=plan.config.profile)
        if config not in made:
            made.append(config)
            differing[label] = settings
    return differing


def _values(plan: Plan, budget: float) -> dict[str, tuple[Any, ...]]:
    """Values worth a trial, by the setting's name, cheapest first."""
    config = plan.config
    voxel, far = config.voxel, config.memory.voxels_per_footprint
    assert voxel is not None
    values: dict[str, tuple[Any, ...]] = {
        "voxel": (2 * voxel, voxel / 2),
        "memory.voxels_per_footprint": (2 * far or 1.0, 0.0),
        "memory.observations_per_voxel": (4, 12, 48),
        "memory.merge_angle_deg": (8.0, 2.0, 0.0),
        "splat.backend": ("nearest",),
        "splat.nearest_views": (4,),
        "completer": ("none", "inpaint", "geoverse"),
        "views_per_round": (3, 6, 12),
    }
    if config.refine.wanted:
        fits = (0.0, 20.0, 60.0, 180.0)
        values["refine.seconds"] = tuple(seconds for seconds in fits if seconds < budget)
    if config.completer != "none":
        values["fusion.min_confidence"] = (0.35, 0.08, 0.0)
    if config.completer == "geoverse":
        values |= {
            "completer.steps": (1, 3),
            "completer.image_size": (252,),
            "effort.inpaint_below": (0.1, 0.02, 0.0),
        }
    tunable = plan.completer.weights is not None and len(plan.context) >= FEWEST_VIEWS
    if tunable and config.tune.steps is None:
        values["tune.minutes"] = (0.0, 1.0, 4.0)
    if plan.source.name != RecordedDepth.name:
        values["savings.depth_from_memory"] = (0.8, 0.9, None)
    if plan.source.name == "plane-sweep":
        values |= {
            "stereo.planes": (32, None),
            "stereo.sources": (2, 4),
            "stereo.max_side": (320, 640),
            "stereo.iterations": (0, 1),
        }
    return values


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value).lower()
