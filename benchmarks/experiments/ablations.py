"""What each part is worth: short trainings from one encoder, alike in all but the part.

The video prior at this scale is Wan VACE's architecture with random frozen weights: there is no
small published one. Its rows show what the injection costs and that it works, not what a trained
prior would give. Every variant is one training: intervals are over scenes, not over trainings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from benchmarks.experiments.cases import SIZE, Case, held_out_cases
from benchmarks.experiments.judging import COLUMNS, Judged, judge, perceptual, records, table
from benchmarks.experiments.options import ExperimentOptions
from benchmarks.experiments.rows import geoverse
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.video_injection import ControlConfig, SharedAttentionConfig
from gvtools.completers.geoverse.video_prior import VideoPriorConfig
from gvtools.completers.geoverse.weights import (
    VIDEO_FOLDER,
    config_of,
    from_pretrained,
    save_pretrained,
)
from gvtools.errors import OptionError
from gvtools.evaluation.tables import Table
from gvtools.files import write_json
from gvtools.networks.config_json import to_json
from gvtools.settings import with_texts
from gvtools.training.distributed import join_processes
from gvtools.training.options import TrainingSettings, shipped_or_read
from gvtools.training.run import StageRun
from pipelines.console import Console

READS = ("weights", "scenes", "size", "seed", "steps", "out", "training")

# The video prior has as many taps as layers of level 1 that its features enter.
TAPS = 4
VIDEO = VideoPriorConfig(taps=(0, 1, 2, 3), channels=48, prompt_rows=6, prompt="zeros")
WHOLE = "the shipped form: memory, no video prior"

Injection = Literal["control", "shared", "none"]


@dataclass(frozen=True)
class Variant:
    """A training that differs in one part.

    Attributes:
        folder: its name below the experiment's.
        settings: of the training, as ``gvtools train --set`` takes them.
        injection: of video features.
        memory: whether targets see projections, in training and in the test.
    """

    folder: str
    settings: tuple[str, ...] = ()
    injection: Injection = "none"
    memory: bool = True


VARIANTS = {
    WHOLE: Variant("whole"),
    "control branch, random frozen prior": Variant("control", injection="control"),
    "MoT, random frozen prior": Variant("shared", injection="shared"),
    "without memory": Variant("no_memory", ("data.projections=false",), memory=False),
    "without RGB loss": Variant("no_rgb", ("denoiser.weights.rgb=0", "denoiser.weights.hf=0")),
    "without depth loss": Variant("no_depth", ("denoiser.weights.depth=0",)),
}


def run(options: ExperimentOptions) -> tuple[dict[str, Any], list[Table]]:
    """Train and test every variant, from the encoder's weights; see ``READS``.

    A variant that is trained already is only tested; one that was interrupted goes on; one that was
    trained with other settings is refused.

    Raises:
        OptionError: no folder, or no encoder to start from.
    """
    if options.out is None or options.weights is None:
        raise OptionError(
            "experiment ablations needs --out DIR for its trainings and --weights DIR, the "
            "weights of a trained encoder (gvtools train tiny --stage encoder)"
        )
    if config_of(options.weights).trained:
        raise OptionError(
            f"{options.weights}: a trained denoiser; expected an encoder alone, so that all "
            "variants start alike (training/tiny/encoder/weights)"
        )
    judged: dict[str, Judged] = {}
    distance, said = perceptual()
    for name, variant in VARIANTS.items():
        weights = _trained(variant, options)
        cases = held_out_cases(options.scenes, seed=options.seed, size=options.size or SIZE)
        shown = cases if variant.memory else _unprojected(cases)
        judged |= judge({name: geoverse(weights)}, shown, distance=distance, seed=options.seed)
    found = {
        "scenes": options.scenes,
        "seed": options.seed,
        "steps": options.steps,
        "perceptual_distance": said,
        "results": records(judged, against=dict.fromkeys(COLUMNS, WHOLE)),
    }
    caption = (
        f"Ablations, {options.steps} denoiser steps each, undistilled 3+1, {options.scenes} "
        "held-out scenes"
    )
    return found, [table(judged, caption=caption, against=dict.fromkeys(COLUMNS, WHOLE))]


def _trained(variant: Variant, options: ExperimentOptions) -> Path:
    """The variant's weights."""
    assert options.out is not None
    assert options.weights is not None
    out = options.out / variant.folder
    config, folder = shipped_or_read(options.training)
    model_config = _with_injection(config.network(folder), variant.injection)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "model.json", to_json(model_config))
    settings = [
        "model=model.json",
        f"seed={options.seed}",
        f"denoiser.optimizer.steps={options.steps}",
        *variant.settings,
    ]
    start = options.weights
    if variant.injection != "none":
        start = _start(options.weights, model_config, out / "start")
    _train(with_texts(config, settings), out, start)
    return out / "denoiser" / "weights"


def _train(config: TrainingSettings, out: Path, start: Path) -> None:
    with join_processes("auto") as processes:
        stage = StageRun(config, "denoiser", out, processes=processes, model_folder=out, init=start)
        stage.train(resume=True, say=Console().line)


def _with_injection(config: GeoVerseConfig, injection: Injection) -> GeoVerseConfig:
    if injection == "none":
        return config
    last = config.level1.depth - 1
    layers = tuple(sorted({round(i * last / (TAPS - 1)) for i in range(TAPS)}))
    return replace(
        config,
        video=replace(VIDEO, taps=tuple(range(len(layers)))),
        injection=injection,
        control=ControlConfig(layers=layers),
        shared=SharedAttentionConfig(layers=layers, gated=config.shared.gated),
    )


def _start(encoder: Path, config: GeoVerseConfig, folder: Path) -> Path:
    """The encoder's weights beside a video prior of random numbers."""
    if not (folder / VIDEO_FOLDER).is_dir():
        with torch.random.fork_rng():
            torch.manual_seed(0)
            model = GeoVerse(replace(config, trained=False))
        # All but the injection's own layers, which start as they are made: without effect.
        model.load_state_dict(from_pretrained(encoder).state_dict(), strict=False)
        save_pretrained(model, folder)
        _save_random_prior(folder / VIDEO_FOLDER)
    return folder


def _save_random_prior(folder: Path) -> None:
    """Wan VACE of four narrow blocks and its VAE, random, in the layout of a truncated folder."""
    from gvtools.completers.geoverse.wan import network_class

    with torch.random.fork_rng():
        torch.manual_seed(0)
        transformer = network_class("transformer")(
            num_attention_heads=2,
            attention_head_dim=VIDEO.channels // 2,
            text_dim=20,
            freq_dim=16,
            ffn_dim=2 * VIDEO.channels,
            num_layers=len(VIDEO.taps),
            vace_layers=[0, 2],
        )
        vae = network_class("vae")(base_dim=4, dim_mult=[1, 2, 2, 2], num_res_blocks=1)
    transformer.save_pretrained(folder / "transformer")
    vae.save_pretrained(folder / "vae")


def _unprojected(cases: Iterator[Case]) -> Iterator[Case]:
    """The same cases with nothing projected; the same pixels are judged."""
    for case in cases:
        yield replace(case, guidance=case.guidance.blank(), judged=case.generated)
