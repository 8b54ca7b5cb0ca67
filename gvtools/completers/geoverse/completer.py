"""GeoVerse as a completer: what the memory does not know, generated for several views at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gvtools.completers.base import (
    Completer,
    Completion,
    ContextView,
    check_views,
)
from gvtools.completers.geoverse.completer_settings import GeoVerseSettings
from gvtools.completers.geoverse.conditioning import filled
from gvtools.completers.geoverse.context_views import chosen_views
from gvtools.completers.geoverse.correction import seamless
from gvtools.completers.geoverse.flow import interval_bounds
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.model_views import context_depth, view_batch
from gvtools.completers.geoverse.postprocess import (
    Completed,
    averaged,
    corrected,
    refined,
    to_scene_scale,
)
from gvtools.completers.geoverse.resampling import model_size
from gvtools.completers.geoverse.weights.folder import check_headers, from_pretrained
from gvtools.completers.push_pull import Filled
from gvtools.completers.scale_alignment import ScaleAlignment, ScaleStatus
from gvtools.errors import OptionError
from gvtools.guidance import Guidance
from gvtools.networks.precision import autocast, inference_type

# The model that ships: see MODEL_CARD.md there.
SHIPPED = Path(__file__).parent / "pretrained" / "tiny"


@dataclass(frozen=True)
class _Sampling:
    """Sampling schedule and image size of a pass.

    Attributes:
        bounds: times 1 = tau_0 > ... > tau_K = 0 of the K Euler steps that denoise the level-1
            features (see ``model.py``); empty if nothing is denoised.
        size: (H, W) of the model's images, pixels.
    """

    bounds: tuple[float, ...]
    size: tuple[int, int]


class GeoVerseCompleter(Completer):
    """The generative core (see ``model.py``), with the memory's pixels kept as they are."""

    name = "geoverse"
    settings_type = GeoVerseSettings
    settings: GeoVerseSettings
    batches_targets = True
    costly = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if self.settings.device == "cuda" and not torch.cuda.is_available():
            raise OptionError("completer.device = 'cuda', and torch sees no CUDA device here")
        if self.settings.weights is None and not self.folder.is_dir():
            raise OptionError(
                "completer geoverse: the weights that ship are absent from this installation; "
                "name a folder as 'gvtools weights list' describes it, with --weights DIR or --set "
                "completer.weights=DIR"
            )
        # A folder that cannot be a model is refused before anything is computed.
        self.config = check_headers(str(self.folder.resolve()))
        form = self.config.composition
        if self.settings.composition == "correction" and form != "correction":
            raise OptionError(
                f"completer.composition = 'correction', and the model in {self.folder} is of the "
                f"form {form!r}; leave the option out"
            )

    @property
    def folder(self) -> Path:
        """The weights folder."""
        return SHIPPED if self.settings.weights is None else Path(self.settings.weights)

    @cached_property
    def model(self) -> GeoVerse:
        """The model, on its device; read when it is first needed."""
        return from_pretrained(
            str(self.folder.resolve()),
            device=str(self._device),
            dtype=self._compute_type,
            offload=self.settings.offload,
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """A warning if the weights are untrained."""
        if self.config.trained:
            return ()
        return (f"the weights in {self.folder} are untrained: what they complete is noise",)

    @property
    def files(self) -> tuple[Path, ...]:
        """Everything in the weights folder."""
        return tuple(sorted(path for path in self.folder.rglob("*") if path.is_file()))

    @property
    def weights(self) -> Path | None:
        """The weights folder."""
        return self.folder

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Complete all target views, several in a pass; see ``Completer.complete``."""
        if not context:
            raise OptionError("completer geoverse needs at least one context view, and got none")
        check_views(context, guidance)
        canvas = _Canvas(guidance, whole=self.settings.output == "views")
        # A pass is one run of the model over at most ``views`` views: first the context views,
        # then as many targets as still fit.
        incomplete = [index for index in range(len(guidance)) if not canvas.kept[index].all()]
        views = self.settings.views or self.config.views
        context_count = min(self.settings.context_views or self.config.context, views - 1)
        targets_per_pass = views - min(context_count, len(context))
        filled = self._filled(context, guidance.select(incomplete)) if incomplete else None
        for first in range(0, len(incomplete), targets_per_pass):
            rows = incomplete[first : first + targets_per_pass]
            part = guidance.select(rows)
            fill = None if filled is None else filled.rows(range(first, first + len(rows)))
            depth = part.depth if fill is None else fill.depth
            selection = self.settings.context_selection
            chosen = chosen_views(
                context, part.cameras, depth, count=context_count, selection=selection
            )
            sampling = self._sampling(part)
            canvas.put(rows, self._pass(chosen, part, fill, sampling=sampling, seed=seed))
        return canvas.completion()

    def _filled(self, context: Sequence[ContextView], guidance: Guidance) -> Filled | None:
        """Fill of the holes that the model gets as hint; None if the model fills them itself."""
        if self.config.hints.fill != "surfaces":
            return None
        # It needs more than torch and numpy.
        from gvtools.completers.surface_fill import surface_fill

        return surface_fill(context, guidance, shared=self.settings.shared_fill)

    def _sampling(self, part: Guidance) -> _Sampling:
        """The model's own steps and picture size, or those of the settings."""
        bounds, steps = self.config.flow.level1, self.settings.steps
        if steps is not None:
            bounds = interval_bounds(steps, shift=self._shift) if steps else ()
        longest = min(self.settings.image_size or math.inf, self.config.image_size)
        size = model_size(*part.depth.shape[1:], longest=int(longest), patch=self.config.patch)
        return _Sampling(bounds, size)

    def _pass(
        self,
        context: Sequence[ContextView],
        part: Guidance,
        fill: Filled | None,
        *,
        sampling: _Sampling,
        seed: int,
    ) -> Completed:
        """One pass of the model over context views and a few targets."""
        options, size = self.settings, sampling.size
        batch, cameras = view_batch(context, part, size, fill=fill)
        # A photograph and a target of one name must not start from the same noise.
        names = [f"context {view.name}" for view in context]
        names += [f"target {name}" for name in part.cameras.names]
        # "correction": the model's change is added to ``base``, the projection with its holes
        # filled. "decoded": the decoded pictures themselves are the result, and base is None.
        base = None
        corrects = self.config.composition == "correction" and options.composition != "decoded"
        if corrects and options.output == "holes":
            base = averaged(part) if fill is None else fill
        # Depth of ``base`` is in scene units. Only its pixels without depth take decoded depth,
        # which has to be brought to the memory's scale first.
        base_is_complete = base is not None and bool((base.depth > 0).all())
        cascade = options.cascade_steps
        with self._precision():
            generated = self.model.generate(
                batch.to(self._device),
                seed=seed,
                names=[names],
                bounds=sampling.bounds,
                cascade_bounds=interval_bounds(cascade, shift=self._shift)
                if cascade
                else self.config.flow.cascade,
                cfg_scale=options.cfg_scale,
                cascade_cfg_scale=options.cascade_cfg_scale,
                temperature=options.temperature,
                targets_alone=base_is_complete,
            )

        def decoded_in_scene_units(color_alignment: str) -> Completed:
            known = context_depth(context, part, size)
            alignment = options.alignment or self.config.alignment
            return to_scene_scale(
                generated,
                part,
                cameras,
                known=known,
                alignment=alignment,
                color_alignment=color_alignment,
            )

        if base is None:
            return decoded_in_scene_units(options.color_alignment or self.config.color_alignment)
        generated = seamless(generated, self.config.patch)
        completed = corrected(
            generated,
            part,
            base,
            back=None if base_is_complete else decoded_in_scene_units("unchanged"),
        )
        refiner = self.model.refiner
        if refiner is None:
            return completed
        batch = filled(batch.to(self._device), self.config.hints)
        return refined(completed, part, refiner, batch=batch, generated=generated)

    @property
    def _shift(self) -> float:
        return self.config.flow.sampling_shift

    @property
    def _device(self) -> torch.device:
        if self.settings.device == "auto":
            return torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return torch.device(self.settings.device)

    @property
    def _compute_type(self) -> torch.dtype:
        return inference_type(self.settings.precision, self._device)

    def _precision(self) -> AbstractContextManager[Any]:
        """Autocast to half precision if the settings ask for it, or by default on CUDA."""
        return autocast(self._device, self._compute_type)


class _Canvas:
    """The completion under construction: first the memory's pixels, then what each pass adds.

    Args:
        guidance: of all targets.
        whole: whether the passes' pixels take the place of the memory's, too.

    Attributes:
        kept: (V, H, W) pixels that stay the memory's.
    """

    def __init__(self, guidance: Guidance, *, whole: bool) -> None:
        valid = guidance.valid
        self.whole, self.kept = whole, np.zeros_like(valid) if whole else valid
        self.rgb = np.where(valid[..., None], guidance.rgb, np.float32(0))
        self.depth = np.where(valid, guidance.depth, np.float32(0))
        known = np.where(valid, np.minimum(guidance.confidence, 1), 0)
        self.confidence = known.astype(np.float32)
        self.rays = np.zeros((*valid.shape, 6), np.float32)
        for index in range(len(guidance)):
            self.rays[index] = guidance.cameras.plucker(index)
        nothing = ScaleAlignment(ScaleStatus.NOTHING_TO_COMPLETE)
        self.alignment = [nothing] * len(guidance)

    def put(self, rows: Sequence[int], completed: Completed) -> None:
        """Fill the holes of some views."""
        for position, row in enumerate(rows):
            hole = ~self.kept[row]
            self.rgb[row][hole] = completed.rgb[position][hole]
            self.depth[row][hole] = completed.depth[position][hole]
            self.confidence[row][hole] = completed.confidence[position][hole]
            if completed.rays is not None and np.isfinite(completed.scales[position]):
                self.rays[row][hole] = completed.rays[position][hole]
            self.alignment[row] = completed.alignment[position]

    def completion(self) -> Completion:
        """The result."""
        return Completion(
            self.rgb,
            self.depth,
            self.confidence,
            self.rays,
            scale_alignment=tuple(self.alignment),
            whole=self.whole,
        )
