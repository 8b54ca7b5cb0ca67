"""GeoVerse as a completer: what the memory does not know, generated for several views at once."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from gvtools.completers.base import Completion, ContextView, check_views
from gvtools.completers.geoverse.color_field import COLOR_ALIGNMENTS
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.context_views import CHOICES, chosen_views
from gvtools.completers.geoverse.correction import seamless
from gvtools.completers.geoverse.depth_scale import ALIGNMENTS
from gvtools.completers.geoverse.fill import Filled
from gvtools.completers.geoverse.flow import interval_bounds
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.model_views import context_depth, view_batch
from gvtools.completers.geoverse.postprocess import Completed, averaged, brought_back, corrected
from gvtools.completers.geoverse.resampling import model_size
from gvtools.completers.geoverse.weights.folder import from_pretrained
from gvtools.completers.geoverse.weights.folder_check import check_headers
from gvtools.completers.geoverse.weights.folder_parts import config_of
from gvtools.completers.holes import hole_reach
from gvtools.errors import OptionError
from gvtools.guidance import Guidance
from gvtools.options import check_range

PRECISIONS = ("auto", "float32", "bfloat16")
DEVICES = ("auto", "cpu", "cuda")
# The model that ships: see MODEL_CARD.md there.
SHIPPED = Path(__file__).parent / "pretrained" / "tiny"


@dataclass(frozen=True)
class GeoVerseCompleter:
    """The generative core (see ``model.py``), with the memory's pixels kept as they are.

    Attributes:
        weights: folder of a GeoVerse model, see ``gvtools weights list``; None for the small one
            that ships.
        steps: level-1 steps, equally spaced in time; None for the model's own interval bounds; 0
            decodes the features of the filled projections as they are.
        cascade_steps: level-0 steps, likewise.
        guidance: classifier-free guidance scale; None for the model's own.
        temperature: of the noise that level 1 starts from, see ``FlowConfig``; None for the
            model's own.
        context_views: most photographs in a pass; None for the model's own.
        context_by: "seen" takes the photographs that see most of what the targets show, "near"
            those that stand and look most like them; see ``context_views``.
        views: most views in a pass, photographs and targets; None for the model's own.
        alignment: how decoded depth gets the memory's scale, see ``depth_scale``; None for the
            model's own. A correction has the memory's scale already.
        color_alignment: whether decoded colours follow the memory's, see ``color_field``; None for
            the model's own. A correction follows them already.
        composition: "decoded" shows the decoding itself where a model's form is "correction", see
            ``correction``; None for the model's own.
        shared_fill: whether targets share what their holes are filled with, see ``surface_fill``.
        one_step_holes: a pass takes one level-1 step where no unknown pixel of its targets lies
            farther from a known one than this share of the image diagonal, and ``steps`` is None;
            0 never. None leaves it to what a run spares, see ``sparing``; so do the next three.
        no_prior_holes: likewise, a pass that does without the video prior.
        half_size_holes: likewise, a pass in pictures of half the size.
        near_holes: steps after the first look at what lies near holes alone, see ``near_tokens``.
        image_size: longer side of the pictures in a pass, pixels, rounded to whole patches; None
            for the model's own, which is also the most.
        precision: "auto" is bfloat16 on a GPU and float32 on a CPU.
        device: "auto" takes a GPU where there is one.
    """

    name: ClassVar[str] = "geoverse"
    joint: ClassVar[bool] = True
    costly: ClassVar[bool] = True

    weights: str | None = None
    steps: int | None = None
    cascade_steps: int | None = None
    guidance: float | None = None
    temperature: float | None = None
    context_views: int | None = None
    context_by: str = "seen"
    views: int | None = None
    alignment: str | None = None
    color_alignment: str | None = None
    composition: str | None = None
    shared_fill: bool = True
    one_step_holes: float | None = None
    no_prior_holes: float | None = None
    half_size_holes: float | None = None
    near_holes: bool | None = None
    image_size: int | None = None
    precision: str = "auto"
    device: str = "auto"

    def __post_init__(self) -> None:
        check_range("completer.steps", self.steps, least=0)
        check_range("completer.cascade_steps", self.cascade_steps, least=1)
        check_range("completer.guidance", self.guidance, least=0)
        check_range("completer.temperature", self.temperature, least=0)
        check_range("completer.one_step_holes", self.one_step_holes, least=0)
        check_range("completer.no_prior_holes", self.no_prior_holes, least=0)
        check_range("completer.half_size_holes", self.half_size_holes, least=0)
        check_range("completer.image_size", self.image_size, least=1)
        check_range("completer.context_views", self.context_views, least=1)
        check_range("completer.views", self.views, least=2)
        for name, value, known in (
            ("precision", self.precision, PRECISIONS),
            ("device", self.device, DEVICES),
            ("context_by", self.context_by, CHOICES),
            ("alignment", self.alignment or ALIGNMENTS[0], ALIGNMENTS),
            ("color_alignment", self.color_alignment or "none", COLOR_ALIGNMENTS),
        ):
            if value not in known:
                raise OptionError(
                    f"completer.{name} = {value!r}; expected one of {', '.join(known)}"
                )
        if self.composition not in (None, "decoded", "correction"):
            raise OptionError(
                f"completer.composition = {self.composition!r}; expected 'decoded' or 'correction'"
            )
        if self.device == "cuda" and not torch.cuda.is_available():
            raise OptionError("completer.device = 'cuda', and torch sees no CUDA device here")
        if self.weights is None and not self.folder.is_dir():
            raise OptionError(
                "completer geoverse: the weights that ship are absent from this installation; "
                "name a folder as 'gvtools weights list' describes it, with --weights DIR or --set "
                "completer.weights=DIR"
            )
        # A folder that cannot be a model is refused before anything is computed.
        form = _checked(str(self.folder.resolve()), self._times()).composition
        if self.composition == "correction" and form != "correction":
            raise OptionError(
                f"completer.composition = 'correction', and the model in {self.folder} is of the "
                f"form {form!r}; leave the option out"
            )

    @property
    def folder(self) -> Path:
        """Of the weights."""
        return SHIPPED if self.weights is None else Path(self.weights)

    @property
    def model(self) -> GeoVerse:
        """The model, on its device; kept from call to call."""
        return _loaded(str(self.folder.resolve()), str(self._device()), self._times())

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should be told before a run."""
        if config_of(self.folder).trained:
            return ()
        return (f"the weights in {self.folder} are untrained: what they complete is noise",)

    @property
    def files(self) -> tuple[Path, ...]:
        """What decides the result beside the views: everything in the weights folder."""
        return tuple(sorted(path for path in self.folder.rglob("*") if path.is_file()))

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Complete all target views, several in a pass; see ``Completer.complete``."""
        start = time.perf_counter()
        if not context:
            raise OptionError("completer geoverse needs at least one context view, and got none")
        check_views(context, guidance)
        device = self._device()
        model = self.model
        canvas = _Canvas(guidance)
        holes = [index for index in range(len(guidance)) if not guidance.valid[index].all()]
        views = self.views or model.config.views
        most = min(self.context_views or model.config.context, views - 1)
        room = views - min(most, len(context))
        passes = steps = 0
        filled = self._filled(model, context, guidance.select(holes)) if holes else None
        for first in range(0, len(holes), room):
            rows = holes[first : first + room]
            part = guidance.select(rows)
            fill = None if filled is None else filled.rows(range(first, first + len(rows)))
            shown = part.depth if fill is None else fill.depth
            chosen = chosen_views(context, part.cameras, shown, most, by=self.context_by)
            reach = math.inf
            if self.one_step_holes or self.no_prior_holes or self.half_size_holes:
                reach = max(hole_reach(valid) for valid in part.valid)
            bounds = self._bounds(model, reach)
            size = self._size(model, part, reach)
            prior = reach > (self.no_prior_holes or 0)
            made = self._pass(model, device, chosen, part, fill, seed, size, bounds, prior)
            canvas.put(rows, made, part)
            passes += 1
            steps += max(len(bounds) - 1, 0)
        spent = {
            "seconds": time.perf_counter() - start,
            "passes": float(passes),
            "steps": float(steps),
        }
        return canvas.completion(spent)

    def _filled(
        self, model: GeoVerse, context: Sequence[ContextView], guidance: Guidance
    ) -> Filled | None:
        """What the model sees in holes; None where it fills them itself."""
        if model.config.hints.fill != "surfaces":
            return None
        # It needs more than torch and numpy.
        from gvtools.completers.geoverse.surface_fill import surface_fill

        return surface_fill(context, guidance, shared=self.shared_fill)

    def _pass(
        self,
        model: GeoVerse,
        device: torch.device,
        context: Sequence[ContextView],
        part: Guidance,
        fill: Filled | None,
        seed: int,
        size: tuple[int, int],
        bounds: tuple[float, ...],
        prior: bool,
    ) -> Completed:
        """One pass of the model over context views and a few targets."""
        batch, cameras = view_batch(context, part, size, fill=fill)
        batch = batch.to(device)
        # A photograph and a target of one name must not start from the same noise.
        names = [f"context {view.name}" for view in context]
        names += [f"target {name}" for name in part.cameras.names]
        filled = None
        if model.config.composition == "correction" and self.composition != "decoded":
            filled = averaged(part) if fill is None else fill
        # Where memory tells of every pixel, the model's own scale is of no use.
        told = filled is not None and bool((filled.depth > 0).all())
        with self._precision(device):
            made = model.generate(
                batch,
                seed=seed,
                names=[names],
                bounds=bounds,
                cascade_bounds=self._cascade_bounds(model),
                guidance=self.guidance,
                temperature=self.temperature,
                prior=prior,
                targets_alone=told,
                near_holes=bool(self.near_holes),
            )

        def brought(color_alignment: str) -> Completed:
            known = context_depth(context, part, size)
            alignment = self.alignment or model.config.alignment
            return brought_back(
                made, part, cameras, known, alignment=alignment, color_alignment=color_alignment
            )

        if filled is None:
            return brought(self.color_alignment or model.config.color_alignment)
        made = seamless(made, model.config.patch)
        return corrected(made, part, filled, back=None if told else brought("none"))

    def _size(self, model: GeoVerse, part: Guidance, reach: float) -> tuple[int, int]:
        """(H, W) of the pictures in a pass whose holes reach so far."""
        longest = min(self.image_size or model.config.image_size, model.config.image_size)
        if reach <= (self.half_size_holes or 0):
            longest = longest // 2
        return model_size(*part.depth.shape[1:], longest=longest, patch=model.config.patch)

    def _bounds(self, model: GeoVerse, reach: float) -> tuple[float, ...]:
        """Of level 1, in a pass whose holes reach so far."""
        if self.steps == 0:
            return ()
        if self.steps is None:
            one = reach <= (self.one_step_holes or 0)
            return interval_bounds(1) if one else model.config.flow.level1
        return interval_bounds(self.steps)

    def _cascade_bounds(self, model: GeoVerse) -> tuple[float, ...]:
        flow = model.config.flow
        if self.cascade_steps is None:
            return flow.cascade
        return interval_bounds(self.cascade_steps)

    def _times(self) -> tuple[float, ...]:
        """When the weights' files were written: a changed file is read again."""
        return tuple(path.stat().st_mtime for path in self.files)

    def _device(self) -> torch.device:
        if self.device == "auto":
            return torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return torch.device(self.device)

    def _precision(self, device: torch.device):  # type: ignore[no-untyped-def]
        half = self.precision == "bfloat16" or (self.precision == "auto" and device.type == "cuda")
        return torch.autocast(device.type, dtype=torch.bfloat16) if half else nullcontext()


class _Canvas:
    """The completion, begun from what the memory knows."""

    def __init__(self, guidance: Guidance) -> None:
        valid = guidance.valid
        self.valid = valid
        self.rgb = np.where(valid[..., None], guidance.rgb, np.float32(0))
        self.depth = np.where(valid, guidance.depth, np.float32(0))
        known = np.where(valid, np.minimum(guidance.confidence, 1), 0)
        self.confidence = known.astype(np.float32)
        self.rays = np.zeros((*valid.shape, 6), np.float32)
        for index in range(len(guidance)):
            self.rays[index] = guidance.cameras.plucker(index)
        self.spent = {"holes": float((~valid).sum()), "unfilled": 0.0, "views_without_scale": 0.0}
        self.support = ["nothing to complete"] * len(guidance)

    def put(self, rows: Sequence[int], made: Completed, part: Guidance) -> None:
        """Fill the holes of some views."""
        for position, row in enumerate(rows):
            hole = ~self.valid[row]
            self.rgb[row][hole] = made.rgb[position][hole]
            self.depth[row][hole] = made.depth[position][hole]
            self.confidence[row][hole] = made.confidence[position][hole]
            if made.rays is not None and np.isfinite(made.scales[position]):
                self.rays[row][hole] = made.rays[position][hole]
            self.support[row] = made.support[position]
            self.spent["unfilled"] += float((made.depth[position][hole] <= 0).sum())
            placed = np.isfinite(made.scales[position]) or bool((made.depth[position] > 0).any())
            self.spent["views_without_scale"] += float(not placed)

    def completion(self, spent: dict[str, float]) -> Completion:
        """The result."""
        return Completion(
            self.rgb,
            self.depth,
            self.confidence,
            self.rays,
            spent={**self.spent, **spent},
            support=tuple(self.support),
        )


@lru_cache(maxsize=8)
def _checked(folder: str, times: tuple[float, ...]) -> GeoVerseConfig:
    """A folder's configuration, once it is known that it can be loaded; each round asks for it."""
    return check_headers(folder)


@lru_cache(maxsize=2)
def _loaded(folder: str, device: str, times: tuple[float, ...]) -> GeoVerse:
    """The model of a folder; kept, since every round asks for it. A student and its teacher fit."""
    return from_pretrained(folder, device=device)
