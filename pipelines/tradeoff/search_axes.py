"""What a trade-off varies: settings of a run, each with a few values, cheapest first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gvtools.depth.source import RecordedDepth
from gvtools.scenes.reduced import SMALLEST

if TYPE_CHECKING:
    from pipelines.reconstruction.plan import Plan

Settings = Mapping[str, Any]
COMPLETERS = ("none", "inpaint", "geoverse")


@dataclass(frozen=True)
class SearchAxis:
    """One setting that can be cheaper or costlier.

    Attributes:
        name: as tables show it.
        values: name and settings of each value, cheapest first; the start's settings are {}.
    """

    name: str
    values: tuple[tuple[str, Settings], ...]


def search_axes(plan: Plan) -> list[SearchAxis]:
    """The axes that change something in this run.

    Args:
        plan: of a run with the settings that the sweep starts from and a voxel edge.
    """
    config, options = plan.config, plan.config.completer_options
    memory, stereo = config.memory, config.stereo
    voxel, far = config.voxel, memory.voxels_per_footprint
    assert voxel is not None
    side = longest_side(plan)
    sides = (side // 2, side) if side >= 4 * SMALLEST else (side,)
    axes = [
        _axis("voxel edge", "voxel", (2 * voxel, voxel, voxel / 2), start=voxel),
        _axis("far voxels, footprints", "memory.voxels_per_footprint",
              (2 * far or 1.0, far, 0.0), start=far),
        _axis("observations a voxel", "memory.observations_per_voxel", (4, 12, 48),
              start=memory.observations_per_voxel),
        _axis("merging angle, degrees", "memory.merge_angle_deg", (8.0, 2.0, 0.0),
              start=memory.merge_angle_deg),
        SearchAxis("projection", (
            ("one pixel a point", {"splat.backend": "nearest"}),
            ("as given", {}),
            ("blended, 4 views first", {"splat.nearest_views": 4}),
        )),
        SearchAxis("completer", tuple(
            (name, {} if name == config.completer else {"completer": name})
            for name in dict.fromkeys((*COMPLETERS, config.completer))
        )),
        _axis("views a round", "views_per_round", (3, 6, 12), start=config.views_per_round),
        _axis("picture size, px", "max_side", sides, start=side),
    ]  # fmt: skip
    if config.completer != "none":
        axes.append(_axis("least confidence that is fused", "fusion.min_confidence",
                          (0.35, 0.08), start=config.fusion.min_confidence))  # fmt: skip
    if config.completer == "geoverse":
        steps, size = (
            int(options[key]) if options.get(key) else None for key in ("steps", "image_size")
        )
        axes += [
            _axis("generative steps", "completer.steps", (1, 3, None), start=steps),
            _axis("model resolution, px", "completer.image_size", (252, None), start=size),
            _axis("holes left to inpaint, share of the diagonal", "effort.inpaint_below",
                  (0.1, 0.02, 0.0), start=config.effort.inpaint_below),
        ]  # fmt: skip
    if plan.source.name != RecordedDepth.name:
        axes.append(_axis("views explained, share of pixels", "savings.depth_from_memory",
                          (0.8, 0.9, None), start=config.savings.depth_from_memory))  # fmt: skip
    if plan.source.name == "plane-sweep":
        axes += [
            _axis("stereo planes", "stereo.planes", (32, None), start=stereo.planes),
            _axis("stereo sources", "stereo.sources", (2, 4), start=stereo.sources),
            _axis("stereo picture size", "stereo.max_side", (320, 640), start=stereo.max_side),
            _axis("stereo iterations", "stereo.iterations", (0, 1), start=stereo.iterations),
        ]
    return [axis for axis in axes if len(axis.values) > 1]


def longest_side(plan: Plan) -> int:
    """Of a run's pictures, pixels."""
    cameras = plan.targets.cameras
    return max(int(cameras.width.max()), int(cameras.height.max()))


def _axis(name: str, key: str, values: Sequence[Any], *, start: Any) -> SearchAxis:
    """One setting; the start's own value takes its place among the numbers, None comes last.

    Values that tables show alike are one value.
    """
    shown = {_shown(value): value for value in (*values, start)}
    given = [value for value in values if value is not None]
    numbers = [value for value in shown.values() if value is not None]
    ordered = sorted(numbers, reverse=given[0] > given[-1])
    if None in shown.values():
        ordered.append(None)
    return SearchAxis(name, tuple(
        (_shown(value), {} if value == start else {key: value}) for value in ordered
    ))  # fmt: skip


def _shown(value: float | None) -> str:
    return "default" if value is None else f"{value:.4g}"
