"""One stage of a training as a user runs it: its start, data, log, sample sheets and weights."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gvtools.completers.geoverse.composition import compose
from gvtools.completers.geoverse.conditioning import encode_views, fill_holes
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.refiner import Refiner
from gvtools.completers.geoverse.video_prior import VideoPrior
from gvtools.completers.geoverse.weights import (
    VIDEO_FOLDER,
    WHOLE_FILE,
    config_of,
    from_pretrained,
    save_pretrained,
)
from gvtools.errors import CheckpointError, OptionError
from gvtools.files import replaced_when_written, write_text
from gvtools.networks.compute import name_of, training_type
from gvtools.networks.config_json import to_json
from gvtools.procedural.textures import photograph_names
from gvtools.runs.digests import folder_digest
from gvtools.training.data import NOTE_PREFIXES, TrainingSamples, sampling_report
from gvtools.training.distributed import Processes, Replicated, models_of
from gvtools.training.loop import FILE, Trainer, saved_identity
from gvtools.training.options import TrainingSettings
from gvtools.training.records import STAGES, TrainingLog, read_log
from gvtools.training.samples import TrainingBatch
from gvtools.training.small_model_stages import (
    EncoderStage,
    HeadsStage,
    RefinerStage,
    decode_heads,
    head_features,
    measure_statistics,
)
from gvtools.training.stages import DenoiserStage, ReflowStage, Stage

WEIGHTS = "weights"
# Settings of all stages, written into the folder of each stage when it is started or resumed.
SETTINGS = "training.json"
SHEET_SAMPLES = 3
# Log keys with these endings count the pixels or samples behind a loss term: logged, not printed.
COUNT_SUFFIXES = ("_pixels", "_empty", "_without_scale")
# Stages after which the model can complete views.
GENERATIVE = ("denoiser", "reflow", "heads", "refiner")
# Those of them that learn from the output of a trained denoiser.
AFTER_DENOISER = ("reflow", "heads", "refiner")
STAGE_OF: dict[str, type[Stage]] = {
    kind.name: kind for kind in (EncoderStage, DenoiserStage, ReflowStage, HeadsStage, RefinerStage)
}


class StageRun:
    """A stage in its folder ``OUT/STAGE``."""

    def __init__(
        self,
        config: TrainingSettings,
        stage: str,  # name of the stage, one of ``STAGES``
        out: Path,  # folder of the whole training; the stage writes into ``out / stage``
        *,
        processes: Processes,
        model_folder: Path | None = None,
        init: Path | None = None,
    ) -> None:
        self.config, self.stage, self.out = config, stage, out
        self.folder = out / stage
        self.processes = processes
        self.model_config = config.network(model_folder)
        if stage != "refiner":
            # It learns from what the finished model makes.
            self.model_config = replace(self.model_config, refiner=None)
        self.init = init
        self.options = getattr(config, stage)
        if self.options is None:
            raise OptionError(f"this training has no stage {stage}; set {stage}.optimizer.steps=N")
        self._source: Path | None = None

    def train(
        self,
        *,
        resume: bool = False,
        until: int | None = None,
        sheet_every: int = 0,
        say: Callable[[str], None] = print,
    ) -> dict[str, float]:
        """Train, and write ``OUT/STAGE/weights`` when all is done; gives the last record."""
        if (self.folder / FILE).exists() and not resume:
            raise CheckpointError(
                f"{self.folder}: a training is there already; continue it with --resume, or "
                "choose another --out"
            )

        def report(text: str) -> None:
            say(f"{self.stage}: {text}")

        self._settle_precision(resume, report)
        model = self._start(report)
        distributed = self._distributed(STAGE_OF[self.stage](model, self.options), model.video)
        if distributed.about:
            report(distributed.about)
        samples = TrainingSamples(self.config, self.model_config)
        identity = self._identity()
        if samples.sources is not None:
            identity["sources"] = samples.sources
        trainer = Trainer(
            distributed,
            self.options.optimizer,
            samples.batches,
            folder=self.folder,
            seed=self.config.seed,
            identity=identity,
        )
        if resume and trainer.resume():
            if trainer.finished and (self.folder / WEIGHTS / WHOLE_FILE).is_file():
                # Keep them: rewritten weights could differ by rounding, and a later stage that
                # started from these would refuse to resume.
                report(f"finished before, weights in {self.folder / WEIGHTS}")
                return read_log(self.folder)[-1]
            report(f"goes on after step {trainer.progress.step}")
        if self.processes.first:
            self.folder.mkdir(parents=True, exist_ok=True)
            text = json.dumps(self.config.to_dict(), indent=2) + "\n"
            write_text(self.folder / SETTINGS, text)
        trainer.check_parts(samples.group)
        trainer.train(
            until=until,
            record=self._recorder(trainer.progress.step, say),
            sheet_every=sheet_every,
            sheet=self._sheet_writer(model, distributed, samples) if sheet_every else None,
        )
        for line in sampling_report(trainer.progress.drawn):
            report(line)
        if trainer.finished:
            self._write_weights(model, trainer, samples)
            report(f"weights in {self.folder / WEIGHTS}")
        records = read_log(self.folder)
        return records[-1] if records else {}

    def _settle_precision(self, resume: bool, report: Callable[[str], None]) -> None:
        """Put what ``auto`` means here into the options; a continued stage stays with its own."""
        optimizer = self.options.optimizer
        if optimizer.precision != "auto":
            return
        before = saved_identity(self.folder) if resume else {}
        name = before.get("options", {}).get("optimizer", {}).get("precision", "auto")
        if name == "auto":
            measured = training_type("auto", self.processes.device)
            # Times differ between processes; the first one's count.
            rounded = self.processes.any(self.processes.first and measured == torch.bfloat16)
            name = name_of(torch.bfloat16 if rounded else torch.float32)
        self.options = self.options.replaced(optimizer=optimizer.replaced(precision=name))
        report(f"products in {name}")

    def _recorder(
        self, step: int, say: Callable[[str], None]
    ) -> Callable[[int, dict[str, float]], None] | None:
        """Writes and says a record; None in all processes but the first."""
        if not self.processes.first:
            return None
        log = TrainingLog(self.folder, step=step)

        def record(step: int, values: dict[str, float]) -> None:
            log.write(step, values)
            shown = ", ".join(
                f"{k} {v:.4g}"
                for k, v in values.items()
                if not (k.endswith(COUNT_SUFFIXES) or k.startswith(NOTE_PREFIXES))
            )
            say(f"{self.stage} step {step} of {self.options.optimizer.steps}: {shown}")

        return record

    def _sheet_writer(
        self, model: GeoVerse, distributed: Replicated, samples: TrainingSamples
    ) -> Callable[[int], None] | None:
        """A function (step) that writes a PNG grid of completed held-out samples.

        None in processes that neither write it nor hold parameters needed to compute it.
        """
        if not (distributed.collective or self.processes.first):
            return None
        held_out = samples.held_out(SHEET_SAMPLES).to(self.processes.device)
        draw = encoder_sheet if self.stage == "encoder" else completion_sheet

        def sheet(step: int) -> None:
            # Sharded parameters: the forward pass needs every process, though only one writes.
            with distributed.usable():
                drawn = draw(model, held_out)
            if self.processes.first:
                write_png(self.folder / "sheets" / f"step_{step:06d}.png", drawn)

        return sheet

    def _start(self, report: Callable[[str], None]) -> GeoVerse:
        """Build the model from ``init``, else the last earlier stage with weights, else at random.

        Sets ``_source`` (the weights' folder, None for random weights); for stages "heads" and
        "refiner" it also takes the sampling of the start weights into ``model_config``.
        ``_identity`` needs both.
        """
        before = STAGES[: STAGES.index(self.stage)]
        source = self.init or self._weights_before(before)
        if source is None and before:
            made = [name for name in before if getattr(self.config, name) is not None]
            first = f"run --stage {made[-1]} first, or give" if made else "give"
            raise CheckpointError(
                f"stage {self.stage} needs weights to start from; {first} --init DIR (gvtools "
                "weights fetch)"
            )
        if source is None:
            torch.manual_seed(self.config.seed)
            return GeoVerse(self.model_config)
        report(f"starts from {source}")
        self._source = source
        if self.stage in AFTER_DENOISER:
            made_for = config_of(source)
            if not made_for.trained:
                raise CheckpointError(
                    f"{source}: its denoisers are untrained, and stage {self.stage} learns "
                    "from what they make; run --stage denoiser to its end first"
                )
            if self.stage in ("heads", "refiner"):
                # The interval bounds and cfg_scale that the weights were made for.
                own, flow = self.model_config.flow, made_for.flow
                flow = replace(own, level1=flow.level1, cfg_scale=flow.cfg_scale)
                self.model_config = replace(self.model_config, flow=flow)
        if self.model_config.video is not None and not (source / VIDEO_FOLDER).is_dir():
            raise CheckpointError(
                f"{source}: no {VIDEO_FOLDER}/; training {self.model_config.name} needs the video "
                "prior; make it with gvtools weights truncate-wan, or train a model with injection "
                "= 'none'"
            )
        return self._model_of(source)

    def _model_of(self, source: Path) -> GeoVerse:
        """The model of a weights folder: its refiner is left out, or a fresh one put in."""
        wanted, found = self.model_config.refiner, config_of(source).refiner
        model = from_pretrained(
            source, config=replace(self.model_config, refiner=found), video=True
        )
        if wanted == found:
            return model
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.seed)
            model.refiner = None if wanted is None else Refiner(wanted)
        model.config = self.model_config
        return model

    def _weights_before(self, before: Sequence[str]) -> Path | None:
        """The weights of the last earlier stage; one that was begun and not finished is refused."""
        for name in reversed(before):
            folder = self.out / name
            if (folder / WEIGHTS).exists():
                return folder / WEIGHTS
            if (folder / FILE).exists():
                raise CheckpointError(
                    f"{folder}: stage {name} was begun and is not finished; run --stage {name} "
                    f"--resume to its end, remove that folder, or name weights with --init DIR"
                )
        return None

    def _distributed(self, module: Stage, video: VideoPrior | None) -> Replicated:
        """Wrap the stage for data-parallel or sharded training."""
        if video is not None:
            for model in models_of(module):
                # Student and teacher share one video prior; it is large and never trained.
                model.attach_video(video)
        if self.config.parallel == "sharded" and self.processes.count > 1:
            from gvtools.training.sharded import Sharded

            return Sharded(module, self.processes)
        return Replicated(module, self.processes)

    def _identity(self) -> dict[str, Any]:
        """The settings that must be unchanged when a stage is resumed; kept with its state."""
        data = self.config.data.to_dict()
        for name in ("workers", "cache"):
            data.pop(name)
        model = to_json(self.model_config)
        # Used when views are completed, not in training.
        for name in ("alignment", "color_alignment"):
            model.pop(name)
        model["flow"].pop("temperature")
        options = self.options.to_dict()
        # Memory for time: the same gradients.
        options["optimizer"].pop("recompute")
        return {
            "stage": self.stage,
            "seed": self.config.seed,
            "model": model,
            # The samples depend on which photographs are installed.
            "photographs": list(photograph_names("train")),
            "options": options,
            "start": (
                # The video prior is left out: no stage trains it.
                None if self._source is None else folder_digest(self._source, without=VIDEO_FOLDER)
            ),
            "data": data,
        }

    def _write_weights(self, model: GeoVerse, trainer: Trainer, samples: TrainingSamples) -> None:
        """Write the averaged weights; after stage ``encoder`` with the latents' statistics."""
        with trainer.ema.swapped_in():
            whole = trainer.distributed.whole_model(model)
            if whole is not None:
                if self.stage == "encoder":
                    device = self.processes.device
                    batches: list[TrainingBatch] = [
                        samples.aside(index, self.options.optimizer.batch).to(device)
                        for index in range(self.options.statistics)
                    ]
                    measure_statistics(whole.to(device), batches)
                # ``trained`` says whether these weights can complete views; an encoder's cannot.
                config = self.model_config
                if self.stage == "reflow":
                    # One Euler step for each distilled interval; a teacher's guidance is learnt.
                    flow = replace(config.flow, level1=self.options.bounds or config.flow.level1)
                    if self.options.cfg_scale != 1:
                        flow = replace(flow, cfg_scale=1.0)
                    config = replace(config, flow=flow)
                whole.config = replace(config, trained=self.stage in GENERATIVE)
                save_pretrained(whole, self.folder / WEIGHTS)
                if config.video is not None and self._source is not None:
                    # It is not trained, so it is not copied.
                    link = self.folder / WEIGHTS / VIDEO_FOLDER
                    if link.is_symlink():
                        link.unlink()
                    if not link.exists():
                        target = (self._source / VIDEO_FOLDER).resolve()
                        link.symlink_to(target, target_is_directory=True)
        # No process may read the weights before the first one has written them.
        self.processes.wait()


GAP = 4


@torch.no_grad()
def completion_sheet(model: GeoVerse, batch: TrainingBatch, *, seed: int = 0) -> NDArray[np.uint8]:
    """(H, W, 3) picture of six bands a sample: hints, completions, truth; then of their depth.

    Context pictures stay; the depth of each sample is shown in its own range.
    """
    training = model.training
    model.eval()
    generated = model.generate(batch.views, seed=seed)
    model.train(training)
    context = batch.views.context
    hints = fill_holes(batch.views, model.config.hints)
    rgb, lengths = compose(hints, generated.decoded, generated.hint)
    pictures = batch.images.clone()
    pictures[:, context:] = rgb.clamp(0, 1)
    depth = generated.decoded.geometry.depth[:, :, None].float()
    depth[:, context:] = lengths[:, :, None]
    return _bands((hints.images, pictures, batch.images), (hints.depth, depth, batch.depth))


@torch.no_grad()
def encoder_sheet(model: GeoVerse, batch: TrainingBatch) -> NDArray[np.uint8]:
    """(H, W, 3) four bands a sample: pictures decoded from their own features, true ones, depth."""
    levels = encode_views(model.geometry, batch.true_views, slice(None), config=model.config.hints)
    geometry, rgb = decode_heads(model, head_features(model, levels, batch)[0], batch)
    return _bands((rgb.clamp(0, 1), batch.images), (geometry.depth[:, :, None], batch.depth))


def _bands(pictures: Sequence[Tensor], depths: Sequence[Tensor]) -> NDArray[np.uint8]:
    """The bands of each sample under each other, of (B, V, 3, H, W) and (B, V, 1, H, W)."""
    bands: list[NDArray[np.uint8]] = []
    gaps = ((0, 0), (0, GAP), (0, GAP), (0, 0))
    for index in range(len(pictures[0])):
        shown = [255 * values[index].cpu().permute(0, 2, 3, 1).numpy() for values in pictures]
        tiles = [values.round().clip(0, 255) for values in shown]
        tiles += [_shade(values[index]) for values in depths]
        for views in tiles:
            padded = np.pad(views.astype(np.uint8), gaps, constant_values=255)
            # (V, H, W, 3) side by side.
            bands.append(np.concatenate(list(padded), axis=1))
    return np.concatenate(bands)


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Written under another name, then renamed."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_when_written(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG")


def _shade(depth: Tensor) -> NDArray[np.floating[Any]]:
    """(V, 1, H, W) to (V, H, W, 3) in [0, 255]; near is bright, unknown black."""
    values = depth[:, 0].cpu().numpy()
    known = values > 0
    inverse = np.where(known, 1 / np.where(known, values, 1), 0)
    top = np.percentile(inverse[known], 98) if known.any() else 1.0
    grey = np.clip(inverse / max(top, 1e-12), 0, 1) * 255
    return np.repeat(grey[..., None], 3, axis=-1)
