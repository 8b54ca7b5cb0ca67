"""What fills the holes of projected memory: the protocol, its data, and the registry by name.

A completer is added with one file and one line in ``_FACTORIES``. Its options are the fields of a
dataclass; the module is imported when the completer is created, not before.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cached_property
from importlib import import_module
from typing import Any, Protocol, get_type_hints, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ContextView:
    """One observed view that a completer may look at.

    Attributes:
        name: the view's name in its scene.
        camera: a batch of one.
        rgb: (H, W, 3) float32 in [0, 1].
        depth: (H, W) float32 z-depth, scene units, 0 = none; None when the view has no depth.
        confidence: (H, W) float32 >= 0 of the depth; None when unknown.
    """

    name: str
    camera: Cameras
    rgb: Float32
    depth: Float32 | None = None
    confidence: Float32 | None = None

    def __post_init__(self) -> None:
        size = (int(self.camera.height[0]), int(self.camera.width[0]))
        if len(self.camera) != 1 or self.rgb.shape != (*size, 3):
            raise ShapeError(
                f"context view {self.name}: rgb {self.rgb.shape} with {len(self.camera)} camera(s) "
                f"of {size[1]}x{size[0]} pixels; expected one camera and rgb of its size"
            )
        for what, value in (("depth", self.depth), ("confidence", self.confidence)):
            if value is not None and value.shape != size:
                raise ShapeError(
                    f"context view {self.name}: {what} {value.shape}; expected {size} like rgb"
                )

    @cached_property
    def spoilt(self) -> int:
        """How many pixels have colours that are not finite; counted once."""
        # A sum is finite only where everything is, and takes a third of the time.
        with np.errstate(invalid="ignore"):
            total = self.rgb.sum(dtype=np.float64)
        return 0 if np.isfinite(total) else int((~np.isfinite(self.rgb)).any(-1).sum())


@dataclass(frozen=True, eq=False)
class Completion:
    """Completed target views. Where the guidance was valid, its rgb and depth stand unchanged.

    Attributes:
        rgb: (V, H, W, 3) float32 in [0, 1].
        depth: (V, H, W) float32 z-depth, scene units, 0 = none.
        confidence: (V, H, W) float32 in [0, 1]; below 1 where generated, 0 where nothing is known.
        rays: (V, H, W, 6) float32 Plücker rays, world frame, from completers that predict them.
        spent: what the completion cost and met, such as ``seconds``, ``steps``, ``unfilled``.
        support: for each view, what the scale of its generated depth stands on, by the completer's
            own account: "..." of its evidence, or "refused: ..." with the reason, and then its
            depth is 0 where it was generated. None, of a view or of all, where depth has no scale
            to find.
    """

    rgb: Float32
    depth: Float32
    confidence: Float32
    rays: Float32 | None = None
    spent: Mapping[str, float] = field(default_factory=dict)
    support: tuple[str | None, ...] | None = None

    def __post_init__(self) -> None:
        shape = self.depth.shape
        if len(shape) != 3 or self.rgb.shape != (*shape, 3) or self.confidence.shape != shape:
            raise ShapeError(
                f"completion: rgb {self.rgb.shape}, depth {shape}, confidence "
                f"{self.confidence.shape}; expected (V, H, W, 3), (V, H, W) and (V, H, W)"
            )
        if self.support is not None and len(self.support) != shape[0]:
            raise ShapeError(
                f"completion: support of {len(self.support)} views; expected {shape[0]}"
            )
        if self.rays is not None and self.rays.shape != (*shape, 6):
            raise ShapeError(f"completion: rays {self.rays.shape}; expected {(*shape, 6)}")


@runtime_checkable
class Completer(Protocol):
    """Fills what memory does not know of the target views.

    One with ``joint`` = True gets all targets of a round at once. One with ``costly`` = True is
    spared views whose holes are small, and one with a field ``one_step_holes``,
    ``half_size_holes``, ``no_prior_holes`` or ``near_holes`` that is None is spared what those of
    middle size do not need (see ``sparing``). One that reads weights names them in an attribute
    ``files``: they decide the result. What a user should be told before a run may stand in
    ``notes``.
    """

    name: str

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Complete all target views of ``guidance``.

        Args:
            context: observed views, in any number and of any size.
            guidance: the memory projected into the target cameras.
            seed: the same input and seed give the same bytes on the same machine.
        """
        ...


def check_views(context: Sequence[ContextView], guidance: Guidance) -> None:
    """Refuse views whose numbers would spread from a pixel over all that is generated.

    Args:
        context: their colours have to be finite; depth that is not finite counts as none.
        guidance: colour, depth and confidence have to be finite where it is valid.

    Raises:
        ShapeError: they are not, or the guidance's arrays do not fit each other.
    """
    shape = guidance.valid.shape
    if len(shape) != 3 or guidance.rgb.shape != (*shape, 3) or guidance.depth.shape != shape:
        raise ShapeError(
            f"guidance: rgb {guidance.rgb.shape}, depth {guidance.depth.shape}, valid {shape}; "
            "expected (V, H, W, 3), (V, H, W) and (V, H, W)"
        )
    wrong = {view.name: view.spoilt for view in context}
    finite = np.isfinite(guidance.depth) & np.isfinite(guidance.confidence)
    colors = np.isfinite(guidance.rgb)
    # Channel by channel takes many times as long.
    if not colors.all():
        finite &= colors.all(-1)
    spoilt = (guidance.valid & ~finite).sum(axis=(1, 2)).tolist()
    wrong |= dict(zip(guidance.cameras.names, spoilt, strict=True))
    for name, count in wrong.items():
        if count:
            raise ShapeError(
                f"view {name}: {count} pixel(s) hold NaN or infinity; expected finite colours, and "
                "depth and confidence where memory is valid"
            )


_FACTORIES: dict[str, Callable[..., Completer] | str] = {
    "none": "gvtools.completers.none:NoneCompleter",
    "inpaint": "gvtools.completers.inpaint:InpaintCompleter",
    "exemplar": "gvtools.completers.exemplar:ExemplarCompleter",
    "geoverse": "gvtools.completers.geoverse.completer:GeoVerseCompleter",
}


def register(name: str, factory: Callable[..., Completer] | str) -> None:
    """Make a completer known by ``name``.

    Args:
        name: a new name.
        factory: a dataclass or callable that returns a completer, or "module:attribute" of one.

    Raises:
        OptionError: the name is taken by another factory, or the string has no colon.
    """
    if isinstance(factory, str) and factory.count(":") != 1:
        raise OptionError(f"completer {name}: {factory!r}; expected 'module:attribute'")
    if _FACTORIES.get(name, factory) != factory:
        raise OptionError(
            f"completer {name}: the name is taken by {_FACTORIES[name]}; choose another"
        )
    _FACTORIES[name] = factory


def available() -> tuple[str, ...]:
    """The names that ``create`` knows, in order of registration."""
    return tuple(_FACTORIES)


def create(name: str, /, **options: object) -> Completer:
    """The completer called ``name`` with its options.

    Args:
        name: one of ``available()``.
        options: values by field name; a text is converted to the field's type.

    Raises:
        OptionError: unknown name, unknown option (the nearest one is named), a required option
            that is absent, or a value that does not convert.
    """
    if name not in _FACTORIES:
        raise OptionError(f"no completer {name!r}; {_nearest(name, available())}")
    factory = _FACTORIES[name]
    if isinstance(factory, str):
        module, attribute = factory.split(":")
        factory = getattr(import_module(module), attribute)
    known, required = _option_types(factory)
    for key in options:
        if key not in known:
            hint = _nearest(key, tuple(known)) if known else "it has no options"
            raise OptionError(f"completer {name}: no option {key!r}; {hint}")
    for key in required:
        if key not in options:
            raise OptionError(f"completer {name}: option {key!r} is required and was not given")
    values = {key: _convert(name, key, known[key], value) for key, value in options.items()}
    return factory(**values)


def _option_types(factory: Callable[..., Completer]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The type of every option of a factory, and the options without a default."""
    if is_dataclass(factory):
        hints = get_type_hints(factory)
        options = [entry for entry in fields(factory) if entry.init]
        bare = tuple(
            entry.name
            for entry in options
            if entry.default is MISSING and entry.default_factory is MISSING
        )
        return {entry.name: hints[entry.name] for entry in options}, bare
    hints = get_type_hints(factory) if inspect.isfunction(factory) else {}
    parameters = inspect.signature(factory).parameters.values()
    bare = tuple(p.name for p in parameters if p.default is inspect.Parameter.empty)
    return {p.name: hints.get(p.name, Any) for p in parameters}, bare


def _convert(completer: str, key: str, kind: Any, value: object) -> object:
    """``value`` as the field's type; only lossless conversions."""
    choices = tuple(getattr(kind, "__args__", ())) or (kind,)
    if value is None and type(None) in choices:
        return None
    for choice in choices:
        if choice is Any or (isinstance(choice, type) and type(value) is choice):
            return value
    for choice in choices:
        if choice is float and type(value) is int:
            return float(value)
        if isinstance(value, str):
            text = value.strip()
            if choice is type(None) and text.lower() in ("none", "null"):
                return None
            if choice is bool and text.lower() in ("true", "false"):
                return text.lower() == "true"
            if choice in (int, float):
                try:
                    return choice(text)
                except ValueError:
                    continue
    expected = " or ".join(getattr(choice, "__name__", str(choice)) for choice in choices)
    raise OptionError(f"completer {completer}: option {key} = {value!r}; expected {expected}")


def _nearest(word: str, known: Sequence[str]) -> str:
    """A hint that names the closest of ``known``, or all of them."""
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
