"""The contract of completers, which fill the holes of projected memory, and their registry.

A completer is added with one file, which holds a subclass of ``Completer``, and one line in
``_REGISTRY``. Its module is imported when the completer is created, not before.
"""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from enum import Enum
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance

if TYPE_CHECKING:
    from gvtools.kernels import KernelSet
    from gvtools.similarity import ScaleFit

Float32 = NDArray[np.float32]


class ScaleStatus(str, Enum):
    """How a view's generated depth was brought into scene units, or why it was refused."""

    words: str  # for the user

    def __new__(cls, value: str, words: str = "") -> ScaleStatus:
        """A member of a value, which finds it, and its words."""
        member = str.__new__(cls, value)
        member._value_, member.words = value, words
        return member

    MEMORY_DEPTH = "memory_depth", "one factor to the memory's depth"
    MEMORY_FIELD = "memory_field", "a smooth field of factors to the memory's depth"
    # No factor: they are in scene units.
    MEMORY_SURFACES = "memory_surfaces", "the memory's own surfaces, continued"
    CONTEXT_DEPTH = "context_depth", "the depth of the context views"
    CAMERA_CENTRES = "camera_centres", "the camera centres"
    NOTHING_TO_COMPLETE = "nothing_to_complete", "nothing to complete"
    UNSUPPORTED = "unsupported", "refused: too little to find a scale from"
    CONTRADICTED = "contradicted", "refused: known depth contradicts it"

    @property
    def accepted(self) -> bool:
        """Whether the view's generated depth may be fused."""
        return self not in (ScaleStatus.UNSUPPORTED, ScaleStatus.CONTRADICTED)


@dataclass(frozen=True)
class ScaleAlignment:
    """The outcome of bringing one view's generated depth into scene units; unknown figures: NaN."""

    status: ScaleStatus
    # Multiply the completion's depth by this to get scene units; NaN if refused.
    scale: float = 1.0
    # Median relative deviation from the memory's depth (0.01 = 1 %).
    residual: float = float("nan")
    # Pixels with both depths; 0 also where they were not counted.
    overlap_px: int = 0
    # Weighted share of these within the fit's tolerance, 0 to 1.
    inlier_share: float = float("nan")
    # Camera centres in the fit; 0 if none were used.
    centres: int = 0
    # Between predicted and given camera centres, -1 to 1.
    correlation: float = float("nan")

    @classmethod
    def of_fit(cls, fit: ScaleFit) -> ScaleAlignment:
        """The outcome of comparing a completion's depth with the memory's."""
        status = ScaleStatus.MEMORY_DEPTH
        if not fit.ok:
            compared = np.isfinite(fit.residual)
            status = ScaleStatus.CONTRADICTED if compared else ScaleStatus.UNSUPPORTED
        return cls(status, fit.scale, fit.residual, fit.support, fit.inlier_share)

    @property
    def accepted(self) -> bool:
        """Whether the depth may be fused."""
        return self.status.accepted

    def describe(self) -> str:
        """One line with the figures that are known."""
        figures = [f"{self.overlap_px} common pixels"]
        if np.isfinite(self.residual):
            figures.append(f"median deviation {self.residual:.1%}")
        if self.centres:
            figures.append(f"{self.centres} camera centres")
        if np.isfinite(self.correlation):
            figures.append(f"correlation {self.correlation:.2f}")
        return f"{self.status.words} ({', '.join(figures)})"

    def to_json(self) -> dict[str, Any]:
        """As a round's report holds it."""
        figures = asdict(self)
        status = figures.pop("status").value
        words = {"accepted": self.accepted, "description": self.describe()}
        return {"status": status, **words, **figures}


# What pixels have beside rows and columns: colours, and Plücker rays.
CHANNELS = {"rgb": (3,), "rays": (6,)}


def check_shapes(what: str, shape: tuple[int, ...], **images: NDArray[np.generic] | None) -> None:
    """Refuse images that have not ``shape`` and the channels of their name."""
    for name, image in images.items():
        expected = (*shape, *CHANNELS.get(name, ()))
        if image is not None and image.shape != expected:
            raise ShapeError(f"{what}: {name} {image.shape}; expected {expected}")


@dataclass(frozen=True, eq=False)
class ContextView:
    """One observed view that a completer may look at."""

    name: str
    camera: Cameras  # a batch of one
    rgb: Float32  # (H, W, 3) in [0, 1]; a photograph's uint8 is taken, too, and scaled
    depth: Float32 | None = None  # (H, W) z-depth, scene units, 0 = none
    confidence: Float32 | None = None  # (H, W) >= 0, of the depth; None when unknown

    def __post_init__(self) -> None:
        if self.rgb.dtype == np.uint8:
            object.__setattr__(self, "rgb", self.rgb.astype(np.float32) / 255)
        what = f"context view {self.name}"
        if len(self.camera) != 1:
            raise ShapeError(f"{what}: {len(self.camera)} cameras; expected one")
        size = int(self.camera.height[0]), int(self.camera.width[0])
        check_shapes(what, size, rgb=self.rgb, depth=self.depth, confidence=self.confidence)

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
    """

    rgb: Float32  # (V, H, W, 3) in [0, 1]
    depth: Float32  # (V, H, W) z-depth, scene units, 0 = none
    # (V, H, W) in [0, 1]; below 1 where generated, 0 where nothing is known.
    confidence: Float32
    # (V, H, W, 6) Plücker rays in the world frame: unit direction d, then moment c x d (scene
    # units), c the camera centre; None if the completer predicts none.
    rays: Float32 | None = None
    # For each view, how the completer brought its depth into scene units; the generated depth of a
    # refused view is 0. None, of a view or of all, leaves the alignment to the run, which compares
    # depth with the memory's.
    scale_alignment: tuple[ScaleAlignment | None, ...] | None = None
    # All pixels are generated anew, those that the memory shows, too.
    whole: bool = False

    def __post_init__(self) -> None:
        shape = self.depth.shape
        if len(shape) != 3:
            raise ShapeError(f"completion: depth {shape}; expected (V, H, W)")
        check_shapes("completion", shape, rgb=self.rgb, confidence=self.confidence, rays=self.rays)
        if self.scale_alignment is not None and len(self.scale_alignment) != shape[0]:
            raise ShapeError(
                f"completion: scale alignment of {len(self.scale_alignment)} views; "
                f"expected {shape[0]}"
            )

    @classmethod
    def of_memory(cls, guidance: Guidance) -> Completion:
        """What the memory knows, with holes of 0."""
        valid, nothing = guidance.valid, np.float32(0)
        return cls(
            np.where(valid[..., None], guidance.rgb, nothing),
            np.where(valid, guidance.depth, nothing),
            np.where(valid, np.minimum(guidance.confidence, 1), 0).astype(np.float32),
        )

    def select(self, index: Sequence[int] | slice) -> Completion:
        """Some views, in that order; a slice copies no image."""
        rows = index if isinstance(index, slice) else list(index)
        alignment = self.scale_alignment
        if alignment is not None:
            numbers = range(len(alignment))[rows] if isinstance(rows, slice) else rows
            alignment = tuple(alignment[row] for row in numbers)
        rays = None if self.rays is None else self.rays[rows]
        return Completion(
            self.rgb[rows], self.depth[rows], self.confidence[rows], rays, alignment, self.whole
        )

    @classmethod
    def joined(
        cls, parts: Iterable[tuple[Sequence[int], Completion]], cameras: Cameras
    ) -> Completion:
        """One completion of all of ``cameras``, of the rows and the completion of each part.

        Only one part need be in memory beside the whole. Where some predict rays, the others have
        those of their cameras.
        """
        images: list[Float32] = []
        rays: Float32 | None = None
        alignments: list[ScaleAlignment | None] = [None] * len(cameras)
        # A view that kept what the memory shows is not whole, so the others may not be taken so.
        whole = True
        for rows, part in parts:
            at, new = list(rows), (part.rgb, part.depth, part.confidence)
            if not images:
                images = [np.zeros((len(cameras), *image.shape[1:]), image.dtype) for image in new]
            for image, values in zip(images, new, strict=True):
                image[at] = values
            if part.rays is not None:
                if rays is None:
                    rays = camera_rays(cameras, images[1].shape)
                rays[at] = part.rays
            for row, alignment in zip(at, part.scale_alignment or [None] * len(at), strict=True):
                alignments[row] = alignment
            whole &= part.whole
        rgb, depth, confidence = images
        aligned = any(alignment is not None for alignment in alignments)
        return cls(rgb, depth, confidence, rays, tuple(alignments) if aligned else None, whole)


def camera_rays(cameras: Cameras, shape: tuple[int, ...]) -> Float32:
    """(V, H, W, 6) Plücker rays of V cameras of one picture size; ``shape`` is (V, H, W)."""
    rays = np.empty((*shape, 6), np.float32)
    for row in range(len(cameras)):
        rays[row] = cameras.plucker(row)
    return rays


class CompleterFacts(NamedTuple):
    """What is known of a completer, or of it with other weights (``gvtools completers``)."""

    what: str  # it fills holes with
    needs: str  # beside what is installed with gvtools
    cost: str  # seconds a view, and where
    gives: str  # what was measured of its generated pixels
    source: str = ""  # the page of ``benchmarks/`` that has the figures
    of: str = ""  # which weights


class Completer(ABC):
    """Fills what memory does not know of the target views. A run makes one and keeps it."""

    # Under which it is registered.
    name: str
    # Its options, a subclass of ``gvtools.settings.Settings``; None if it has none. Annotated
    # ``type[Any]``, so that this module does not import pydantic.
    settings_type: ClassVar[type[Any] | None] = None
    # True: ``complete`` gets all targets of a round with equal image size at once. False: one
    # target at a time, projected after the previous one was fused.
    batches_targets: bool = False
    # True leaves views with small holes to ``inpaint``, see ``EffortPolicy``.
    costly: bool = False
    # What a user should know before choosing it, by the weights that it may have.
    facts: ClassVar[tuple[CompleterFacts, ...]] = ()
    # Compiled kernels of its own, which a run compiles before its first round.
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


class NoneCompleter(Completer):
    """Returns the guidance as it is; invalid pixels are 0 in colour, depth and confidence."""

    name = "none"
    facts = (
        CompleterFacts(
            "nothing: holes stay black", "nothing", "none", "what the memory shows, alone"
        ),
    )

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Pass the valid pixels through; see ``Completer.complete``."""
        check_views(context, guidance)
        return Completion.of_memory(guidance)


def check_views(context: Sequence[ContextView], guidance: Guidance) -> None:
    """Refuse colours or known depth with NaN or infinity: a network spreads one bad pixel to all.

    Depth of the context that is not finite counts as none.
    """
    shape = guidance.valid.shape
    if len(shape) != 3:
        raise ShapeError(f"guidance: valid {shape}; expected (V, H, W)")
    check_shapes("guidance", shape, rgb=guidance.rgb, depth=guidance.depth)
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
    """``completer.complete``, and a check of its type, shapes, finite values and kept colours.

    Where memory does not suffice for all target views, they are completed in halves, and halves of
    these; context and seed stay the same.
    """
    completion = _complete_in_parts(completer, context, guidance, seed=seed)
    check_shapes(f"completer {completer.name}", guidance.valid.shape, depth=completion.depth)
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


def _complete_in_parts(
    completer: Completer, context: Sequence[ContextView], guidance: Guidance, *, seed: int
) -> Completion:
    """The completion of all views, in parts where memory does not suffice for the whole."""
    try:
        completion = completer.complete(context, guidance, seed=seed)
        if not isinstance(completion, Completion):
            kind = type(completion).__name__
            raise ShapeError(f"completer {completer.name} returned a {kind}; expected a Completion")
        return completion
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
    # By slices, which are not copied: there is no memory for it.
    ends = ((0, count // 2), (count // 2, count))
    parts = (
        (
            range(*end),
            _complete_in_parts(completer, context, guidance.select(slice(*end)), seed=seed),
        )
        for end in ends
    )
    return Completion.joined(parts, guidance.cameras)


def _lacks_memory(error: Exception) -> bool:
    # Torch's allocator of the CPU raises a plain RuntimeError, CUDA's a class of its own.
    text = str(error).lower()
    lacks = "out of memory" in text or "can't allocate memory" in text
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and lacks)


_REGISTRY: dict[str, type[Completer] | str] = {
    "none": "gvtools.completers.base:NoneCompleter",
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


def complete(
    context: Sequence[ContextView],
    guidance: Guidance,
    *,
    completer: str | Completer = "inpaint",
    seed: int = 0,
    **options: object,
) -> Completion:
    """Fill what memory does not know of the target views.

    Args:
        context: observed views that the completer may look at; may be empty.
        guidance: memory projected into the target cameras (``memory.project(cameras)``).
        completer: a registered name ("none", "inpaint", "geoverse", ...), or a completer that was
            made before; make one yourself where it is called often and reads weights.
        seed: the same input and seed give the same bytes on the same machine.
        options: of the completer called by name.

    Raises:
        OptionError: an unknown completer or option, options of a completer that was made before,
            or a completer that breaks its contract.
        ShapeError: views that are damaged or do not fit each other.

    >>> import numpy as np
    >>> from gvtools import Cameras, Guidance
    >>> camera = Cameras.pinhole(64, 48, focal=60.0)
    >>> known = np.ones((1, 48, 64), bool)
    >>> known[:, 20:28, 20:28] = False  # a hole in a grey wall, 2 units away
    >>> weight = known.astype(np.float32)
    >>> wall = Guidance(
    ...     camera, 0.5 * weight[..., None].repeat(3, -1), 2 * weight, known, weight, ~known & False
    ... )
    >>> filled = complete((), wall, completer="inpaint")
    >>> float(filled.depth[0, 24, 24].round(3))
    2.0
    """
    if isinstance(completer, str):
        completer = create(completer, **options)
    elif options:
        raise OptionError(
            f"options {', '.join(options)} beside a completer that was made before; give them to "
            "its class"
        )
    return run_completer(completer, context, guidance, seed=seed)
