"""What a trade-off varies: settings of a run, each with a few values, cheapest first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gvtools.completers.base import create
from gvtools.depth.source import RecordedDepth
from gvtools.errors import GvError
from gvtools.scenes.reduced import SMALLEST

if TYPE_CHECKING:
    from pipelines.reconstruction.plan import Plan
    from pipelines.reconstruction.settings import RunSettings

Settings = Mapping[str, Any]
# Of the voxel edge that the run has.
EDGES = (2.0, 1.0, 0.5)


@dataclass(frozen=True)
class SearchAxis:
    """One part of a run that can be cheaper or costlier.

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
    config = plan.config
    voxel, far = config.voxel, config.memory.voxels_per_footprint
    assert voxel is not None
    side = longest_side(plan)
    sides = [size for size in (side // 2,) if size >= 2 * SMALLEST]
    axes = [
        _axis("voxel edge", "voxel", [float(f"{share * voxel:.4g}") for share in EDGES],
              start=voxel),
        _axis("far voxels, footprints", "memory.voxels_per_footprint",
              (2 * far or 1.0, far, 0.0), start=far),
        _axis("observations a voxel", "memory.observations_per_voxel", (4, 12, 48),
              start=config.memory.observations_per_voxel),
        _axis("merging angle, degrees", "memory.merge_angle_deg", (8.0, 2.0, 0.0),
              start=config.memory.merge_angle_deg),
        SearchAxis("projection", (
            ("one pixel a point", {"splat.backend": "nearest"}),
            ("as given", {}),
            ("blended, 4 views first", {"splat.nearest_views": 4}),
        )),
        _completers(config),
        _axis("views a round", "views_per_round", (3, 6, 12), start=config.views_per_round),
        SearchAxis("picture size", (
            *((f"{size} px", {"max_side": size}) for size in sides), (f"{side} px", {}))),
    ]  # fmt: skip
    if config.completer != "none":
        axes.append(_axis("least confidence that is fused", "fusion.min_confidence",
                          (0.35, 0.08), start=config.fusion.min_confidence))  # fmt: skip
    if config.completer == "geoverse":
        axes += _core_axes(config)
    if plan.source.name != RecordedDepth.name:
        axes.append(_axis("views explained, share of pixels", "savings.depth_from_memory",
                          (0.8, 0.9, None), start=config.savings.depth_from_memory))  # fmt: skip
    if plan.source.name == "plane-sweep":
        axes += [
            _axis("stereo planes", "stereo.planes", (32, None), start=config.stereo.planes),
            _axis("stereo sources", "stereo.sources", (2, 4), start=config.stereo.sources),
            _axis(
                "stereo picture size", "stereo.max_side", (320, 640), start=config.stereo.max_side
            ),
            _axis("stereo iterations", "stereo.iterations", (0, 1), start=config.stereo.iterations),
        ]
    return [axis for axis in axes if len(axis.values) > 1]


def longest_side(plan: Plan) -> int:
    """Of a run's pictures, pixels."""
    cameras = plan.targets.cameras
    return max(int(cameras.width.max()), int(cameras.height.max()))


def _core_axes(config: RunSettings) -> list[SearchAxis]:
    """Of a run that the generative core completes."""
    from gvtools.completers.geoverse.completer import GeoVerseCompleter
    from gvtools.completers.geoverse.weights.folder import config_of

    given = config.completer_options
    completer = create("geoverse", **given)
    assert isinstance(completer, GeoVerseCompleter)
    core = config_of(completer.folder)
    steps = int(given.get("steps") or len(core.flow.level1))
    size = int(given["image_size"]) if given.get("image_size") else None
    return [
        _axis("generative steps", "completer.steps", (1, 3, 6), start=steps),
        _axis("model resolution, px", "completer.image_size", (core.image_size // 2, size),
              start=size),
        _axis("holes left to inpaint, share of the diagonal", "effort.inpaint_below",
              (0.1, 0.02, 0.0), start=config.effort.inpaint_below),
    ]  # fmt: skip


def _axis(name: str, key: str, values: Sequence[Any], *, start: Any) -> SearchAxis:
    """One setting; the start's own value takes its place among the numbers, or comes last."""
    values = list(dict.fromkeys(values))
    if start not in values:
        numbers = [value for value in values if value is not None]
        falling = numbers[0] > numbers[-1]
        if start is not None:
            numbers = sorted([*numbers, start], reverse=falling)
        values = [*numbers, None] if None in (*values, start) else numbers
    return SearchAxis(name, tuple(
        (f"{value:.4g}" if isinstance(value, float) else "as found" if value is None
         else str(value), {} if value == start else {key: value})
        for value in values
    ))  # fmt: skip


def _completers(config: RunSettings) -> SearchAxis:
    """Completers that this installation has, the run's own with its options."""
    names = [name for name in ("none", "inpaint", "geoverse") if name != config.completer]
    values: list[tuple[str, Settings]] = [
        (name, {"completer": name}) for name in names if _available(name)
    ]
    at = 0 if config.completer == "none" else 1 if config.completer == "inpaint" else len(values)
    values.insert(at, (config.completer, {}))
    return SearchAxis("completer", tuple(values))


def _available(name: str) -> bool:
    try:
        create(name)
    except GvError:
        return False
    return True
