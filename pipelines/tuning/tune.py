"""A model tuned to one scene: it learns to predict context views from each other, and is judged.

Weights that predict the judging views no better than before are not taken.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gvtools.completers.base import Completer, ContextView
from gvtools.completers.geoverse.completer import GeoVerseCompleter
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.views import model_size
from gvtools.completers.geoverse.weights import (
    VIDEO_FOLDER,
    check_headers,
    config_of,
    from_pretrained,
    save_pretrained,
)
from gvtools.errors import CheckpointError, ProjectError
from gvtools.files import folder_replaced_when_written, make_folder, write_json
from gvtools.guidance import Guidance
from gvtools.runs.digests import array_digest, folder_digest
from gvtools.scenes.scene import Scene
from gvtools.training.corruption import GENTLE, draw_strengths
from gvtools.training.distributed import Processes, Replicated
from gvtools.training.loader import batches
from gvtools.training.loop import Trainer
from gvtools.training.options import (
    SHIPPED,
    DenoiserStageOptions,
    OptimizerOptions,
    TrainingSettings,
    shipped_or_read,
)
from gvtools.training.samples import (
    Clip,
    Observation,
    TrainingSample,
    make_sample,
    project_observation,
)
from gvtools.training.stages import DenoiserStage
from gvtools.training.views import (
    FAULTS,
    PATH,
    ContextChoice,
    SampleView,
    concatenate_clips,
    covisibility,
    reduced_view,
)
from gvtools.untrusted import read_json
from gvtools.view_selection import evenly_spread
from pipelines.tuning.options import FEWEST_VIEWS, TuneOptions

# Beside PATH and FAULTS, the stream that a sample's further views are drawn from.
LIFTED = 10
# Of more views, so many are taken.
MOST = 64
# One view in so many judges, at most MOST_JUDGES of them.
JUDGE_SHARE, MOST_JUDGES = 5, 12
# Views that the memory of a sample is made of, beside those that the model is shown.
MOST_LIFTED = 12
# Least share of a judging view that is to be generated.
LEAST_HOLES = 0.01
# Least share of a view's depth that another has to show to predict it.
LEAST_SHOWN = 0.15


@dataclass(frozen=True, eq=False)
class HeldOutView:
    """A view that judges, and what it is predicted from."""

    # views that do not judge, all or some; a completer is given them
    context: tuple[ContextView, ...]
    guidance: Guidance  # the memory of them, projected into the view
    rgb: np.ndarray  # (1, H, W, 3) its photograph in [0, 1]


@dataclass(frozen=True, kw_only=True, eq=False)
class HoldOuts:
    """Samples in which one view is held out and predicted from others that see the same."""

    views: tuple[SampleView, ...]  # reduced, of one size
    targets: tuple[int, ...]  # which of them are held out
    given: tuple[int, ...]  # which of them may be given; a target is never given to itself
    context: ContextChoice  # how many are given
    seed: int = 0  # 0 or more
    fill: str = "none"  # of the model's configuration, ``hints.fill``
    _partners: dict[int, tuple[int, ...]] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        clip = concatenate_clips([view.truth for view in self.views])
        for target in self.targets:
            others = [index for index in self.given if index != target]
            shares = covisibility(clip, target, others)
            chosen = [n for n, share in zip(others, shares, strict=True) if share >= LEAST_SHOWN]
            if chosen:
                self._partners[target] = tuple(chosen)

    @property
    def usable(self) -> tuple[int, ...]:
        """The targets that some given view shows in part."""
        return tuple(self._partners)

    def sample(self, index: int) -> TrainingSample:
        """The sample of a number, 0 or more; the target is its last view."""
        chosen, lifted = self.chosen(index), self.lifted(index)
        rng = np.random.default_rng([self.seed, index, FAULTS])
        frames = [self.views[number] for number in chosen]
        more = (
            concatenate_clips([self.views[number].observed for number in lifted])
            if lifted
            else None
        )
        return make_sample(
            concatenate_clips([frame.observed for frame in frames]),
            concatenate_clips([frame.truth for frame in frames]),
            tuple(range(len(chosen) - 1)),
            rng=rng,
            strength=draw_strengths(rng, GENTLE),
            fill=self.fill,
            more=more,
        )

    def prediction(self, target: int) -> HeldOutView:
        """One target as a run is asked for it: with the memory of all given views.

        Where that leaves less than ``LEAST_HOLES`` to generate, of every second of them, every
        fourth, and so on.
        """
        truth = self.views[target].observed
        given = [number for number in self.given if number != target]
        while True:
            context = tuple(_context_view(self.views[number].observed) for number in given)
            observation = Observation(context, tuple(view.camera for view in context))
            guidance = project_observation(observation, truth.cameras)
            if len(given) == 1 or (~guidance.valid).mean() >= LEAST_HOLES:
                break
            given = given[::2]
        return HeldOutView(context, guidance, (truth.rgb / np.float32(255)).astype(np.float32))

    def chosen(self, index: int) -> tuple[int, ...]:
        """The views of a sample: those that are given, ascending, then the target."""
        rng = np.random.default_rng([self.seed, index, PATH])
        # In turn, so that no view is left out of few predictions.
        target = self.usable[index % len(self.usable)]
        partners = self._partners[target]
        count = self.context.count([self.seed], index)
        first = int(rng.choice(partners))
        # Samples of a batch have as many views each, so that others fill up where partners are few.
        others = [n for n in partners if n != first]
        others = [int(n) for n in rng.permutation(others)]
        rest = [n for n in self.given if n not in (target, *partners)]
        others += [int(n) for n in rng.permutation(rest)]
        return (*sorted([first, *others[: count - 1]]), target)

    def lifted(self, index: int) -> tuple[int, ...]:
        """Further views that a sample's memory is made of: none, a few, or all that see the target.

        Memory of few views has large holes, as at a scene's edge, memory of many has small ones.
        """
        *given, target = self.chosen(index)
        rng = np.random.default_rng([self.seed, index, LIFTED])
        others = [n for n in self._partners[target] if n not in given]
        most = min(MOST_LIFTED, len(others))
        count = int((most + 1) ** rng.random()) - 1
        return tuple(sorted(int(n) for n in rng.permutation(others)[:count]))

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        names = [view.truth.cameras.names[0] for view in self.views]
        return {
            "source": "hold-outs",
            "views": names,
            "targets": [names[n] for n in self.targets],
            "given": [names[n] for n in self.given],
            "context": asdict(self.context),
            "seed": self.seed,
            "fill": self.fill,
        }


@dataclass(frozen=True, eq=False)
class SplitContext:
    """A scene's context, split into views to learn from and views that judge."""

    views: tuple[SampleView, ...]  # all of them, reduced to the model's size
    learnt: HoldOuts  # samples that the model learns from
    judged: HoldOuts  # predictions of the judging views from the others
    dropped: int  # context views without depth, and those beyond ``MOST``

    @property
    def judges(self) -> list[str]:
        """Names of the judging views."""
        return [self.views[n].truth.cameras.names[0] for n in self.judged.usable]

    def predictions(self) -> list[HeldOutView]:
        """What the judging views are predicted from."""
        return [self.judged.prediction(target) for target in self.judged.usable]


def split_context(scene: Scene, config: GeoVerseConfig, *, seed: int = 0) -> SplitContext:
    """Read a scene's views, and keep some of them as judges."""
    usable = [view for view in scene if view.has_depth]
    chosen = list(evenly_spread(usable, MOST))
    views: tuple[SampleView, ...] = ()
    if chosen:
        height, width = int(chosen[0].camera.height[0]), int(chosen[0].camera.width[0])
        size = model_size(height, width, longest=config.image_size, patch=config.patch)
        found = [reduced_view(view, size) for view in chosen]
        views = tuple(view for view in found if (view.truth.depth > 0).any())
    if len(views) < FEWEST_VIEWS:
        raise ProjectError(
            f"{scene.root}: {len(views)} of {len(scene)} context views have depth; expected "
            f"at least {FEWEST_VIEWS} to tune a model by, of which one judges; give more "
            "--context, or leave tuning out"
        )
    if len({view.observed.depth.shape for view in views}) > 1:
        # Small pictures are observed at less than ``DETAIL`` times the size; all then are.
        views = tuple(SampleView(view.truth, view.truth) for view in views)
    numbers = range(len(views))
    count = min(MOST_JUDGES, max(1, len(views) // JUDGE_SHARE))
    # Not the ends of a path, which hardly anything else shows.
    judges = tuple(int((k + 0.5) * len(views) / count) for k in range(count))
    given = tuple(n for n in numbers if n not in judges)
    learnt, judged = (
        HoldOuts(
            views=views,
            targets=targets,
            given=given,
            context=ContextChoice(most=min(config.context, config.views - 1, len(given) - 1)),
            seed=seed,
            fill=config.hints.fill,
        )
        for targets in (given, judges)
    )
    if not (learnt.usable and judged.usable):
        raise ProjectError(
            f"{scene.root}: no two of {len(views)} context views share {LEAST_SHOWN:.0%} of their "
            "depth; expected views that see the same; give more --context, or leave tuning out"
        )
    return SplitContext(views, learnt, judged, len(scene) - len(views))


def _context_view(clip: Clip) -> ContextView:
    picture = (clip.rgb[0] / np.float32(255)).astype(np.float32)
    return ContextView(clip.cameras.names[0], clip.cameras, picture, clip.depth[0])


Say = Callable[[str], None]

# What is written beside the weights.
RECORD = "tuning.json"
BATCH = 4
# Of the learning rate that the model's own training had.
RATE_SHARE = 0.2
WARM_STEPS = 10
EMA = 0.99
# The judging views are predicted so often while the model learns; the best weights are taken.
JUDGEMENTS = 4
# Step limit of a training that ends by time: more than any run reaches.
ENDLESS = 10**7


@dataclass(frozen=True)
class Tuning:
    """What a tuning came to."""

    kept: bool  # whether the weights are the tuned ones; otherwise they are as they were
    psnr_before: float  # of generated pixels of the judging views, dB, by the untuned weights
    psnr_after: float  # likewise by the best of the tuned ones
    steps: int  # optimiser steps made
    best_step: int  # the step whose weights were best
    seconds: float  # all of it
    views: int  # context views that were learnt from
    judges: list[str]  # names of the views that judged

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        return asdict(self)

    def __str__(self) -> str:
        said = f"{self.psnr_before:.2f} dB untuned, {self.psnr_after:.2f} dB tuned"
        what = (
            f"the tuned weights (step {self.best_step}) are taken"
            if self.kept
            else "the weights stay as they were"
        )
        return (
            f"{what}: generated pixels of {len(self.judges)} judging view(s) {said}; "
            f"{self.steps} steps, {self.seconds:.0f} s"
        )


def check_tunable(weights: Path) -> GeoVerseConfig:
    """The configuration of weights that can be tuned."""
    config = config_of(weights)
    if not config.trained:
        raise CheckpointError(
            f"{weights}: its denoisers are untrained, so that there is nothing to tune; expected "
            "the weights of a finished training (gvtools train)"
        )
    return config


def tune(
    scene: Scene,
    weights: Path,
    out: Path,  # absent or empty, or of an earlier tuning, which is replaced when this one is done
    *,
    options: TuneOptions,
    completer: Mapping[str, Any] | None = None,
    seed: int = 0,
    say: Say = print,
) -> Tuning:
    """Tune a model to a scene, and write the better weights, tuned or not, into a folder."""
    begun = time.monotonic()
    config = check_tunable(weights)
    split = split_context(scene, config, seed=seed)
    if split.dropped:
        say(f"tune: {split.dropped} of {len(scene)} context views are left out")
    # Weights held in half precision could not be trained.
    chosen = {**(completer or {}), "weights": str(weights), "precision": "float32"}
    judge = _Judge(split.predictions(), GeoVerseCompleter(**chosen))
    with torch.random.fork_rng(devices=[]):
        learnt = _Learner(split, config, judge, options=options, seed=seed, begun=begun)
        say(
            f"tune: learns from {len(split.learnt.usable)} context views; {len(split.judges)} "
            f"others judge: {judge.before:.2f} dB untuned"
        )
        tuning = learnt.run(say)
    make_folder(out)
    with folder_replaced_when_written(out) as folder:
        save_pretrained(learnt.best(tuning), folder)
        if config.video is not None and (weights / VIDEO_FOLDER).is_dir():
            # It is not tuned, so it is not copied.
            (folder / VIDEO_FOLDER).symlink_to((weights / VIDEO_FOLDER).resolve())
        inputs = inputs_of(split, weights, options=options, seed=seed)
        record = {**tuning.to_dict(), "options": options.to_dict(), "inputs": inputs}
        write_json(folder / RECORD, record)
    say(f"tune: {tuning}")
    return tuning


def previous_tuning(
    scene: Scene, weights: Path, out: Path, *, options: TuneOptions, seed: int = 0
) -> dict[str, Any] | None:
    """The record of a whole tuning that ``tune`` would make again with these arguments, if any."""
    with suppress(OSError, ValueError, CheckpointError):
        record: dict[str, Any] = read_json(out / RECORD)
        split = split_context(scene, check_headers(out), seed=seed)
        if record["inputs"] == inputs_of(split, weights, options=options, seed=seed):
            return record
    return None


def inputs_of(split: SplitContext, weights: Path, *, options: TuneOptions, seed: int) -> str:
    """A digest of what decides a tuning: views, depth, cameras, weights, time and seed."""
    arrays: list[Any] = []
    for view in split.views:
        camera = view.observed.cameras
        arrays += [view.observed.depth, camera.K, camera.cam_from_world]
    model = folder_digest(weights, without=VIDEO_FOLDER)
    said = json.dumps([split.judged.describe(), options.to_dict(), model, seed])
    return array_digest([*arrays, np.frombuffer(said.encode(), np.uint8)])


class _Judge:
    """Predicts the judging views by one model, as it is at the time."""

    def __init__(self, predictions: list[HeldOutView], completer: GeoVerseCompleter) -> None:
        self.predictions, self.completer = predictions, completer
        self.seconds = 0.0
        self.before = self.psnr()

    def psnr(self) -> float:
        """Of generated pixels, dB; ``seconds`` is how long it took."""
        began = time.monotonic()
        found = generated_psnr(self.completer, self.predictions)
        self.seconds = time.monotonic() - began
        return found


def generated_psnr(completer: Completer, predictions: list[HeldOutView]) -> float:
    """PSNR in dB over the generated pixels of all predictions together, at most 100."""
    squared, pixels = 0.0, 0
    for number, case in enumerate(predictions):
        holes = ~case.guidance.valid
        pixels += int(holes.sum())
        if holes.any():
            made = completer.complete(case.context, case.guidance, seed=number)
            error = np.clip(made.rgb, 0, 1).astype(np.float64)[holes] - case.rgb[holes]
            squared += float(np.square(error).mean(-1).sum())
    if not pixels:
        raise ProjectError(
            "the context views show each other whole: no pixel is left to generate, and so none to "
            "tune by; leave tuning out"
        )
    return float(-10 * np.log10(max(squared / pixels, 1e-10)))


class _Learner:
    """Trains a copy of the model, and keeps the weights that the judge likes best."""

    def __init__(
        self,
        split: SplitContext,
        config: GeoVerseConfig,
        judge: _Judge,
        *,
        options: TuneOptions,
        seed: int,
        begun: float,
    ) -> None:
        self.split, self.judge, self.options, self.begun = split, judge, options, begun
        self.folder = judge.completer.folder
        self.model = judge.completer.model
        device = next(self.model.parameters()).device
        recipe = stage_options(config, device, options.steps)
        self.trainer = Trainer(
            Replicated(DenoiserStage(self.model, recipe), Processes(0, 1, device)),
            recipe.optimizer,
            lambda parts: batches(split.learnt, parts, workers=0),
            folder=Path(),
            seed=seed,
            identity={},
        )
        self._best: dict[str, Tensor] = {}
        self._psnr, self._best_step = -np.inf, 0

    def run(self, say: Say) -> Tuning:
        """Make steps until the time is over; judge now and then, and at the end."""
        trainer, marks = self.trainer, 0
        parts = itertools.chain.from_iterable(map(trainer.parts, itertools.count()))
        with closing(trainer.batches(parts)) as stream:
            over = False
            while not over:
                began = time.monotonic()
                values = trainer.step(stream)
                share = self._share(time.monotonic() - began)
                over = share >= 1
                if over or share * JUDGEMENTS >= marks + 1:
                    marks = int(share * JUDGEMENTS)
                    found = self._judge()
                    loss = f", loss {values['loss']:.4g}" if "loss" in values else ""
                    say(f"tune: step {trainer.progress.step}{loss}: {found:.2f} dB")
        return Tuning(
            kept=self._psnr > self.judge.before,
            psnr_before=self.judge.before,
            psnr_after=float(self._psnr),
            steps=trainer.progress.step,
            best_step=self._best_step,
            seconds=time.monotonic() - self.begun,
            views=len(self.split.learnt.usable),
            judges=self.split.judges,
        )

    def best(self, tuning: Tuning) -> GeoVerse:
        """The model with the weights that are to be written."""
        if not tuning.kept:
            return from_pretrained(self.folder, video=False)
        with torch.no_grad():
            for name, parameter in self.trainer.parameters:
                parameter.copy_(self._best[name])
        return self.model

    def _share(self, step: float) -> float:
        """How much of the steps or the time is over; 1 where another ``step`` [s] is too late."""
        if self.options.steps is not None:
            return self.trainer.progress.step / self.options.steps
        limit = 60 * self.options.minutes
        spent = time.monotonic() - self.begun
        # The last judgement needs its time as well.
        return 1.0 if spent + step + self.judge.seconds > limit else spent / limit

    def _judge(self) -> float:
        with self.trainer.ema.swapped_in():
            found = self.judge.psnr()
        if found > self._psnr:
            self._psnr, self._best_step = found, self.trainer.progress.step
            self._best = {name: value.clone() for name, value in self.trainer.ema.shadow.items()}
        return found


def stage_options(
    config: GeoVerseConfig, device: torch.device, steps: int | None
) -> DenoiserStageOptions:
    """The losses that the model was trained by, at a low constant rate.

    Products are in float32 on CPUs, of which many emulate bfloat16 at a fraction of its speed.

    ``steps``: None for a training by the clock.
    """
    shipped = (SHIPPED / f"{config.name}.json").is_file()
    own = (shipped_or_read(config.name)[0] if shipped else TrainingSettings()).denoiser
    total = ENDLESS if steps is None else steps
    optimizer = OptimizerOptions(
        steps=total,
        batch=BATCH,
        accumulate=min(BATCH, own.optimizer.accumulate),
        rate=RATE_SHARE * own.optimizer.rate,
        warmup=min(1.0, WARM_STEPS / total),
        schedule="constant",
        weight_decay=own.optimizer.weight_decay,
        ema=EMA,
        precision="float32" if device.type == "cpu" else "auto",
    )
    return own.replaced(optimizer=optimizer)
