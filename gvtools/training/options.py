"""Settings of training: the model, the data, and each of the three stages."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from gvtools.completers.geoverse.config import GeoVerseConfig, named, read
from gvtools.completers.geoverse.flow import check_bounds
from gvtools.errors import OptionError
from gvtools.networks import TrainingPrecision
from gvtools.settings import Settings, with_file
from gvtools.training.corruption import GENTLE, CorruptionOptions

# Trainings that ship; NAME_model.json beside one is a model's configuration of its own.
SHIPPED = Path(__file__).parent / "configs"
Share = Annotated[float, Field(ge=0, le=1)]
Decay = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=1)]


class OptimizerOptions(Settings):
    """How any stage is optimised."""

    section = "optimizer"

    steps: int = Field(1000, ge=1)
    """Optimiser steps."""
    batch: int = Field(8, ge=1)
    """Samples a step, over all processes and accumulated parts."""
    accumulate: int = Field(1, ge=1)
    """Parts that a process cuts its share of a batch into."""
    rate: float = Field(1e-3, gt=0)
    """Learning rate after the warm-up."""
    warmup: Share = 0.03
    """Share of the steps with a rising rate."""
    schedule: Literal["cosine", "constant"] = "cosine"
    """Cosine falls to ``final`` x rate, constant does not."""
    final: Share = 0.05
    """See ``schedule``."""
    cycles: int = Field(1, ge=1)
    """How often the schedule runs within the steps, warm-up included (warm restarts, Loshchilov and
    Hutter 2017)."""
    betas: tuple[Decay, Decay] = (0.9, 0.95)
    """Of AdamW, each at least 0 and less than 1."""
    weight_decay: float = Field(0.02, ge=0)
    """Of AdamW, on matrices and kernels alone."""
    clip: float = Field(1.0, gt=0)
    """Largest norm of the gradient."""
    ema: Decay = 0.9995
    """Decay of the averaged weights."""
    precision: TrainingPrecision = "float32"
    """Of products; bfloat16 by autocast. ``auto``: bfloat16 on a GPU of compute capability 8.0 and
    later, and on a CPU that is measured to be faster in it; float32 elsewhere. What was chosen is
    said, and kept when the training is continued. float16 is not trained in: its gradients vanish
    without a loss scale."""
    recompute: bool = False
    """Layers are computed again in the backward pass instead of being kept: the same gradients and
    a fraction of the memory for about a quarter more time."""
    largest_loss: float = Field(1000.0, gt=0)
    """A batch with a larger loss, or one that is not finite, is skipped and counted."""

    @model_validator(mode="after")
    def _check(self) -> OptimizerOptions:
        if self.cycles > self.steps:
            raise OptionError(
                f"optimizer.cycles {self.cycles}; expected at most optimizer.steps {self.steps}"
            )
        return self

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


class FeatureOptions(Settings):
    """What every stage that trains heads does to the features they get."""

    hints: Share = 0.3
    """Share of target views that show their (filled) projection instead of the picture, so that the
    frozen encoder has seen such pictures."""
    noise: float = Field(0.4, ge=0)
    """Largest noise on the features that the heads get. [standard deviations]"""
    drop_level0: Share = 0.3
    """Share of samples whose level 0 is left at its mean."""


class EncoderStageOptions(FeatureOptions):
    """Stage 0: the geometric encoder with its three heads, from true pictures."""

    section = "encoder"

    optimizer: OptimizerOptions = OptimizerOptions()
    depth: float = Field(1.0, ge=0)
    """Weight of the log-depth error."""
    gradient: float = Field(0.5, ge=0)
    """Weight of the log-depth gradients' error."""
    ray: float = Field(1.0, ge=0)
    """Weight of the rays' directions and origins."""
    rgb: float = Field(2.0, ge=0)
    """Weight of the colour error."""
    hf: float = Field(0.5, ge=0)
    """Weight of the colour error in high-gradient regions."""
    pose: float = Field(0.1, ge=0)
    """Weight of the camera decoder's error."""
    statistics: int = Field(32, ge=1)
    """Batches over which the latents' statistics are measured at the end."""


class LossWeights(Settings):
    """Coefficients of the terms; the paper gives none."""

    section = "denoiser.weights"

    level1: float = Field(1.0, ge=0)
    """Of L_FM^1."""
    level0: float = Field(1.0, ge=0)
    """Of L_FM^0."""
    rgb: float = Field(1.0, ge=0)
    """Of L_rgb."""
    hf: float = Field(1.0, ge=0)
    """Of L_hf."""
    depth: float = Field(1.0, ge=0)
    """Of L_depth."""


class DenoiserStageOptions(Settings):
    """Stage 1: both denoisers under the complete objective."""

    section = "denoiser"

    optimizer: OptimizerOptions = OptimizerOptions()
    weights: LossWeights = LossWeights()
    """Coefficients of the five terms."""
    context_weight: float = Field(0.25, ge=0)
    """Of context views in the latent terms."""
    cameras: Share = 0.0
    """Share of samples whose cameras are dropped, for guidance."""
    source_noise: float = Field(0.2, ge=0)
    """Largest noise on the true level 1 that the cascade is given. [standard deviations]"""
    decode: Share = 1.0
    """Share of steps with decoded terms."""


class ReflowStageOptions(Settings):
    """Stage 2: piecewise reflow distillation of level 1."""

    section = "reflow"

    optimizer: OptimizerOptions = OptimizerOptions()
    rho: Share = 0.7
    """Share of the reflow term; the rest is the flow matching term."""
    steps: int = Field(8, ge=1)
    """Of the teacher in each interval."""
    bounds: tuple[float, ...] | None = None
    """Interval bounds tau_0 .. tau_K; none for the model's own."""
    cfg_scale: float = Field(1.0, ge=0)
    """Of the teacher's classifier-free guidance; 1 for none."""
    context_weight: float = Field(0.25, ge=0)
    """Of context views."""

    @model_validator(mode="after")
    def _check(self) -> ReflowStageOptions:
        if self.bounds is not None:
            check_bounds(self.bounds, whole=True)
        return self


class HeadsStageOptions(FeatureOptions):
    """For small models: the heads, on what the frozen denoisers make."""

    section = "heads"

    optimizer: OptimizerOptions = OptimizerOptions()
    temperature: float = Field(1.0, ge=0)
    """Of the completions, see ``FlowConfig``; at 1 the heads see more of what the denoisers are
    unsure of than a model of lower temperature shows them in use."""
    ray: float = Field(1.0, ge=0)
    """Weight of the rays; 0 leaves their head as it is."""
    origin: float = Field(2.0, ge=0)
    """Weight of the origins' error against that of the directions."""
    rgb: float = Field(2.0, ge=0)
    """Weight of the completions' colour; 0 leaves the colour head as it is."""
    hf: float = Field(0.25, ge=0)
    """Of the colour error in high-gradient regions, as a share of it."""
    depth: float = Field(1.0, ge=0)
    """Weight of the completions' log-depth error; 0 leaves the depth head as it is."""
    decoded: float = Field(0.5, ge=0)
    """Of the decodings' own errors, as a share of those of what is composed of them."""

    @model_validator(mode="after")
    def _check(self) -> HeadsStageOptions:
        if not (self.ray or self.rgb or self.depth):
            raise OptionError("heads: ray, rgb and depth are all 0; give one of them a weight")
        return self


class RefinerStageOptions(Settings):
    """After the heads, for small models: the refiner, on what the frozen core makes."""

    section = "refiner"

    optimizer: OptimizerOptions = OptimizerOptions()
    depth: float = Field(0.2, ge=0)
    """Weight of what is said of the depth against the colours."""


class SceneSource(Settings):
    """Recorded scenes that samples are drawn from, with what a path alone does not tell."""

    section = "data.scenes"

    project: str
    """A project, a folder of shards, "spec:NAME" for a data set or "spec:NAME:SCENE"."""
    root: str | None = None
    """Folder of the data set's download, with spec: alone."""
    weight: float | None = Field(None, ge=0)
    """Against those of other entries; none for the root of the number of images, of the whole data
    set where a spec tells it."""
    estimated: str | None = None
    """A project or shards of the same scenes with estimated poses and depth, for the samples that
    are not to have the data set's own."""


class DataOptions(Settings):
    """Where samples come from."""

    section = "data"

    views: int = Field(8, ge=2)
    """Of a sample."""
    size: tuple[Count, Count] = (96, 96)
    """(H, W) of the pictures. [px]"""
    workers: int = Field(1, ge=0)
    """Processes that render; 0 renders in the training process."""
    pool: int = Field(0, ge=0, multiple_of=8)
    """So many samples are made and seen again and again, a multiple of 8; 0: every sample is
    new."""
    cache: str | None = None
    """Folder where a pool's samples are kept; none makes them anew each time."""
    projections: bool = True
    """False: nothing of the memory is projected into the targets."""
    faults: CorruptionOptions = CorruptionOptions()
    """Of procedural observations."""
    scene_faults: CorruptionOptions = GENTLE
    """Of those from ``scenes``, on top of what recorded depth has anyway."""
    scenes: tuple[str | SceneSource, ...] = ()
    """Recorded scenes, mixed in by ``scene_share``: paths of projects or shards, "spec:NAME" or
    objects of ``project``, ``root``, ``weight``, ``estimated``, see the page on training data."""
    scene_share: Share = 0.0
    """Share of samples from ``scenes``; the others are procedural rooms."""
    scene_select: str = "all"
    """Which of their views are used, a selection such as "every:20"."""
    scene_overlap: Decay = 0.4
    """Least share of a view's depth that the next view of a sample shows, too."""

    @model_validator(mode="after")
    def _check(self) -> DataOptions:
        if self.cache is not None and not self.pool:
            raise OptionError("data.cache needs data.pool, the number of samples to keep")
        if bool(self.scenes) != (self.scene_share > 0):
            raise OptionError(
                f"data.scene_share {self.scene_share:g} with {len(self.scenes)} data.scenes; "
                "expected both or none of them"
            )
        return self


class TrainingSettings(Settings):
    """Everything that decides what a training computes."""

    model: str = "tiny"
    """A configuration by name ("tiny", "base") or the path of its JSON file."""
    seed: int = Field(0, ge=0)
    """Of everything random."""
    parallel: Literal["data", "sharded"] = "data"
    """What several processes hold: data, each of them everything; sharded, a part of all
    parameters, gradients, averages and moments each (FSDP2), for large models. The result is the
    same, and a training may go on in the other way."""
    data: DataOptions = DataOptions()
    encoder: EncoderStageOptions | None = EncoderStageOptions()
    """Stage 0; none leaves it out, where the encoder is a published one."""
    denoiser: DenoiserStageOptions = DenoiserStageOptions()
    """Stage 1."""
    reflow: ReflowStageOptions = ReflowStageOptions()
    """Stage 2."""
    heads: HeadsStageOptions | None = None
    """A small model's heads; none leaves them as they are."""
    refiner: RefinerStageOptions | None = None
    """The last stage, of a model with a refiner; none leaves it out."""

    def network(self, folder: Path | None = None) -> GeoVerseConfig:
        """The network's configuration; a relative path is looked up from ``folder``."""
        if self.model.endswith(".json"):
            return read((folder or Path()) / self.model)
        return named(self.model)


def shipped_or_read(name: str) -> tuple[TrainingSettings, Path]:
    """A training by the name of one that ships, or from its JSON file.

    Returns:
        The configuration, and the folder of its file.
    """
    if name.endswith(".json"):
        path = Path(name)
        return with_file(TrainingSettings(), path), path.parent
    known = sorted(path.stem for path in SHIPPED.glob("*.json") if "_" not in path.stem)
    if name not in known:
        raise OptionError(f"no training {name!r}; known: {', '.join(known)}, or a .json file")
    return with_file(TrainingSettings(), SHIPPED / f"{name}.json"), SHIPPED
