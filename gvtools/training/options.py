"""Settings of training: the model, the data, and each of the three stages."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gvtools.completers.geoverse.config import GeoVerseConfig, named, read
from gvtools.completers.geoverse.flow import check_bounds
from gvtools.completers.geoverse.objective.objective import LossWeights
from gvtools.errors import OptionError
from gvtools.networks.config_json import from_json, to_json
from gvtools.options import check_range
from gvtools.training.corruption import GENTLE, CorruptionOptions

# Trainings that ship; NAME_model.json beside one is a model's configuration of its own.
SHIPPED = Path(__file__).parent / "configs"


@dataclass(frozen=True, kw_only=True)
class OptimizerOptions:
    """How any stage is optimised.

    Attributes:
        steps: optimiser steps.
        batch: samples a step, over all processes and accumulated parts.
        accumulate: parts that a process cuts its share of a batch into.
        rate: learning rate after the warm-up.
        warmup: share of the steps with a rising rate.
        schedule: "cosine" falls to ``final`` x rate, "constant" does not.
        final: see ``schedule``.
        cycles: how often the schedule runs within the steps, warm-up included (warm restarts,
            Loshchilov and Hutter 2017).
        betas: of AdamW.
        weight_decay: of AdamW, on matrices and kernels alone.
        clip: largest norm of the gradient.
        ema: decay of the averaged weights.
        precision: "float32" or "bfloat16" (autocast).
        largest_loss: a batch with a larger loss, or one that is not finite, is skipped and counted.
    """

    steps: int = 1000
    batch: int = 8
    accumulate: int = 1
    rate: float = 1e-3
    warmup: float = 0.03
    schedule: str = "cosine"
    final: float = 0.05
    cycles: int = 1
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 0.02
    clip: float = 1.0
    ema: float = 0.9995
    precision: str = "float32"
    largest_loss: float = 1000.0

    def __post_init__(self) -> None:
        check_range("optimizer.steps", self.steps, least=1)
        check_range("optimizer.batch", self.batch, least=1)
        check_range("optimizer.accumulate", self.accumulate, least=1)
        check_range("optimizer.rate", self.rate, above=0)
        check_range("optimizer.warmup", self.warmup, least=0, most=1)
        check_range("optimizer.final", self.final, least=0, most=1)
        for beta in self.betas:
            check_range("optimizer.betas", beta, least=0, below=1)
        check_range("optimizer.cycles", self.cycles, least=1, most=self.steps)
        check_range("optimizer.weight_decay", self.weight_decay, least=0)
        check_range("optimizer.clip", self.clip, above=0)
        check_range("optimizer.ema", self.ema, least=0, below=1)
        check_range("optimizer.largest_loss", self.largest_loss, above=0)
        for name, value, known in (
            ("schedule", self.schedule, ("cosine", "constant")),
            ("precision", self.precision, ("float32", "bfloat16")),
        ):
            if value not in known:
                raise OptionError(f"optimizer.{name} = {value!r}; expected {' or '.join(known)}")

    def rate_at(self, step: int) -> float:
        """The learning rate of a step, from 0."""
        cycle = -(-self.steps // self.cycles)
        step = step % cycle
        warm = max(1, round(self.warmup * cycle))
        if step < warm:
            return self.rate * (step + 1) / warm
        if self.schedule == "constant":
            return self.rate
        share = (step - warm) / max(1, cycle - warm)
        cosine = 0.5 * (1 + math.cos(math.pi * share))
        return self.rate * (self.final + (1 - self.final) * cosine)


@dataclass(frozen=True, kw_only=True)
class EncoderStageOptions:
    """Stage 0: the geometric encoder with its three heads, from true pictures.

    Attributes:
        optimizer: see there.
        hints: share of target views that show their (filled) projection instead of the picture, so
            that the frozen encoder has seen such pictures.
        noise: largest noise on the features that the heads get, in standard deviations.
        drop_level0: share of samples whose level 0 is left at its mean.
        depth: weight of the log-depth error.
        gradient: weight of the log-depth gradients' error.
        ray: weight of the rays' directions and origins.
        rgb: weight of the colour error.
        hf: weight of the colour error in high-gradient regions.
        pose: weight of the camera decoder's error.
        statistics: batches over which the latents' statistics are measured at the end.
    """

    optimizer: OptimizerOptions = field(default_factory=OptimizerOptions)
    hints: float = 0.3
    noise: float = 0.4
    drop_level0: float = 0.3
    depth: float = 1.0
    gradient: float = 0.5
    ray: float = 1.0
    rgb: float = 2.0
    hf: float = 0.5
    pose: float = 0.1
    statistics: int = 32

    def __post_init__(self) -> None:
        for name in ("depth", "gradient", "ray", "rgb", "hf", "pose"):
            check_range(f"encoder.{name}", getattr(self, name), least=0)
        _check_features("encoder", self)
        check_range("encoder.statistics", self.statistics, least=1)


@dataclass(frozen=True, kw_only=True)
class DenoiserStageOptions:
    """Stage 1: both denoisers under the complete objective.

    Attributes:
        optimizer: see there.
        weights: coefficients of the five terms.
        context_weight: of context views in the latent terms.
        cameras: share of samples whose cameras are dropped, for guidance.
        source_noise: largest noise on the true level 1 that the cascade is given, deviations.
        decode: share of steps with decoded terms.
    """

    optimizer: OptimizerOptions = field(default_factory=OptimizerOptions)
    weights: LossWeights = field(default_factory=LossWeights)
    context_weight: float = 0.25
    cameras: float = 0.0
    source_noise: float = 0.2
    decode: float = 1.0

    def __post_init__(self) -> None:
        check_range("denoiser.context_weight", self.context_weight, least=0)
        check_range("denoiser.cameras", self.cameras, least=0, most=1)
        check_range("denoiser.source_noise", self.source_noise, least=0)
        check_range("denoiser.decode", self.decode, least=0, most=1)


@dataclass(frozen=True, kw_only=True)
class ReflowStageOptions:
    """Stage 2: piecewise reflow distillation of level 1.

    Attributes:
        optimizer: see there.
        rho: share of the reflow term; the rest is the flow matching term.
        steps: of the teacher in each interval.
        bounds: tau_0 .. tau_K; None for the model's own.
        guidance: of the teacher; 1 for none.
        context_weight: of context views.
    """

    optimizer: OptimizerOptions = field(default_factory=OptimizerOptions)
    rho: float = 0.7
    steps: int = 8
    bounds: tuple[float, ...] | None = None
    guidance: float = 1.0
    context_weight: float = 0.25

    def __post_init__(self) -> None:
        check_range("reflow.rho", self.rho, least=0, most=1)
        check_range("reflow.steps", self.steps, least=1)
        check_range("reflow.guidance", self.guidance, least=0)
        check_range("reflow.context_weight", self.context_weight, least=0)
        if self.bounds is not None:
            check_bounds(self.bounds, whole=True)


@dataclass(frozen=True, kw_only=True)
class HeadsStageOptions:
    """The last stage, for small models: the heads, on what the frozen denoisers make.

    Attributes:
        optimizer: see there.
        hints: as of the encoder's stage; of the rays' features.
        noise: likewise.
        drop_level0: likewise.
        temperature: of the completions, see ``FlowConfig``; at 1 the heads see more of what the
            denoisers are unsure of than a model of lower temperature shows them in use.
        ray: weight of the rays; 0 leaves their head as it is.
        origin: weight of the origins' error against that of the directions.
        rgb: weight of the completions' colour; 0 leaves the colour head as it is.
        hf: of the colour error in high-gradient regions, as a share of it.
        depth: weight of the completions' log-depth error; 0 leaves the depth head as it is.
        decoded: of the decodings' own errors, as a share of those of what is composed of them.
    """

    optimizer: OptimizerOptions = field(default_factory=OptimizerOptions)
    hints: float = 0.3
    noise: float = 0.4
    drop_level0: float = 0.3
    temperature: float = 1.0
    ray: float = 1.0
    origin: float = 2.0
    rgb: float = 2.0
    hf: float = 0.25
    depth: float = 1.0
    decoded: float = 0.5

    def __post_init__(self) -> None:
        for name in ("temperature", "ray", "origin", "rgb", "hf", "depth", "decoded"):
            check_range(f"heads.{name}", getattr(self, name), least=0)
        _check_features("heads", self)
        if not (self.ray or self.rgb or self.depth):
            raise OptionError("heads: ray, rgb and depth are all 0; give one of them a weight")


def _check_features(stage: str, options: EncoderStageOptions | HeadsStageOptions) -> None:
    """Of the features that heads are trained on."""
    check_range(f"{stage}.hints", options.hints, least=0, most=1)
    check_range(f"{stage}.noise", options.noise, least=0)
    check_range(f"{stage}.drop_level0", options.drop_level0, least=0, most=1)


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """Where samples come from.

    Attributes:
        views: of a sample.
        size: (H, W) of the pictures, px.
        workers: processes that render; 0 renders in the training process.
        pool: so many samples are made and seen again and again; 0: every sample is new.
        cache: folder where a pool's samples are kept; None makes them anew each time.
        projections: False: nothing of the memory is projected into the targets.
        faults: of procedural observations, see CorruptionOptions.
        scene_faults: of those from ``scenes``, on top of what recorded depth has anyway.
        scenes: paths of projects that gvtools reads, mixed in by ``scene_share``.
        scene_share: share of samples from ``scenes``.
        scene_select: which of their views are used, a selection such as "every:20".
        scene_overlap: least share of a view's depth that the next view of a sample shows, too.
    """

    views: int = 8
    size: tuple[int, int] = (96, 96)
    workers: int = 1
    pool: int = 0
    cache: str | None = None
    projections: bool = True
    faults: CorruptionOptions = field(default_factory=CorruptionOptions)
    scene_faults: CorruptionOptions = GENTLE
    scenes: tuple[str, ...] = ()
    scene_share: float = 0.0
    scene_select: str = "all"
    scene_overlap: float = 0.4

    def __post_init__(self) -> None:
        check_range("data.views", self.views, least=2)
        for side in self.size:
            check_range("data.size", side, least=1)
        check_range("data.workers", self.workers, least=0)
        check_range("data.pool", self.pool, least=0)
        if self.cache is not None and not self.pool:
            raise OptionError("data.cache needs data.pool, the number of samples to keep")
        check_range("data.scene_share", self.scene_share, least=0, most=1)
        check_range("data.scene_overlap", self.scene_overlap, least=0, below=1)


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """Everything that decides what a training computes.

    Attributes:
        model: a configuration by name ("tiny", "base") or the path of its JSON file.
        seed: of everything random.
        parallel: what several processes hold: "data", each of them everything; "sharded", a part
            of all parameters, gradients, averages and moments each (FSDP2), for large models. The
            result is the same, and a training may go on in the other way.
        data: see DataOptions.
        encoder: stage 0; None leaves it out, where the encoder is a published one.
        denoiser: stage 1.
        reflow: stage 2.
        heads: the last stage; None leaves it out.
    """

    model: str = "tiny"
    seed: int = 0
    parallel: str = "data"
    data: DataOptions = field(default_factory=DataOptions)
    encoder: EncoderStageOptions | None = field(default_factory=EncoderStageOptions)
    denoiser: DenoiserStageOptions = field(default_factory=DenoiserStageOptions)
    reflow: ReflowStageOptions = field(default_factory=ReflowStageOptions)
    heads: HeadsStageOptions | None = None

    def __post_init__(self) -> None:
        if self.parallel not in ("data", "sharded"):
            raise OptionError(f"parallel = {self.parallel!r}; expected data or sharded")

    def model_config(self, folder: Path | None = None) -> GeoVerseConfig:
        """The model's configuration; a relative path is looked up from ``folder``."""
        if self.model.endswith(".json"):
            return read((folder or Path()) / self.model)
        return named(self.model)


def shipped_or_read(name: str) -> tuple[TrainingConfig, Path]:
    """A training by the name of one that ships, or from its JSON file.

    Returns:
        The configuration, and the folder of its file.

    Raises:
        OptionError: no such training or file, an unknown key, or a wrong value.
    """
    if name.endswith(".json"):
        path = Path(name)
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise OptionError(f"{path}: cannot be read ({error})") from None
        return _parsed(text, path.name), path.parent
    known = sorted(path.stem for path in SHIPPED.glob("*.json") if "_model" not in path.stem)
    if name not in known:
        raise OptionError(f"no training {name!r}; known: {', '.join(known)}, or a .json file")
    return _parsed((SHIPPED / f"{name}.json").read_text(encoding="utf-8"), name), SHIPPED


def with_settings(config: TrainingConfig, texts: Sequence[str]) -> TrainingConfig:
    """The configuration with ``a.b=VALUE`` texts applied; values are JSON, or else plain text.

    Raises:
        OptionError: no ``=``, an unknown key, or a wrong value.
    """
    data = to_json(config)
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise OptionError(f"--set {text!r}; expected KEY=VALUE")
        *path, last = key.strip().split(".")
        section = data
        for name in path:
            # A stage that the training does not have begins with its defaults.
            section[name] = {} if section.get(name) is None else section[name]
            section = section[name]
            if not isinstance(section, dict):
                raise OptionError(f"--set {text!r}: {name} has a value, no settings of its own")
        try:
            section[last] = json.loads(value)
        except ValueError:
            section[last] = value.strip()
    return from_json(TrainingConfig, data, where="training")


def _parsed(text: str, where: str) -> TrainingConfig:
    try:
        data = json.loads(text)
    except ValueError as error:
        raise OptionError(f"{where}: no readable JSON ({error})") from None
    return from_json(TrainingConfig, data, where=where)
