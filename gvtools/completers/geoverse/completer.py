"""GeoVerse as a completer: what the memory does not know, generated for several views at once."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field

from gvtools.completers.base import (
    Completer,
    CompleterFacts,
    Completion,
    ContextView,
    ScaleAlignment,
    ScaleStatus,
    camera_rays,
    check_views,
)
from gvtools.completers.geoverse.composition import (
    Completed,
    average_fill,
    correct,
    refine,
    remove_seams,
    to_scene_scale,
)
from gvtools.completers.geoverse.conditioning import fill_holes
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.views import choose_views, context_depth, model_size, view_batch
from gvtools.completers.geoverse.weights import (
    check_headers,
    from_pretrained,
    left_out,
    untrained_branches,
)
from gvtools.completers.push_pull import Filled
from gvtools.completers.settings import CompleterSettings
from gvtools.errors import OptionError
from gvtools.guidance import Guidance
from gvtools.networks import Precision
from gvtools.networks.compute import autocast, inference_type


class GeoVerseSettings(CompleterSettings):
    """Options of ``geoverse``; none takes the model's own value."""

    weights: str | None = None
    """Folder of a GeoVerse model, see ``gvtools weights list``; none takes the small model that
    ships."""
    steps: int | None = Field(None, ge=0)
    """Level-1 steps, equally spaced in time before the model's time shift, but for the model's own
    number of them, which keeps its own times; 0 decodes the features of the filled projections."""
    cascade_steps: int | None = Field(None, ge=1)
    """Level-0 steps, likewise."""
    cfg_scale: float | None = Field(None, ge=0)
    """Scale of classifier-free guidance over the cameras, of level 1; 1 does without."""
    cascade_cfg_scale: float | None = Field(None, ge=0)
    """Likewise, of level 0."""
    encoder_interval: float = Field(0.0, ge=0, le=1)
    """How far a step may be, in time from 1 to 0, from the one whose encoder it takes: the encoders
    of the denoisers, most of their work, are not run in between. 0 runs them in every step, as they
    were trained; 0.015 in 15 of GLD's 49."""
    output: Literal["holes", "views"] = "holes"
    """``holes`` keeps what the memory shows of a view and takes the model's pixels elsewhere;
    ``views`` gives whole views as the model decodes them (the paper)."""
    temperature: float | None = Field(None, ge=0)
    """Standard deviation of the noise that level 1 starts from."""
    context_views: int | None = Field(None, ge=1)
    """Most photographs in a pass."""
    context_selection: Literal["covisible", "nearest"] = "covisible"
    """The photographs of a pass: those that show most of what the targets show, or those that
    stand and look most like them."""
    views: int | None = Field(None, ge=2)
    """Most views in a pass, photographs and targets."""
    memory: bool = True
    """Whether the targets' projections enter the model; without, whole views are generated from
    the photographs and the cameras (the paper's ablation), so ``output`` has to be ``views``."""
    alignment: Literal["centres", "centres-alone", "hint", "field"] | None = None
    """How decoded depth gets the memory's scale: by camera centres, by one factor to the memory's
    depth, or by a smooth field of factors, each where nothing known contradicts it; or by camera
    centres whatever is known (the paper)."""
    color_alignment: Literal["unchanged", "field"] | None = None
    """Whether decoded colours follow the memory's by a smooth field."""
    composition: Literal["decoded", "correction"] | None = None
    """``decoded`` shows the decoding itself where the model corrects filled projections."""
    shared_fill: bool = True
    """Whether targets of a call share what their holes are filled with."""
    image_size: int | None = Field(None, ge=1)
    """Longer side of the pictures in a pass, pixels, rounded to whole patches; the model's own is
    also the most."""
    precision: Precision = "auto"
    """``auto`` is float32 on a CPU and bfloat16 on a GPU, float16 before compute capability 8.0."""
    compile: bool = False
    """Compile the denoisers, the RGB head and the video model on first use: on a GPU a pass of base
    takes three quarters of the time, after half a minute; needs a C++ compiler."""
    offload: Literal["auto", "always", "never"] = "auto"
    """Whether the video prior's weights leave the GPU between passes; ``auto`` where they would
    leave too little memory for the rest of a pass."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """``auto`` takes a GPU where there is one."""


COMPILERS = ("g++", "clang++", "c++", "cl")
# The model that ships: see MODEL_CARD.md there.
SHIPPED = Path(__file__).parent / "pretrained" / "tiny"


class GeoVerseCompleter(Completer):
    """The generative core (see ``model.py``), with the memory's pixels kept as they are."""

    name = "geoverse"
    facts = (
        CompleterFacts(
            "a small diffusion network's features, decoded at 96 pixels and refined; smooth",
            "nothing: its weights ship; a GPU is not needed",
            "0.140 s in drawn rooms, 2.534 s in a real kitchen, without its refiner (7 % of all)",
            "PSNR 20.76 dB in rooms, 18.36 in levels, 14.72 in the kitchen, 22.23 on the fern; "
            "median depth error 0.0957, 0.1755, 0.0658",
            "benchmarks/generative.md, Four domains (means over views)",
            "the model that ships",
        ),
        CompleterFacts(
            "the full-size network's features, decoded at 504 pixels",
            "--set completer.weights=DIR (gvtools weights list), and a GPU: 20.4 GiB with the "
            "video model",
            "1,034 ms a pass of 6 views on an H200, base in 3 + 1 steps; gld samples 49 guided "
            "steps of each network",
            "not measured: no trained weights of base are public",
            "benchmarks/complete.md, base (random weights)",
            "weights of your own",
        ),
    )
    settings_type = GeoVerseSettings
    settings: GeoVerseSettings
    batches_targets = True
    costly = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if self.settings.device == "cuda" and not torch.cuda.is_available():
            raise OptionError("completer.device = 'cuda', and torch sees no CUDA device here")
        if self.settings.compile and not any(map(shutil.which, COMPILERS)):
            raise OptionError(
                "completer.compile = true, and none of the compilers "
                f"{', '.join(COMPILERS)} is here; install one, or leave the option out"
            )
        if self.settings.weights is None and not self.folder.is_dir():
            raise OptionError(
                "completer geoverse: the weights that ship are absent from this installation; "
                "name a folder as 'gvtools weights list' describes it, with --weights DIR or --set "
                "completer.weights=DIR"
            )
        # A folder that cannot be a model is refused before anything is computed.
        self.config = check_headers(str(self.folder.resolve()))
        form = self.config.composition
        if not self.settings.memory and self.settings.output != "views":
            raise OptionError(
                "completer.memory = false with completer.output = 'holes': nothing tells what the "
                "holes are; give completer.output=views too (--protocol paper has it)"
            )
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
        model = from_pretrained(
            str(self.folder.resolve()),
            device=str(self._device),
            dtype=self._compute_type,
            offload=self.settings.offload,
        )
        if self.settings.compile:
            model.compile_blocks()
        return model

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings of weights, or branches of them, that are untrained or do not fit."""
        if not self.config.trained:
            return (f"the weights in {self.folder} are untrained: what they complete is noise",)
        unfit = left_out(self.folder, self.config)
        branches = untrained_branches(self.folder, self.config)
        return branches if unfit is None else (*branches, unfit)

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
        whole = self.settings.output == "views"
        if not self.settings.memory:
            guidance = guidance.blank()
        has_holes = ~guidance.valid.all(axis=(1, 2)) | whole
        incomplete, complete = (np.flatnonzero(which).tolist() for which in (has_holes, ~has_holes))
        # A pass is one run of the model over at most ``views`` views: first the context views,
        # then as many targets as still fit.
        views = self.settings.views or self.config.views
        context_count = min(self.settings.context_views or self.config.context, views - 1)
        targets_per_pass = views - min(context_count, len(context))

        def parts() -> Iterator[tuple[list[int], Completion]]:
            if complete or not incomplete:
                known = Completion.of_memory(guidance.select(complete))
                nothing = (ScaleAlignment(ScaleStatus.NOTHING_TO_COMPLETE),) * len(complete)
                rays = camera_rays(guidance.cameras[complete], known.depth.shape)
                yield complete, replace(known, rays=rays, scale_alignment=nothing, whole=whole)
            filled = self._fill_holes(context, guidance.select(incomplete)) if incomplete else None
            for first in range(0, len(incomplete), targets_per_pass):
                rows = incomplete[first : first + targets_per_pass]
                part = guidance.select(rows)
                fill = None if filled is None else filled.select(range(first, first + len(rows)))
                chosen = choose_views(
                    context, part.cameras, part.depth if fill is None else fill.depth,
                    count=context_count, selection=self.settings.context_selection,
                )  # fmt: skip
                yield rows, self._pass(chosen, part, fill, seed=seed).over(part, whole=whole)

        return Completion.joined(parts(), guidance.cameras)

    def _fill_holes(self, context: Sequence[ContextView], guidance: Guidance) -> Filled | None:
        """Fill of the holes that the model gets as hint; None if the model fills them itself."""
        if self.config.hints.fill != "surfaces":
            return None
        # It needs more than torch and numpy.
        from gvtools.completers.surface_fill import surface_fill

        return surface_fill(context, guidance, shared=self.settings.shared_fill)

    def _pass(
        self, context: Sequence[ContextView], part: Guidance, fill: Filled | None, *, seed: int
    ) -> Completed:
        """One pass of the model over context views and a few targets."""
        options, flow = self.settings, self.config.flow
        longest = min(options.image_size or math.inf, self.config.image_size)
        size = model_size(*part.depth.shape[1:], longest=int(longest), patch=self.config.patch)

        batch, cameras = view_batch(context, part, size, fill=fill)
        # A photograph and a target of one name must not start from the same noise.
        names = [f"context {view.name}" for view in context]
        names += [f"target {name}" for name in part.cameras.names]
        # "correction": the model's change is added to ``base``, the projection with its holes
        # filled. "decoded": the decoded pictures themselves are the result, and base is None.
        base = None
        corrects = self.config.composition == "correction" and options.composition != "decoded"
        if corrects and options.output == "holes":
            base = average_fill(part) if fill is None else fill
        # Depth of ``base`` is in scene units. Only its pixels without depth take decoded depth,
        # which has to be brought to the memory's scale first.
        base_is_complete = base is not None and bool((base.depth > 0).all())
        with autocast(self._device, self._compute_type):
            generated = self.model.generate(
                batch.to(self._device),
                seed=seed,
                names=[names],
                bounds=flow.times("level1", options.steps),
                cascade_bounds=flow.times("cascade", options.cascade_steps),
                cfg_scale=options.cfg_scale,
                cascade_cfg_scale=options.cascade_cfg_scale,
                temperature=options.temperature,
                encoder_interval=options.encoder_interval,
                targets_alone=base_is_complete,
            )

        def decoded_in_scene_units(color_alignment: str) -> Completed:
            return to_scene_scale(
                generated,
                part,
                cameras,
                known=context_depth(context, part, size),
                alignment=options.alignment or self.config.alignment,
                color_alignment=color_alignment,
            )

        if base is None:
            return decoded_in_scene_units(options.color_alignment or self.config.color_alignment)
        generated = remove_seams(generated, self.config.patch)
        back = None if base_is_complete else decoded_in_scene_units("unchanged")
        completed = correct(generated, part, base, back=back)
        if self.model.refiner is None:
            return completed
        batch = fill_holes(batch.to(self._device), self.config.hints)
        return refine(completed, part, self.model.refiner, batch=batch, generated=generated)

    @property
    def _device(self) -> torch.device:
        if self.settings.device == "auto":
            return torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return torch.device(self.settings.device)

    @property
    def _compute_type(self) -> torch.dtype:
        return inference_type(self.settings.precision, self._device)
