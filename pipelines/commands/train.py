"""``gvtools train``: the stages of the generative core, and its weights tuned to one scene.

Every stage is resumable to the step after a kill. Several processes train together: ``torchrun
--nproc-per-node N --no-python gvtools train ...``; the setting ``parallel`` says what each holds.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from gvtools.errors import OptionError
from gvtools.files import check_parent, make_folder, write_text
from gvtools.settings import Settings, with_texts, with_values
from pipelines.commands.arguments import RootArguments
from pipelines.options import HelpSettings, JsonArguments

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from gvtools.training.options import TrainingSettings
    from pipelines.console import Console
    from pipelines.reconstruction.settings import RunSettings


NAME = "tune"
# Of the stages; tuning does not look at them.
STAGE_OPTIONS = ("stage", "resume", "until", "set", "sheets", "data", "rooms")


class TuneArguments(RootArguments):
    """What ``tune`` takes beside --init, --out, --device and --json."""

    title = (
        "tune: CONFIG tune trains the denoisers to predict views of one scene from each other. "
        "Some of the views judge; the tuned weights are kept if they predict these better than "
        "before. --init is the model that ships unless given, and --out a folder for --set "
        "completer.weights=DIR"
    )

    scene: Path | None = None
    """As reconstruct takes it. [PROJECT]"""
    context: str = "all"
    """Views that may be looked at. [SPEC]"""
    depth: str = "auto"
    """Of the views, as of reconstruct. [SOURCE]"""
    minutes: float = 10.0
    """How long. [min]"""
    steps: int | None = None
    """Steps instead of a time: the same result each time. [N]"""
    seed: int = 0
    """Of everything random. [N]"""


def run_tune(args: TrainCommand, console: Console) -> None:
    """Tune, and write the weights."""
    from gvtools.completers.geoverse.completer import SHIPPED
    from gvtools.scenes.project import open_project
    from pipelines.tuning.tune import check_tunable, tune

    if args.scene is None:
        raise OptionError("train tune needs --scene PROJECT, the scene that is tuned to")
    config = _checked(args)
    weights = args.init or SHIPPED
    check_tunable(weights)
    if args.out.exists() and not (args.out.is_dir() and not any(args.out.iterdir())):
        raise OptionError(f"--out {args.out}: holds something already; give a new folder")
    with tempfile.TemporaryDirectory() as folder:
        project = open_project(args.scene, root=args.root)
        scene = context_of(project, config, Path(folder), console=console)
        tuning = tune(
            scene,
            weights,
            args.out,
            options=config.tune,
            completer={"device": args.device},
            seed=config.seed,
            say=console.line,
        )
    console.line(f"gvtools reconstruct ... --completer geoverse --set completer.weights={args.out}")
    args.write_json(tuning.to_dict())


def _checked(args: TrainCommand) -> RunSettings:
    """Settings of a run that would read the scene likewise."""
    from pipelines.reconstruction.settings import RunSettings

    args.refuse(STAGE_OPTIONS, "train tune does not look at it")
    if {"minutes", "steps"} <= args.model_fields_set:
        raise OptionError("--minutes and --steps: expected one of them; leave the other out")
    given = {
        "tune.minutes": args.minutes,
        "tune.steps": args.steps,
        "context": args.context,
        "depth": args.depth,
        "seed": args.seed,
    }
    config = with_values(RunSettings(), given)
    if not config.tune.wanted:
        raise OptionError("no minutes and no steps: nothing to do; give --minutes or --steps")
    return config


def context_of(scene: Scene, config: RunSettings, folder: Path, *, console: Console) -> Scene:
    """A scene's context with the depth and the poses that a run without a fit would take.

    Targets of ``config`` are not looked at; computed depth goes into ``folder``.
    """
    from gvtools.runs.context_depth import DepthCache
    from pipelines.reconstruction.prepare import make_plan, with_depth

    # The context stands for the targets, and an edge that nothing is fused with is not sought.
    reading = {"completer": "none", "voxel": 1.0, "allow_overlap": True, "tune.minutes": 0.0}
    reading |= {"tune.steps": None, "targets": config.context}
    plan = make_plan(scene, with_values(config, reading), say=console.line).posed
    console.line(
        f"{scene.root}: {len(plan.context)} context views; depth {plan.source.name} "
        f"({plan.source_reason})"
    )
    cache = DepthCache(plan.scene, plan.context, plan.source, folder=folder)
    return with_depth(plan.scene, plan.context, cache)


class TrainCommand(TuneArguments, JsonArguments):
    """Train the generative core: encoder, denoisers, distillation; or tune it to a scene."""

    examples = (
        "gvtools train tiny --stage all --out training/tiny",
        "gvtools train my_training.json --stage denoiser --out training/mine --resume",
        "gvtools train base --init weights/base --data data --out training/base",
        "gvtools train tune --scene scan/ --context every:2 --minutes 10 --out tuned/scan",
    )
    positional = ("config",)

    config: str
    """A training that ships (tiny, base, micro), a JSON file, or tune: see below. [CONFIG]"""
    stage: Literal["encoder", "denoiser", "reflow", "heads", "refiner", "all"] = "all"
    """encoder: pretraining of a small encoder with its heads; denoiser: both denoisers; reflow:
    distillation to few steps; heads: a small model's heads on what it completes; refiner: what
    tells how far its completions are to be trusted; all: those that the training has, one after the
    other."""
    out: Path
    """Of the training. [DIR]"""
    init: Path | None = None
    """Start from these weights: a GeoVerse folder, or one with GLD's published files. By default
    from the stage before. With published files, --stage all leaves the encoder's stage out.
    [DIR]"""
    resume: bool = False
    """Continue the stage where its last state was saved."""
    until: int | None = Field(None, ge=1)
    """Stop after this step. [STEP]"""
    data: Path | None = None
    """Train on those of the paper's fifteen data sets that lie there, each in a folder of its name
    (docs/training_data.md). [ROOT]"""
    rooms: bool = False
    """Train base on drawn rooms alone."""
    set: tuple[str, ...] = ()
    """A setting, such as denoiser.optimizer.steps=500. [KEY=VALUE]"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """That computes."""
    sheets: int = 250
    """Sample sheets every N steps; 0: none. [N]"""

    @classmethod
    def add(cls, parser: argparse.ArgumentParser) -> None:
        """Add the arguments, and the list of settings."""
        super().add(parser)
        parser.add_argument("--help-settings", action=HelpSettings, settings=_settings)

    def run(self, console: Console) -> None:
        from gvtools.completers.geoverse.weights import WHOLE_FILE
        from gvtools.runs.folder import folder_lock
        from gvtools.training.distributed import join_processes
        from gvtools.training.options import shipped_or_read
        from gvtools.training.records import STAGES
        from gvtools.training.run import StageRun

        if self.json_ is not None:
            check_parent(self.json_)
        if self.config == NAME:
            run_tune(self, console)
            return
        self.refuse(TuneArguments.model_fields, "belongs to 'gvtools train tune'")
        config, folder = shipped_or_read(self.config)
        config = self._with_scenes(with_texts(config, self.set), console)
        stages: tuple[str, ...] = (self.stage,)
        if self.stage == "all":
            stages = tuple(stage for stage in STAGES if getattr(config, stage) is not None)
            if self.init is not None and not (self.init / WHOLE_FILE).is_file():
                # A published encoder has its training behind it.
                stages = tuple(stage for stage in stages if stage != "encoder")
        make_folder(self.out)
        figures: dict[str, dict[str, float]] = {}
        with ExitStack() as held:
            processes = held.enter_context(join_processes(self.device))
            if processes.first:
                held.enter_context(folder_lock(self.out))
            for stage in stages:
                stage_run = StageRun(
                    config,
                    stage,
                    self.out,
                    processes=processes,
                    model_folder=folder,
                    init=self.init if stage == stages[0] else None,
                )
                figures[stage] = stage_run.train(
                    resume=self.resume,
                    until=self.until,
                    sheet_every=self.sheets,
                    say=console.line if processes.first else lambda text: None,
                )
                if figures[stage].get("step", 0) < stage_run.options.optimizer.steps:
                    # --until: the next stage has nothing to start from yet.
                    break
            if self.json_ is not None and processes.first:
                write_text(self.json_, json.dumps(figures, indent=2) + "\n")

    def _with_scenes(self, config: TrainingSettings, console: Console) -> TrainingSettings:
        """The training on the scenes that were asked for; base does not begin without any."""
        if self.data is not None:
            from gvtools.training.data import with_data

            if self.rooms or config.data.scenes:
                given = "--rooms" if self.rooms else "data.scenes"
                raise OptionError(f"--data and {given}: expected one of them; leave the other out")
            config, found = with_data(config, self.data)
            console.table(
                ["data set", "share", "what is there"],
                [[one.name, f"{one.share:.1%}", one.note] for one in found],
            )
        elif self.config == "base" and not config.data.scenes and not self.rooms:
            raise OptionError(
                "train base: no scenes to learn from; give --data ROOT with data sets of the "
                "paper's mixture, data.scenes in a file of your own, or --rooms for drawn rooms "
                "alone, which the paper does not train on"
            )
        return config


def _settings(args: argparse.Namespace) -> list[Settings]:
    from gvtools.training.options import TrainingSettings, shipped_or_read

    known = TrainingSettings() if args.config is None else shipped_or_read(args.config)[0]
    return [with_texts(known, args.set or ())]
