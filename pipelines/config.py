"""The settings of a run: defaults, profile, file, then --set; unknown keys name the nearest."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

from pydantic_core import to_jsonable_python

from gvtools.depth.foundation.options import FoundationOptions
from gvtools.depth.stereo.options import StereoOptions
from gvtools.errors import OptionError
from gvtools.memory.back_projection import BackProjectionOptions
from gvtools.memory.spatial_memory import MemoryOptions
from gvtools.memory.splat.api import DEVICES, SplatOptions
from gvtools.options import check_range
from gvtools.scenes.reduced import SMALLEST
from gvtools.settings import Settings


@dataclass(frozen=True, kw_only=True)
class FusionOptions:
    """What is taken of depth and of completions.

    Attributes:
        min_confidence: generated pixels below this are not fused.
        max_scale_residual: a completion whose depth fits the memory's worse than this relative
            residual is refused.
        voxel_percentile: the automatic edge of the finest voxels follows this percentile of the
            context's pixel footprints; what is farther gets wider ones
            (``memory.voxels_per_footprint``).
        voxel_scale: how many such footprints the edge is.
        voxel_loss: of edges from half to four times the footprints', dB by which context views,
            predicted from their neighbours, may be worse than with the best one for a coarser one
            to be taken; None keeps the footprints'. Only views with recorded depth are asked.
    """

    min_confidence: float = 0.08
    max_scale_residual: float = 0.1
    voxel_percentile: float = 10.0
    voxel_scale: float = 1.0
    voxel_loss: float | None = 0.05

    def __post_init__(self) -> None:
        check_range("fusion.min_confidence", self.min_confidence, least=0, most=1)
        check_range("fusion.max_scale_residual", self.max_scale_residual, above=0)
        check_range("fusion.voxel_percentile", self.voxel_percentile, least=0, most=100)
        check_range("fusion.voxel_scale", self.voxel_scale, above=0)
        check_range("fusion.voxel_loss", self.voxel_loss, least=0)


@dataclass(frozen=True, kw_only=True)
class SavingsOptions:
    """What a run does not compute because the scene does not require it.

    The voxel edge (``fusion.voxel_loss``), wider voxels for what is far
    (``memory.voxels_per_footprint``) and
    what a voxel keeps (``memory.merge_angle_deg``, ``memory.observations_per_voxel``) are savings,
    too.

    Attributes:
        reuse: what observed views show of a target is not projected again after completions were
            fused; the pictures are the same.
        pixel_binning: 2 x 2 pixels become one point, their mean, where they are together at most
            this many voxel edges wide, unless the surface is steep; 0 lifts each by itself.
        minor_holes: a view with no unknown pixel farther than this share of the image diagonal from
            a known one is left to ``inpaint`` where the completer is a costly one (geoverse,
            exemplar); 0 leaves it none.
        one_step: targets that are completed together take one step of the generative core instead
            of the model's own number where none of their unknown pixels is farther than this share
            of the diagonal from a known one; 0 spares none.
        half_size: likewise, they are completed in pictures of half the model's size.
        no_prior: likewise, they are completed without the video prior of a model that has one.
        near_holes: steps of the generative core after the first one look at tokens near holes
            alone, where there is no video prior.
        depth_from_memory: a context view whose depth would have to be computed takes memory's
            instead where the views before it explain this share of its pixels; None computes all.
    """

    reuse: bool = True
    pixel_binning: float = 1.0
    minor_holes: float = 0.02
    one_step: float = 0.1
    half_size: float = 0.1
    no_prior: float = 0.1
    near_holes: bool = True
    depth_from_memory: float | None = 0.9

    def __post_init__(self) -> None:
        check_range("savings.depth_from_memory", self.depth_from_memory, above=0, most=1)
        check_range("savings.pixel_binning", self.pixel_binning, least=0)
        check_range("savings.minor_holes", self.minor_holes, least=0)
        check_range("savings.one_step", self.one_step, least=0)
        check_range("savings.half_size", self.half_size, least=0)
        check_range("savings.no_prior", self.no_prior, least=0)


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Everything that decides what a run computes.

    Attributes:
        context: which views are given (a selection).
        targets: which cameras to complete (a selection, a path such as ``orbit:24``, a trajectory
            file, or another project).
        views_per_round: targets a round takes at most.
        rounds: how many rounds; None takes as many as the targets need.
        max_side: longer side, pixels, that larger pictures are reduced to; None keeps all.
        depth: where the context's depth comes from, see gvtools.depth.choice.
        completer: by registered name.
        profile: fast, balanced or accurate.
        voxel: voxel edge, scene units; None derives it from the pixel footprints.
        seed: of everything random.
        device: auto, cpu or cuda.
        allow_overlap: whether a view may be context and target.
        back_projection: see BackProjectionOptions.
        memory: see MemoryOptions.
        stereo: see StereoOptions; of depth from photographs.
        da3: see FoundationOptions; of depth by Depth Anything 3.
        splat: see SplatOptions.
        fusion: see FusionOptions.
        savings: see SavingsOptions.
        completer_options: options of the completer by name.
    """

    context: str = "all"
    targets: str = "interpolate:12"
    views_per_round: int = 6
    rounds: int | None = None
    max_side: int | None = 1600
    depth: str = "auto"
    completer: str = "inpaint"
    profile: str = "balanced"
    voxel: float | None = None
    seed: int = 0
    device: str = "auto"
    allow_overlap: bool = False
    back_projection: BackProjectionOptions = field(default_factory=BackProjectionOptions)
    memory: MemoryOptions = field(default_factory=MemoryOptions)
    stereo: StereoOptions = field(default_factory=StereoOptions)
    da3: FoundationOptions = field(default_factory=FoundationOptions)
    splat: SplatOptions = field(default_factory=SplatOptions)
    fusion: FusionOptions = field(default_factory=FusionOptions)
    savings: SavingsOptions = field(default_factory=SavingsOptions)
    completer_options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_range("views_per_round", self.views_per_round, least=1)
        check_range("rounds", self.rounds, least=0)
        check_range("max_side", self.max_side, least=SMALLEST)
        check_range("voxel", self.voxel, above=0)
        check_range("seed", self.seed, least=0)
        if self.device not in DEVICES:
            raise OptionError(f"device {self.device!r}; expected one of {', '.join(DEVICES)}")

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        found: dict[str, Any] = to_jsonable_python(self)
        return found


# What each profile changes; "balanced" is the defaults.
PROFILES: dict[str, dict[str, Any]] = {
    "fast": {
        "max_side": 480,
        "views_per_round": 12,
        "savings.minor_holes": 0.05,
        "savings.one_step": 0.3,
        "savings.half_size": 0.3,
        "savings.no_prior": 0.3,
    },
    "balanced": {},
    "accurate": {
        "fusion.voxel_loss": 0.0,
        "savings.minor_holes": 0.0,
        "savings.one_step": 0.0,
        "savings.half_size": 0.0,
        "savings.no_prior": 0.0,
        "savings.near_holes": False,
        "savings.depth_from_memory": None,
        "memory.merge_angle_deg": 0.0,
        "memory.observations_per_voxel": 64,
    },
}


def with_profile(config: RunConfig, name: str) -> RunConfig:
    """``config`` with a profile's settings.

    Raises:
        OptionError: no such profile.
    """
    if name not in PROFILES:
        raise OptionError(f"profile {name!r}; expected one of {', '.join(PROFILES)}")
    for key, value in PROFILES[name].items():
        config = with_setting(config, key, value)
    return replace(config, profile=name)


def with_file(config: RunConfig, path: Path, *, profile: str | None = None) -> RunConfig:
    """``config`` with the settings of a JSON file (nested or dotted keys) over those of a profile.

    Args:
        config: to start from.
        path: the file.
        profile: in place of the one that the file may name.

    Raises:
        OptionError: unreadable, no JSON object, an unknown key or a wrong value.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OptionError(f"{path}: no readable JSON configuration ({error})") from None
    if not isinstance(data, dict):
        raise OptionError(f"{path}: holds a {type(data).__name__}; expected an object of settings")
    if profile is not None or "profile" in data:
        config = with_profile(config, str(data["profile"]) if profile is None else profile)
    for key, value in flat_settings(data):
        if key != "profile":
            config = with_setting(config, key, value)
    return config


def with_settings(config: RunConfig, texts: Iterable[str]) -> RunConfig:
    """``config`` with ``key=value`` texts applied in order.

    Raises:
        OptionError: a text without ``=``, an unknown key or a wrong value.
    """
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise OptionError(f"--set {text!r}; expected KEY=VALUE, such as splat.depth_band=0.03")
        if key.strip() == "profile":
            config = with_profile(config, value.strip())
        else:
            config = with_setting(config, key.strip(), value.strip())
    return config


def with_setting(config: RunConfig, key: str, value: Any) -> RunConfig:
    """``config`` with one dotted key changed; texts are converted to the field's type."""
    head, _, rest = key.partition(".")
    names = [entry.name for entry in fields(config)]
    if key == "completer.name":
        return with_setting(config, "completer", value)
    if head == "completer" and rest:
        options = {**config.completer_options, rest: value}
        return replace(config, completer_options=options)
    if head == "completer_options" and rest:
        return with_setting(config, f"completer.{rest}", value)
    if key == "completer_options" and not value:
        return replace(config, completer_options={})
    if head not in names or key == "completer_options":
        raise _unknown(key, config)
    current = getattr(config, head)
    if isinstance(current, Settings):
        if rest not in type(current).model_fields:
            raise _unknown(key, config)
        empty = str(value).lower() in ("none", "null", "auto")
        nullable = type(current).model_fields[rest].default is None
        return _with(
            config, head, current.replaced(**{rest: None if empty and nullable else value})
        )
    if is_dataclass(current) and not isinstance(current, type):
        known = [entry.name for entry in fields(current)]
        if rest not in known:
            raise _unknown(key, config)
        converted = _converted(key, get_type_hints(type(current))[rest], value)
        change: dict[str, Any] = {rest: converted}
        section = replace(current, **change)
        return _with(config, head, section)
    if rest:
        raise _unknown(key, config)
    return _with(config, head, _converted(key, get_type_hints(RunConfig)[head], value))


def changed_settings(config: RunConfig) -> dict[str, Any]:
    """The dotted settings by which ``config`` differs from the defaults, as a file takes them."""
    usual = dict(flat_settings(RunConfig().to_dict()))
    options = {f"completer.{key}": value for key, value in config.completer_options.items()}
    plain = flat_settings({**config.to_dict(), "completer_options": None})
    changed = {key: value for key, value in plain if key in usual and value != usual[key]}
    return {key: value for key, value in changed.items() if key != "profile"} | options


def difference(config: RunConfig, other: RunConfig) -> dict[str, Any]:
    """The dotted settings that make ``config`` the other one; not completers' nor the profile."""
    plain = (flat_settings({**c.to_dict(), "completer_options": None}) for c in (config, other))
    ours, theirs = map(dict, plain)
    return {key: value for key, value in theirs.items() if key != "profile" and ours[key] != value}


def _with(config: RunConfig, name: str, value: Any) -> RunConfig:
    changes: dict[str, Any] = {name: value}
    return replace(config, **changes)


def flat_settings(data: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Nested settings as dotted keys with their values."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from flat_settings(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _unknown(key: str, config: RunConfig) -> OptionError:
    known = [name for name, _ in flat_settings(config.to_dict())] + ["completer.OPTION"]
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"
    return OptionError(f"no setting {key!r}; {hint}")


def _converted(key: str, kind: Any, value: Any) -> Any:
    choices = getattr(kind, "__args__", None) or (kind,)
    empty = value is None or str(value).lower() in ("none", "null", "auto")
    if empty and type(None) in choices:
        return None
    for choice in choices:
        if choice is type(None):
            continue
        try:
            if choice is bool:
                if isinstance(value, bool) or str(value).lower() in ("true", "false"):
                    return str(value).lower() == "true"
            elif choice is int and float(value) == int(float(value)):
                return int(float(value))
            elif choice is float and not isinstance(value, bool):
                if math.isfinite(float(value)):
                    return float(value)
            elif choice is str:
                return str(value)
        except (TypeError, ValueError, OverflowError):
            continue
    names = ["auto" if choice is type(None) else choice.__name__ for choice in choices]
    raise OptionError(f"setting {key}={value!r}; expected {' or '.join(names)}")
