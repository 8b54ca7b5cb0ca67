"""``gvtools bench complete --memory``: the peak memory of a pass and of a training step, predicted.

The library's own code runs on tensors without numbers, whose bytes are counted (``live_bytes``).
Figures are of one device that holds everything; what its driver takes, and what an allocator loses
between tensors, comes on top.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.flow import interval_bounds
from gvtools.completers.geoverse.model import DECODE, DECODING, VIDEO, GeoVerse
from gvtools.completers.geoverse.video_prior import VideoPrior
from gvtools.networks.compute import autocast, name_of
from gvtools.training.batch import TrainingBatch
from gvtools.training.distributed import Processes, Replicated
from gvtools.training.loop import Trainer
from gvtools.training.options import DenoiserStageOptions, OptimizerOptions, ReflowStageOptions
from gvtools.training.stages import DenoiserStage, ReflowStage, Stage
from pipelines.bench.live_bytes import LiveBytes, alone, predicted
from pipelines.bench.options import CompleteOptions
from pipelines.bench.random_model import random_video, random_views
from pipelines.bench.stage_clock import INSIDE

CPU = torch.device("cpu")
FORWARD, BACKWARD, OPTIMISER = "forward", "backward", "optimiser"
WITHOUT, WITH = "without the video prior", "with the video prior"
# The stages that train a large model: the denoisers, then their distillation beside a teacher.
STAGES: dict[str, tuple[type[Stage], Any]] = {
    "denoiser": (DenoiserStage, DenoiserStageOptions),
    # How often its teacher steps changes the time alone.
    "reflow": (ReflowStage, partial(ReflowStageOptions, steps=1)),
}


class StagePeaks:
    """Given to a model as its clock, it notes the most bytes that were live within each stage.

    Args:
        live: counts them.

    Attributes:
        rows: bytes by stage; of several runs of a stage the most.
    """

    def __init__(self, live: LiveBytes) -> None:
        self.live = live
        self.rows: dict[str, int] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Note one stage."""
        name = f"{INSIDE}{stage}" if stage in DECODING else stage
        # In the order in which stages begin.
        self.rows.setdefault(name, 0)
        outer = self.live.peak
        self.live.forget_peak()
        yield
        self.rows[name] = max(self.rows[name], self.live.peak)
        self.live.peak = max(outer, self.live.peak)


def pass_peaks(
    model: GeoVerse, batch: ViewBatch, *, steps: tuple[int, int], dtype: torch.dtype
) -> dict[str, int]:
    """Bytes beside the weights at the peak of each stage of a pass.

    Args:
        model: its video prior, where it needs one, attached.
        batch: of the pass.
        steps: of level 1 and of the cascade.
        dtype: of products.
    """
    shift = model.config.flow.shift
    networks = [] if model.video is None else _networks(model.video)
    with LiveBytes([model, *networks]) as live, autocast(CPU, dtype):
        peaks = model.clock = StagePeaks(live)
        model.generate(
            batch,
            bounds=interval_bounds(steps[0], shift=shift),
            cascade_bounds=interval_bounds(steps[1], shift=shift),
        )
    return peaks.rows


def step_peaks(
    model: GeoVerse, batch: TrainingBatch, optimizer: OptimizerOptions, *, stage: str = "denoiser"
) -> dict[str, int]:
    """Bytes beside the weights at the peak of each part of a training step.

    Gradients, averages, the optimiser's moments and a teacher are among them; ``held`` is what
    stays between steps. Of two steps the second counts: the first makes the moments.

    Args:
        model: its video prior, where it needs one, attached.
        batch: of the step.
        optimizer: its options.
        stage: "denoiser" or "reflow".
    """
    networks = [] if model.video is None else _networks(model.video)
    with LiveBytes([model, *networks]) as live:
        kind, options = STAGES[stage]
        trained = kind(model, options(optimizer=optimizer))
        trainer = Trainer(
            _InPlace(trained, Processes(0, 1, CPU)),
            optimizer,
            lambda parts: (batch for _ in parts),
            folder=Path(),
            seed=0,
            identity={},
        )
        for group in trainer.optimizer.param_groups:
            # What AdamW does on a GPU: all parameters at once, with room for one more of each.
            group["foreach"] = True
        rows: dict[str, int] = {}

        def note(name: str) -> None:
            rows[name] = live.peak
            live.forget_peak()

        trained.register_forward_hook(lambda *_: note(FORWARD))
        trainer.optimizer.register_step_pre_hook(lambda *_: note(BACKWARD))
        for _ in range(2):
            live.forget_peak()
            trainer.step(iter([batch]))
            note(OPTIMISER)
        return {"held": live.live, **rows}


class _InPlace(Replicated):
    """Tensors without numbers cannot be moved, and need not be."""

    def _distribute(self) -> None:
        pass


def memory_figures(options: CompleteOptions) -> dict[str, Any]:
    """The predicted bytes as a JSON object: rows under ``inference`` and ``training``."""
    config = options.network()
    configs = {WITHOUT: replace(config, video=None, injection="none")}
    if config.video is not None and options.video is not False:
        configs[WITH] = config
    figures: dict[str, Any] = {
        "bench": "memory",
        "config": config.name,
        "size": list(options.picture(config)),
        "context": options.context,
        "targets": options.targets,
        "steps": options.steps,
        "cascade_steps": options.cascade_steps,
        "precision": name_of(options.compute_type),
        "training_precision": name_of(_trained_type(options)),
        "card_gb": options.card,
        "inference": [],
        "training": [],
    }
    for model, chosen in configs.items():
        rows = alone(_inference, options, chosen)
        figures["inference"] += [{"model": model, **row} for row in rows]
        for stage, recompute in itertools.product(STAGES, (False, True)):
            row = alone(_training, options, chosen, stage, recompute=recompute)
            figures["training"].append({"model": model, **row})
    return figures


def _inference(options: CompleteOptions, config: GeoVerseConfig) -> list[dict[str, Any]]:
    """A row for each stage of a pass."""
    dtype = options.compute_type
    with predicted():
        model = _model(config)
        model.hold_in(dtype)
        steps = (options.steps, options.cascade_steps)
        peaks = pass_peaks(model, _views(options, config), steps=steps, dtype=dtype)
        weights, prior = _bytes(model), _prior_bytes(model)
    return [
        {
            "stage": stage,
            "weights_bytes": weights,
            "video_bytes": prior,
            "activation_bytes": peak,
            # The prior is on the card for its own stage alone, or stays there.
            "total_bytes": weights + peak + (prior if stage == VIDEO else 0),
            "total_bytes_video_stays": weights + peak + prior,
        }
        for stage, peak in peaks.items()
        if stage != DECODE
    ]


def _training(
    options: CompleteOptions, config: GeoVerseConfig, stage: str, *, recompute: bool
) -> dict[str, Any]:
    """A step of one sample; the video prior stays on the card."""
    dtype = _trained_type(options)
    with predicted():
        model = _model(config)
        views = _views(options, config)
        batch = TrainingBatch(views, torch.rand_like(views.images), 1 + views.depth)
        optimizer = OptimizerOptions(batch=1, precision=name_of(dtype), recompute=recompute)
        peaks = step_peaks(model, batch, optimizer, stage=stage)
        weights = _bytes(model) + _prior_bytes(model)
    held = weights + peaks.pop("held")
    return {
        "stage": stage,
        "recompute": recompute,
        "weights_bytes": weights,
        "lasting_bytes": held,
        **{f"{part}_bytes": weights + peak for part, peak in peaks.items()},
        "total_bytes": weights + max(peaks.values()),
    }


def _trained_type(options: CompleteOptions) -> torch.dtype:
    """Training knows no float16."""
    found = options.compute_type
    return torch.float32 if found == torch.float16 else found


def _views(options: CompleteOptions, config: GeoVerseConfig) -> ViewBatch:
    size = options.picture(config)
    return random_views(size, context=options.context, targets=options.targets)


def _model(config: GeoVerseConfig) -> GeoVerse:
    model = GeoVerse(config).eval()
    if config.video is not None:
        model.attach_video(random_video(config.video))
    return model


def _networks(prior: VideoPrior) -> list[Any]:
    return [prior.networks.transformer, prior.networks.vae]


def _bytes(*modules: Any) -> int:
    """Of weights and buffers."""
    tensors = [t for module in modules for t in (*module.parameters(), *module.buffers())]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def _prior_bytes(model: GeoVerse) -> int:
    return 0 if model.video is None else _bytes(*_networks(model.video))
