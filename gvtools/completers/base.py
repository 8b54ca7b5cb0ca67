"""What fills the holes of projected memory: the contract, its data, and the registry by name.

A completer is added with one file, which holds a subclass of ``Completer``, and one line in
``_REGISTRY``. Its module is imported when the completer is created, not before.
"""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.completers.scale_alignment import ScaleAlignment
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance

if TYPE_CHECKING:
    from gvtools.kernels import KernelSet

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ContextView:
    """One observed view that a completer may look at.

    Attributes:
        name: the view's name in its scene.
        camera: a batch of one.
        rgb: (H, W, 3) float32 in [0, 1]; a photograph's uint8 is taken, too, and scaled.
        depth: (H, W) float32 z-depth, scene units, 0 = none; None when the view has no depth.
        confidence: (H, W) float32 >= 0 of the depth; None when unknown.
    """

    name: str
    camera: Cameras
    rgb: Float32
    depth: Float32 | None = None
    confidence: Float32 | None = None

    def __post_init__(self) -> None:
        if self.rgb.dtype == np.uint8:
            object.__setattr__(self, "rgb", self.rgb.astype(np.float32) / 255)
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
    def nonfinite_pixels(self) -> int:
        """How many pixels have a colour that is not finite; counted once."""
        # A sum is finite only where everything is, and takes a third of the time.
        with np.errstate(invalid="ignore"):
            total = self.rgb.sum(dtype=np.float64)
        return 0 if np.isfinite(total) else int((~np.isfinite(self.rgb)).any(-1).sum())


@dataclass(frozen=True, eq=False)
class Completion:
    """Completed target views. Where the guidance was valid, its rgb stands unchanged.

    (Not in ``whole`` views.) So does its depth there, unless the completer's depth is in a unit of
    its own, which the run finds by comparing it with the guidance's (``scale_alignment`` None).

    Attributes:
        rgb: (V, H, W, 3) float32 in [0, 1].
        depth: (V, H, W) float32 z-depth, scene units, 0 = none.
        confidence: (V, H, W) float32 in [0, 1]; below 1 where generated, 0 where nothing is known.
        rays: (V, H, W, 6) float32 Plücker rays in the world frame: unit direction d, then moment
            c x d (scene units), c the camera centre; None if the completer predicts none.
        scale_alignment: for each view, how the completer brought its depth into scene units; the
            generated depth of a refused view is 0. None, of a view or of all, leaves the alignment
            to the run, which compares depth with the memory's.
        whole: all pixels are generated anew, those that the memory shows, too.
    """

    rgb: Float32
    depth: Float32
    confidence: Float32
    rays: Float32 | None = None
    scale_alignment: tuple[ScaleAlignment | None, ...] | None = None
    whole: bool = False

    def __post_init__(self) -> None:
        shape = self.depth.shape
        if len(shape) != 3 or self.rgb.shape != (*shape, 3) or self.confidence.shape != shape:
            raise ShapeError(
                f"completion: rgb {self.rgb.shape}, depth {shape}, confidence "
                f"{self.confidence.shape}; expected (V, H, W, 3), (V, H, W) and (V, H, W)"
            )
        if self.scale_alignment is not None and len(self.scale_alignment) != shape[0]:
            raise ShapeError(
                f"completion: scale alignment of {len(self.scale_alignment)} views; "
                f"expected {shape[0]}"
            )
        if self.rays is not None and self.rays.shape != (*shape, 6):
            raise ShapeError(f"completion: rays {self.rays.shape}; expected {(*shape, 6)}")


class Completer(ABC):
    """Fills what memory does not know of the target views. A run makes one and keeps it.

    Attributes:
        name: under which it is registered.
        settings_type: its options, a subclass of ``gvtools.settings.Settings``; None if it has no
            options. Annotated ``type[Any]``, so that this module does not import pydantic.
        batches_targets: True: ``complete`` gets all targets of a round with equal image size at
            once. False: one target at a time, projected after the previous one was fused.
        costly: True leaves views with small holes to ``inpaint``, see ``EffortPolicy``.
        kernels: compiled kernels of its own, which a run compiles before its first round.
        settings: the options of this one.
    """

    name: str
    settings_type: ClassVar[type[Any] | None] = None
    batches_targets: bool = False
    costly: bool = False
    kernels: ClassVar[tuple[KernelSet, ...]] = ()

    def __init__(self, **options: Any) -> None:
        if self.settings_type is None and options:
            raise OptionError(f"completer {self.name}: no option {min(options)!r}; it has none")
        self.settings: Any = self.settings_type(**options) if self.settings_type else None

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that the result depends on, such as weights; resuming requires the same."""
        return ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings for the user, shown before a run starts."""
        return ()

    @property
    def weights(self) -> Path | None:
        """Folder of a GeoVerse model that can be tuned to a scene (option ``weights``), or None."""
        return None

    @abstractmethod
    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Complete all target views of ``guidance``.

        Args:
            context: observed views, in any number and of any size.
            guidance: the memory projected into the target cameras.
            seed: the same input and seed give the same bytes on the same machine.
        """


def check_views(context: Sequence[ContextView], guidance: Guidance) -> None:
    """Refuse colours or known depth with NaN or infinity: a network spreads one bad pixel to all.

    Args:
        context: their colours have to be finite; depth that is not finite counts as none.
        guidance: colour, depth and confidence have to be finite where it is valid.
    """
    shape = guidance.valid.shape
    if len(shape) != 3 or guidance.rgb.shape != (*shape, 3) or guidance.depth.shape != shape:
        raise ShapeError(
            f"guidance: rgb {guidance.rgb.shape}, depth {guidance.depth.shape}, valid {shape}; "
            "expected (V, H, W, 3), (V, H, W) and (V, H, W)"
        )
    wrong = {view.name: view.nonfinite_pixels for view in context}
    finite = np.isfinite(guidance.depth) & np.isfinite(guidance.confidence)
    colors = np.isfinite(guidance.rgb)
    # Channel by channel takes many times as long.
    if not colors.all():
        finite &= colors.all(-1)
    nonfinite = (guidance.valid & ~finite).sum(axis=(1, 2)).tolist()
    wrong |= dict(zip(guidance.cameras.names, nonfinite, strict=True))
    for name, count in wrong.items():
        if count:
            raise ShapeError(
                f"view {name}: {count} pixel(s) hold NaN or infinity; expected finite colours, and "
                "depth and confidence where memory is valid"
            )


def run_completer(
    completer: Completer, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
) -> Completion:
    """Call ``completer.complete`` and check what it returns.

    That is its type, shapes, finite values, and that pixels which are valid in ``guidance`` kept
    their colour, unless whole views were generated.

    Where memory does not suffice for all target views, they are completed in halves, and halves of
    these; context and seed stay the same.
    """
    completion = _completed(completer, context, guidance, seed=seed)
    if not isinstance(completion, Completion):
        found = type(completion).__name__
        raise ShapeError(f"completer {completer.name} returned a {found}; expected a Completion")
    if completion.depth.shape != guidance.valid.shape:
        raise ShapeError(
            f"completer {completer.name} returned depth {completion.depth.shape}; expected "
            f"{guidance.valid.shape} like the guidance"
        )
    for what in ("rgb", "depth", "confidence"):
        values = getattr(completion, what)
        if not np.isfinite(values).all():
            raise ShapeError(
                f"completer {completer.name}: {what} holds NaN or infinity; expected finite "
                "values, and a depth of 0 where there is none"
            )
    if not completion.whole and (completion.rgb != guidance.rgb)[guidance.valid].any():
        raise OptionError(
            f"completer {completer.name} changed colours where the guidance is valid; expected "
            "them unchanged there"
        )
    return completion


def _completed(
    completer: Completer, context: Sequence[ContextView], guidance: Guidance, *, seed: int
) -> Completion:
    """The completion of all views, in parts where memory does not suffice for the whole."""
    try:
        return completer.complete(context, guidance, seed=seed)
    except Exception as error:
        if not _lacks_memory(error):
            raise
        said = (str(error).splitlines() or ["out of memory"])[0]
    # Out here the error no longer holds the arrays of the attempt.
    count, (height, width) = len(guidance), guidance.valid.shape[1:]
    if count < 2:
        raise OptionError(
            f"completer {completer.name}: memory does not suffice for one view of {width}x{height} "
            f"({said}); expected smaller pictures: --max-side {max(width, height) // 2}, or "
            "another completer"
        )
    # Not copied: there is no memory for it.
    halves = (slice(count // 2), slice(count // 2, count))
    parts = [_completed(completer, context, guidance.select(rows), seed=seed) for rows in halves]
    if not all(isinstance(part, Completion) for part in parts):
        return parts[0]  # Its caller says what is wrong with it.
    try:
        return _joined(parts)
    except MemoryError as error:
        raise OptionError(
            f"completer {completer.name}: memory does not suffice for the results of {count} views "
            f"of {width}x{height} ({error}); expected fewer of them, as --views-per-round 1, or "
            "smaller pictures"
        ) from None


def _lacks_memory(error: Exception) -> bool:
    # Torch's allocator of the CPU raises a plain RuntimeError, CUDA's a class of its own.
    text = str(error).lower()
    lacks = "out of memory" in text or "can't allocate memory" in text
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and lacks)


def _joined(parts: Sequence[Completion]) -> Completion:
    """Completions of consecutive views as one."""
    rays = [part.rays for part in parts if part.rays is not None]
    aligned = [
        alignment
        for part in parts
        for alignment in part.scale_alignment or (None,) * len(part.depth)
    ]
    return Completion(
        np.concatenate([part.rgb for part in parts]),
        np.concatenate([part.depth for part in parts]),
        np.concatenate([part.confidence for part in parts]),
        rays=np.concatenate(rays) if len(rays) == len(parts) else None,
        scale_alignment=None if all(part.scale_alignment is None for part in parts)
        else tuple(aligned),
        whole=all(part.whole for part in parts),
    )  # fmt: skip


_REGISTRY: dict[str, type[Completer] | str] = {
    "none": "gvtools.completers.none:NoneCompleter",
    "inpaint": "gvtools.completers.inpaint:InpaintCompleter",
    "geoverse": "gvtools.completers.geoverse.completer:GeoVerseCompleter",
}


def register(name: str, kind: type[Completer] | str) -> None:
    """Make a completer known by ``name``.

    Args:
        name: a new name.
        kind: a subclass of ``Completer``, or "module:class" of one.

    Raises:
        OptionError: the name is taken by another one, or the string has no colon.
    """
    if isinstance(kind, str) and kind.count(":") != 1:
        raise OptionError(f"completer {name}: {kind!r}; expected 'module:class'")
    if _REGISTRY.get(name, kind) != kind:
        raise OptionError(
            f"completer {name}: the name is taken by {_REGISTRY[name]}; choose another"
        )
    _REGISTRY[name] = kind


def available() -> tuple[str, ...]:
    """The names that ``create`` knows, in order of registration."""
    return tuple(_REGISTRY)


def create(name: str, /, **options: Any) -> Completer:
    """The completer called ``name`` with its options, see its ``settings_type``."""
    return completer_type(name)(**options)


def options_of_all() -> list[Any]:
    """The default options of each completer that has some, to be listed."""
    kinds = [completer_type(name).settings_type for name in available()]
    return [kind.model_construct() for kind in kinds if kind is not None]


def completer_type(name: str) -> type[Completer]:
    """The class that is registered as ``name``."""
    if name not in _REGISTRY:
        near = difflib.get_close_matches(name, available(), n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(available())}"
        raise OptionError(f"no completer {name!r}; {hint}")
    kind: Any = _REGISTRY[name]
    if isinstance(kind, str):
        module, _, attribute = kind.partition(":")
        kind = getattr(import_module(module), attribute, None)
    if not (isinstance(kind, type) and issubclass(kind, Completer)):
        raise OptionError(
            f"completer {name}: {_REGISTRY[name]!r}; expected a subclass of Completer"
        )
    return kind
