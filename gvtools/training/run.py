"""One stage of a training as a user runs it: its start, its data, its log, its weights."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gvtools.completers.geoverse.config import FlowConfig, GeoVerseConfig
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.video_prior.prior import VideoPrior
from gvtools.completers.geoverse.weights.folder import config_of, from_pretrained, save_pretrained
from gvtools.completers.geoverse.weights.published import VIDEO_FOLDER, WHOLE_FILE
from gvtools.errors import CheckpointError, OptionError
from gvtools.files import write_text
from gvtools.networks.config_json import to_json
from gvtools.procedural.photographs import photograph_names
from gvtools.training.batch import TrainingBatch
from gvtools.training.denoiser_stage import DenoiserStage
from gvtools.training.distributed import Processes, Replicated, models_of
from gvtools.training.encoder_stage import EncoderStage, measure_statistics
from gvtools.training.heads_stage import HeadsStage
from gvtools.training.loop import Record, Reporting, Trainer
from gvtools.training.options import ReflowStageOptions, TrainingSettings
from gvtools.training.records import STAGES, TrainingLog, read_log
from gvtools.training.reflow_stage import ReflowStage
from gvtools.training.samples import TrainingSamples
from gvtools.training.sheets import completion_sheet, encoder_sheet, write_png
from gvtools.training.stage import Stage
from gvtools.training.state import FILE

WEIGHTS = "weights"
# The whole training's settings, as the stage was last run with them.
SETTINGS = "training.json"
SHEET_SAMPLES = 3
# Endings of what terms stood on: in the log, not on the screen.
COUNTS = ("_pixels", "_empty", "_without_scale")
# Stages whose weights complete views, and those of them that need others' to learn from.
GENERATIVE = ("denoiser", "reflow", "heads")
AFTER_DENOISER = ("reflow", "heads")
STAGE_OF: dict[str, type[Stage]] = {
    kind.name: kind for kind in (EncoderStage, DenoiserStage, ReflowStage, HeadsStage)
}
# Bytes at each end of a weights file that tell it from another.
READ = 2**22


class StageRun:
    """A stage in its folder ``OUT/STAGE``.

    Args:
        config: of the training.
        stage: its name.
        out: of the training; each stage has a folder in it.
        processes: this process and the others.
        model_folder: where a relative path of the model's configuration is looked up.
        init: weights to start from, instead of the stage before.
    """

    def __init__(
        self,
        config: TrainingSettings,
        stage: str,
        out: Path,
        *,
        processes: Processes,
        model_folder: Path | None = None,
        init: Path | None = None,
    ) -> None:
        self.config, self.stage, self.out = config, stage, out
        self.folder = out / stage
        self.processes = processes
        self.model_config = config.network(model_folder)
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
        """Train, and write ``OUT/STAGE/weights`` from the averaged weights when all is done.

        Returns:
            The last record.

        Raises:
            CheckpointError: there is a state and ``resume`` is not set, or one that does not fit.
        """
        if (self.folder / FILE).exists() and not resume:
            raise CheckpointError(
                f"{self.folder}: a training is there already; continue it with --resume, or "
                "choose another --out"
            )
        model = self._start(say)
        distributed = self._distributed(STAGE_OF[self.stage](model, self.options), model.video)
        if distributed.about:
            say(f"{self.stage}: {distributed.about}")
        samples = TrainingSamples(self.config, self.model_config)
        trainer = Trainer(
            distributed,
            self.options.optimizer,
            samples.batches,
            folder=self.folder,
            seed=self.config.seed,
            identity=self._identity(),
        )
        if resume and trainer.resume():
            if trainer.finished and (self.folder / WEIGHTS / WHOLE_FILE).is_file():
                # Written again, they might differ in a digit; the next stage's state would not fit.
                say(f"{self.stage}: finished before, weights in {self.folder / WEIGHTS}")
                return _last(self.folder)
            say(f"{self.stage}: goes on after step {trainer.progress.step}")
        if self.processes.first:
            self.folder.mkdir(parents=True, exist_ok=True)
            text = json.dumps(self.config.to_dict(), indent=2) + "\n"
            write_text(self.folder / SETTINGS, text)
        trainer.check_parts(samples.group)
        reporting = Reporting(
            record=self._recorder(trainer.progress.step, say),
            sheet_every=sheet_every,
            sheet=self._sheet_writer(model, distributed, samples) if sheet_every else None,
        )
        trainer.train(reporting, until=until)
        if trainer.finished:
            self._write_weights(model, trainer, samples)
            say(f"{self.stage}: weights in {self.folder / WEIGHTS}")
        return _last(self.folder)

    def _recorder(self, step: int, say: Callable[[str], None]) -> Record | None:
        """Writes and says a record; None in all processes but the first."""
        if not self.processes.first:
            return None
        log = TrainingLog(self.folder, step=step)

        def record(step: int, values: dict[str, float]) -> None:
            log.write(step, values)
            shown = ", ".join(f"{k} {v:.4g}" for k, v in values.items() if not k.endswith(COUNTS))
            say(f"{self.stage} step {step} of {self.options.optimizer.steps}: {shown}")

        return record

    def _sheet_writer(
        self, model: GeoVerse, distributed: Replicated, samples: TrainingSamples
    ) -> Callable[[int], None] | None:
        """Draws held-out samples; None in a process that has no part in that."""
        if not (distributed.collective or self.processes.first):
            return None
        held_out = samples.held_out(SHEET_SAMPLES).to(self.processes.device)
        draw = encoder_sheet if self.stage == "encoder" else completion_sheet

        def sheet(step: int) -> None:
            # What processes hold parts of, all of them have to run.
            with distributed.usable():
                drawn = draw(model, held_out)
            if self.processes.first:
                write_png(self.folder / "sheets" / f"step_{step:06d}.png", drawn)

        return sheet

    def _start(self, say: Callable[[str], None]) -> GeoVerse:
        """The model that the stage begins with; every process makes the same."""
        before = STAGES[: STAGES.index(self.stage)]
        source = self.init
        if source is None:
            self._refuse_unfinished(before)
            weights = [self.out / name / WEIGHTS for name in reversed(before)]
            source = next((folder for folder in weights if folder.exists()), None)
        if source is None and before:
            raise CheckpointError(
                f"stage {self.stage} needs weights to start from; run --stage {before[-1]} first, "
                "or give --init DIR"
            )
        if source is None:
            torch.manual_seed(self.config.seed)
            return GeoVerse(self.model_config)
        say(f"{self.stage}: starts from {source}")
        self._source = source
        if self.stage in AFTER_DENOISER:
            found = config_of(source)
            if not found.trained:
                raise CheckpointError(
                    f"{source}: its denoisers are untrained, and stage {self.stage} learns "
                    "from what they make; run --stage denoiser to its end first"
                )
            if self.stage == "heads":
                self.model_config = _sampled_as(self.model_config, found.flow)
        return from_pretrained(source, config=self.model_config)

    def _refuse_unfinished(self, before: Sequence[str]) -> None:
        """A stage that was begun and not finished must not be passed over for one before it.

        Raises:
            CheckpointError: there is one.
        """
        for name in reversed(before):
            folder = self.out / name
            if (folder / WEIGHTS).exists():
                return
            if (folder / FILE).exists():
                raise CheckpointError(
                    f"{folder}: stage {name} was begun and is not finished; run --stage {name} "
                    f"--resume to its end, remove that folder, or name weights with --init DIR"
                )

    def _distributed(self, module: Stage, video: VideoPrior | None) -> Replicated:
        """What this process holds of the stage."""
        if video is not None:
            for model in models_of(module):
                # A teacher does without its copy: it is large, and never trained.
                model.attach_video(video)
        if self.config.parallel == "sharded" and self.processes.count > 1:
            from gvtools.training.sharded import Sharded

            return Sharded(module, self.processes)
        return Replicated(module, self.processes)

    def _identity(self) -> dict[str, Any]:
        """What may not change between the parts of a stage."""
        data = self.config.data.to_dict()
        for name in ("workers", "cache"):
            data.pop(name)
        model = to_json(self.model_config)
        # Of completions alone.
        for name in ("alignment", "color_alignment"):
            model.pop(name)
        model["flow"].pop("temperature")
        return {
            "stage": self.stage,
            "seed": self.config.seed,
            "model": model,
            # Those that are installed decide the samples.
            "photographs": list(photograph_names("train")),
            "options": self.options.to_dict(),
            "start": None if self._source is None else _fingerprint(self._source),
            "data": data,
        }

    def _write_weights(self, model: GeoVerse, trainer: Trainer, samples: TrainingSamples) -> None:
        """The averaged weights; after stage 0 with the latents' statistics."""
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
                # An encoder alone completes nothing.
                config = self.model_config
                if self.stage == "reflow":
                    config = _distilled(config, self.options)
                whole.config = replace(config, trained=self.stage in GENERATIVE)
                save_pretrained(whole, self.folder / WEIGHTS)
                self._link_video()
        # The next stage starts from them, in every process.
        self.processes.wait()

    def _link_video(self) -> None:
        """The video prior, which is not trained, lies where the stage's start has it."""
        link = self.folder / WEIGHTS / VIDEO_FOLDER
        if self.model_config.video is None or self._source is None:
            return
        if link.is_symlink():
            link.unlink()
        if not link.exists():
            link.symlink_to((self._source / VIDEO_FOLDER).resolve(), target_is_directory=True)


def _sampled_as(config: GeoVerseConfig, flow: FlowConfig) -> GeoVerseConfig:
    """The configuration with the bounds and the guidance that its weights were distilled for."""
    known = replace(config.flow, level1=flow.level1, cfg_scale=flow.cfg_scale)
    return replace(config, flow=known)


def _distilled(config: GeoVerseConfig, options: ReflowStageOptions) -> GeoVerseConfig:
    """The student's configuration: it takes one step an interval, and its guidance is inside it."""
    flow = replace(config.flow, level1=options.bounds or config.flow.level1)
    if options.cfg_scale != 1:
        flow = replace(flow, cfg_scale=1.0)
    return replace(config, flow=flow)


def _last(folder: Path) -> dict[str, float]:
    """The stage's last record."""
    records = read_log(folder)
    return records[-1] if records else {}


def _fingerprint(folder: Path) -> str:
    """Of the weights that a stage starts from, the video prior's left out; ends of large files."""
    digest = hashlib.sha256()
    video = folder / VIDEO_FOLDER
    for path in sorted(folder.rglob("*")):
        if not path.is_file() or video in path.parents:
            continue
        size = path.stat().st_size
        digest.update(f"{path.relative_to(folder).as_posix()} {size} ".encode())
        with path.open("rb") as file:
            digest.update(file.read(READ))
            file.seek(max(0, size - READ))
            digest.update(file.read(READ))
    return digest.hexdigest()[:16]
