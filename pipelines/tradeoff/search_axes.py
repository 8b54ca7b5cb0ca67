"""What a trade-off varies: each knob's levels, from cheap to dear, as settings of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from gvtools.completers.base import create
from gvtools.depth.source import RecordedDepth
from gvtools.errors import GvError
from gvtools.scenes.reduced import SMALLEST

if TYPE_CHECKING:
    from gvtools.completers.geoverse.config import GeoVerseConfig
    from pipelines.reconstruction.plan import Plan

# Of the voxel edge that the run has.
EDGES = (4.0, 2.0, 1.0, 0.5)
# Level-1 steps of the generative core.
STEPS = (1, 3, 6)
Settings = Mapping[str, Any]
Point = tuple[int, ...]


@dataclass(frozen=True)
class Level:
    """One position of a knob.

    Attributes:
        name: as a table shows it.
        settings: dotted keys of a run's settings, and their values.
    """

    name: str
    settings: Settings = field(default_factory=dict)


@dataclass(frozen=True)
class Knob:
    """A part of a run that can be cheap or dear.

    Attributes:
        name: what it is.
        levels: from cheap to dear.
        usual: index of the level that the sweep starts from.
        delivered: longer side of the start's pictures, pixels, where cheaper levels deliver smaller
            ones rather than the same with less effort; 0 for any other knob.
        completer: the one that it belongs to; with others it changes nothing.
    """

    name: str
    levels: tuple[Level, ...]
    usual: int
    delivered: int = 0
    completer: str | None = None


def settings_of(knobs: Sequence[Knob], point: Point) -> dict[str, Any]:
    """The settings of one level of each knob; of a knob whose completer is not there none."""
    levels = [knob.levels[level] for knob, level in zip(knobs, point, strict=True)]
    named = [level.settings["completer"] for level in levels if "completer" in level.settings]
    out: dict[str, Any] = {}
    for knob, level in zip(knobs, levels, strict=True):
        if knob.completer is None or knob.completer in named:
            out |= level.settings
    return out


def delivers_less(knobs: Sequence[Knob], settings: Settings) -> bool:
    """Whether a run with these settings delivers less than the one that the sweep starts from."""
    side = settings.get("max_side")
    return side is not None and any(side < knob.delivered for knob in knobs)


def usual(knobs: Sequence[Knob]) -> Point:
    """Where a sweep starts."""
    return tuple(knob.usual for knob in knobs)


def neighbours(knobs: Sequence[Knob], point: Point) -> list[Point]:
    """Every point that differs from ``point`` in one knob."""
    return [
        (*point[:at], level, *point[at + 1 :])
        for at, knob in enumerate(knobs)
        for level in range(len(knob.levels))
        if level != point[at]
    ]


def knobs_of(plan: Plan) -> list[Knob]:
    """The knobs that change something in this run.

    Args:
        plan: of a run with the settings that the sweep starts from.
    """
    config = plan.config
    assert config.voxel is not None
    completers = _completers(plan)
    knobs = [
        Knob("voxel edge", tuple(_edge(config.voxel, share) for share in EDGES), EDGES.index(1.0)),
        _far_voxels(config.memory.voxels_per_footprint),
        _numbers("observations a voxel", "memory.observations_per_voxel",
                 (2, 4, 12, 48), config.memory.observations_per_voxel),
        _numbers("merging angle, degrees", "memory.merge_angle_deg",
                 (15.0, 8.0, 2.0, 0.0), config.memory.merge_angle_deg),
        Knob(
            "projection",
            (
                Level("one pixel a point", {"splat.backend": "nearest"}),
                Level("blended, first tiers alone", {"splat.occluders": False}),
                Level("blended", {}),
                Level("blended, 4 views first", {"splat.nearest_views": 4}),
            ),
            2,
        ),
        completers,
        _numbers("views a round", "views_per_round", (3, 6, 12), config.views_per_round),
    ]  # fmt: skip
    if config.completer != "none":
        knobs.append(
            _numbers("least confidence that is fused", "fusion.min_confidence",
                     (0.35, 0.2, 0.08), config.fusion.min_confidence)
        )  # fmt: skip
    side = max(int(plan.targets.cameras.width.max()), int(plan.targets.cameras.height.max()))
    sides = [size for size in (side // 2, 3 * side // 4) if size >= 2 * SMALLEST]
    knobs.append(
        Knob(
            "picture size",
            (*(Level(f"{size} px", {"max_side": size}) for size in sides), Level(f"{side} px")),
            len(sides),
            delivered=side,
        )
    )
    if "geoverse" in [level.settings["completer"] for level in completers.levels]:
        given = config.completer_options if config.completer == "geoverse" else {}
        core = _core(given)
        knobs += [
            replace(knob, completer="geoverse")
            for knob in (
                _numbers("holes left to inpaint, share of the diagonal", "savings.minor_holes",
                         (0.1, 0.05, 0.02, 0.0), config.savings.minor_holes),
                _values("cascade steps", "completer.cascade_steps", (1, 2, 4, None),
                        given.get("cascade_steps")),
                _values("model resolution, px", "completer.image_size",
                        (core.image_size // 2, 3 * core.image_size // 4, None),
                        given.get("image_size")),
                _values("precision", "completer.precision", ("bfloat16", "float32"),
                        given.get("precision", "auto")),
                *_priors(core, given, config.savings.no_prior),
            )
        ]  # fmt: skip
    if plan.source.name != RecordedDepth.name:
        knobs.append(
            _values("views explained, share of pixels", "savings.depth_from_memory",
                    (0.7, 0.8, 0.9, None), config.savings.depth_from_memory)
        )  # fmt: skip
    if plan.source.name == "plane-sweep":
        knobs += [
            _values("stereo planes", "stereo.planes", (16, 32, 64, None), config.stereo.planes),
            _numbers("stereo sources", "stereo.sources", (2, 4, 6), config.stereo.sources),
            _numbers("stereo picture size", "stereo.max_side",
                     (320, 480, 640, 960), config.stereo.max_side),
            _numbers("stereo iterations", "stereo.iterations", (0, 1, 2), config.stereo.iterations),
        ]  # fmt: skip
    return [knob for knob in knobs if len(knob.levels) > 1]


def _core(given: Mapping[str, Any]) -> GeoVerseConfig:
    """The generative core's configuration, with a run's options of it."""
    from gvtools.completers.geoverse.completer import GeoVerseCompleter
    from gvtools.completers.geoverse.weights.folder_parts import config_of

    core = create("geoverse", **given)
    assert isinstance(core, GeoVerseCompleter)
    return config_of(core.folder)


def _priors(core: GeoVerseConfig, given: Mapping[str, Any], spared: float) -> list[Knob]:
    """The video prior left out, used for large holes and for all, where the core has one."""
    if core.video is None:
        return []
    every = 1e6
    # The completer's own option stands above the run's.
    own = given.get("no_prior_holes")
    key = "savings.no_prior" if own is None else "completer.no_prior_holes"
    return [
        _numbers("holes without video prior, share of the diagonal", key,
                 (every, 0.1, 0.0), spared if own is None else float(own))
    ]  # fmt: skip


def _numbers(name: str, key: str, values: Sequence[float], start: float) -> Knob:
    """Levels by number, in the order given; the run's own value is one of them."""
    if start not in values:
        rising = values[0] < values[-1]
        values = sorted({*values, start}, reverse=not rising)
    levels = tuple(Level(f"{value:g}", {key: value}) for value in values)
    return Knob(name, levels, list(values).index(start))


def _values(name: str, key: str, values: Sequence[Any], start: Any) -> Knob:
    """Levels in the order given, None among them; the run's own value is one, if need be the last.

    None stands for what a run finds by itself, or for a saving that is off.
    """
    values = list(values) if start in values else [*values, start]
    levels = tuple(Level("none" if v is None else str(v), {key: v}) for v in values)
    return Knob(name, levels, values.index(start))


def _edge(voxel: float, share: float) -> Level:
    """As an edge, not as a share of the footprints: the sweep's runs need not find it again."""
    return Level(f"{share:g} x {voxel:.3g}", {"voxel": float(f"{share * voxel:.4g}")})


def _far_voxels(footprints: float) -> Knob:
    """How wide voxels may be, beyond the edge, in footprints of what they hold."""
    values = [float(f"{share * footprints:.4g}") for share in (2.0, 1.0, 0.5)]
    values = [*values, 0.0] if footprints else [1.0, 0.0]
    levels = tuple(
        Level(
            f"at most {value:g} footprints wide" if value else "as wide as near ones",
            {"memory.voxels_per_footprint": value},
        )
        for value in values
    )
    return Knob("far voxels", levels, 1)


def _completers(plan: Plan) -> Knob:
    """Completers that this installation has, cheap to dear; the run's own with its options."""
    config = plan.config
    options = {f"completer.{key}": value for key, value in config.completer_options.items()}
    own = Level(f"{config.completer} as given", {"completer": config.completer, **options})
    known: list[Level] = [Level(name, {"completer": name}) for name in ("none", "inpaint")]
    at = len(known)
    of_core = config.completer == "geoverse"
    # As many bounds as it has steps, and one more.
    bounds = len(_core(config.completer_options).flow.level1) if of_core else 0
    for steps in STEPS:
        settings: dict[str, Any] = {"completer": "geoverse", "completer.steps": steps}
        if of_core:
            settings = {**own.settings, **settings}
            if steps < bounds:
                at = len(known) + 1
        known.append(Level(f"geoverse {steps}+1", settings))
    if own.settings not in [level.settings for level in known]:
        known.insert(at if of_core else len(known), own)
    levels = [level for level in known if level is own or _available(level)]
    return Knob(
        "completer", tuple(levels), [level.settings for level in levels].index(own.settings)
    )


def _available(level: Level) -> bool:
    options = {
        key.partition(".")[2]: value
        for key, value in level.settings.items()
        if key.startswith("completer.")
    }
    try:
        create(str(level.settings["completer"]), **options)
    except GvError:
        return False
    return True
