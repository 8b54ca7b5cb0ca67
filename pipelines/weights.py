"""Weights of the generative core: what a configuration needs, whether a folder fits, and packing.

A packed model is a trained one as it ships. What a reader needs to judge and to repeat the training
lies beside the weights: the settings of each stage (``training_STAGE.json``) and its log, thinned
(``log_STAGE.jsonl``).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from functools import lru_cache
from math import prod
from pathlib import Path

import numpy as np
import skimage
import torch
from PIL import Image

from gvtools.completers.geoverse import config as configs
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import GeoVerse, empty_model
from gvtools.completers.geoverse.video_prior import VideoPriorConfig
from gvtools.completers.geoverse.views import model_size
from gvtools.completers.geoverse.wan import EMPTY_PROMPT
from gvtools.completers.geoverse.wan_checkpoint import write_empty_prompt
from gvtools.completers.geoverse.weights import (
    CONFIG_FILE,
    VIDEO_FOLDER,
    VIDEO_SIZES,
    VIDEO_SOURCE,
    VIDEO_TERMS,
    WHOLE,
    WHOLE_FILE,
    Part,
    PartReport,
    config_of,
    expected_of,
    from_pretrained,
    parts_of,
    save_pretrained,
)
from gvtools.errors import CheckpointError, OptionError, ProjectError
from gvtools.evaluation.images import psnr
from gvtools.files import folder_replaced_when_written, link_or_copy, make_folder, write_text
from gvtools.networks.depth_anything.network import RELEASED, DepthAnything3, tied_norms
from gvtools.networks.tensors import Shapes, shapes_alone
from gvtools.training.records import STAGES, read_log
from gvtools.training.run import SETTINGS, WEIGHTS
from gvtools.untrusted import open_picture, read_json, reading
from pipelines.published import MODELS

_FLOAT32 = 4


# What is done with the files of each configuration, one step a line.
GLD_STEPS = (
    "gvtools weights fetch gld --to DIR, or put the files above there under the same names",
    "gvtools weights check DIR",
)
STEPS = {
    "depth": (
        "gvtools weights fetch da3-small --to DIR, da3-base or da3-large",
        "gvtools reconstruct PROJECT --depth da3 --set da3.weights=DIR --out RUN",
    ),
    "gld": (
        *GLD_STEPS,
        "gvtools reconstruct PROJECT --completer geoverse --set completer.weights=DIR --out RUN",
    ),
    "base": (
        *GLD_STEPS,
        "these files are gld, with or without video/, and base begins as that: nothing published "
        "is trained to use the video prior",
        "for training: gvtools weights fetch wan-vace --to WAN, gvtools weights truncate-wan WAN "
        "DIR/video, gvtools weights empty-prompt WAN DIR/video",
        "gvtools train base --init DIR --out TRAINING, then gvtools weights pack TRAINING WEIGHTS",
    ),
}


def depth_lines() -> Iterator[str]:
    """The models that give depth alone."""
    yield "depth of photographs, by one of the models of depth-anything (approximate sizes):"
    for name, released in RELEASED.items():
        with shapes_alone():
            network = DepthAnything3(released.config)
        twice = {name for names in tied_norms("head.") for name in names[1:]}
        numbers = sum(p.numel() for name, p in network.named_parameters() if name not in twice)
        figures = [size_text(_FLOAT32 * numbers), f"{numbers:,} numbers", released.licence]
        yield f"  {name}, model.safetensors: {', '.join(figures)}"
    yield from _steps("depth")


def _steps(name: str) -> Iterator[str]:
    yield from (f"  step {number}: {step}" for number, step in enumerate(STEPS.get(name, ()), 1))


def needed_lines(config: GeoVerseConfig) -> Iterator[str]:
    """The files of a configuration, published ones and one's own.

    Sizes are approximate: of our own lists of names and shapes, without headers.
    """
    model = empty_model(config, where="the configuration")
    published = {part: expected_of(model, part) for part in parts_of(config)}
    known = _published_shapes()
    if all(shapes == known[part.name] for part, shapes in published.items()):
        yield f"{config.name}, from published files (sizes are approximate):"
        for part, shapes in published.items():
            yield from _part(part, shapes)
        yield f"{config.name}, in a folder of one's own, instead of the published files:"
    else:
        yield f"{config.name}: nothing of its size is published; a folder of one's own:"
    yield from _part(WHOLE, expected_of(model, WHOLE))
    if config.video is not None:
        yield f"{config.name}, beside either of the two:"
        yield from _video(config.video)
    yield from _steps(config.name)


@lru_cache(maxsize=1)
def _published_shapes() -> dict[str, Shapes]:
    """What the published files hold, by part: they are of the base configuration."""
    base = configs.named("base")
    model: GeoVerse = empty_model(base, where="base")
    return {part.name: expected_of(model, part) for part in parts_of(base)}


def _part(part: Part, expected: Shapes) -> Iterator[str]:
    twice = {name for names in part.tied for name in names[1:]}
    stored = {name: shape for name, shape in expected.items() if name not in twice}
    numbers = sum(prod(shape) for shape in stored.values())
    figures = ["optional"] if part.optional else []
    figures += [size_text(part.stated_bytes or _FLOAT32 * numbers)]
    figures += [f"{len(stored)} tensors", f"{numbers:,} numbers", part.licence]
    note = part.note
    if part is WHOLE:
        note = f"every tensor, beside {CONFIG_FILE}; half as large in float16 or bfloat16"
    return _file(part.files[0], figures, note, f"from {part.source}")


def _video(config: VideoPriorConfig) -> Iterator[str]:
    default = VideoPriorConfig()
    figures, source = [], "a Wan VACE model of the configuration's width"
    if (config.taps, config.channels) == (default.taps, default.channels):
        tensors, numbers, size = (sum(column) for column in zip(*VIDEO_SIZES.values(), strict=True))
        figures = [size_text(size), f"{tensors} tensors", f"{numbers:,} numbers", VIDEO_TERMS]
        source = VIDEO_SOURCE
    note = (
        "the video prior, made by gvtools weights truncate-wan and empty-prompt; needs diffusers "
        "(pip install 'gvtools[wan]')"
    )
    return _file(f"{VIDEO_FOLDER}/", figures, note, f"from {source}")


def _file(path: str, figures: Sequence[str], *notes: str) -> Iterator[str]:
    yield f"  {path}"
    yield from (f"      {line}" for line in (", ".join(filter(None, figures)), *notes))


def part_lines(folder: Path, parts: Sequence[PartReport]) -> Iterator[str]:
    """A line of each part that a folder has or lacks."""
    width = max(len(part.name) for part in parts)
    for part in parts:
        mark = "does not fit" if not part.ok else "ok" if part.path else "absent"
        mark = "left out" if part.left_out else mark
        size = f", {size_text(part.bytes)}" if part.bytes else ""
        where = f" ({part.path.relative_to(folder)}{size})" if part.path else ""
        summary = part.summary.removeprefix("absent: ").removeprefix("absent, and not needed: ")
        yield f"  {part.name.ljust(width)}  {mark}{where}: {summary}"


# What GLD states of a photograph that is encoded and decoded, dB, and what is too little.
STATED, LEAST = 35, 30


def of_published_size(config: GeoVerseConfig) -> bool:
    """Whether encoder and decoders are those that are published."""
    gld = configs.named("gld")
    return (config.geometry, config.rgb) == (gld.geometry, gld.rgb)


def other_revisions(config: GeoVerseConfig, parts: Sequence[PartReport]) -> list[str]:
    """A line for every file that is not the published one; whole files are read."""
    if not of_published_size(config):
        return []
    lines = []
    for part in parts:
        for file in MODELS["gld"]:
            if part.path is not None and part.path.as_posix().endswith(f"/{file.place}"):
                found = file.difference(part.path)
                lines += [f"{part.path}: is {found}; gvtools weights fetch"] if found else []
    return lines


def self_check(folder: Path, config: GeoVerseConfig, photo: Path | None) -> tuple[str, bool]:
    """A line about a photograph, by default scikit-image's, en- and decoded, and if it is right."""
    path = photo or Path(skimage.__file__).parent / "data" / "astronaut.png"
    with reading(path, "expected a photograph"):
        picture = open_picture(path).convert("RGB")
    height, width = model_size(
        picture.height, picture.width, longest=config.image_size, patch=config.patch
    )
    pixels = np.asarray(picture.resize((width, height), Image.Resampling.LANCZOS))
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = from_pretrained(folder, config=config, video=False, device=device)
    tensor = torch.from_numpy(pixels.copy()).permute(2, 0, 1)[None].to(device) / 255
    made = model.reconstruct(tensor)[0].permute(1, 2, 0).clamp(0, 1).cpu().numpy()
    value = psnr(made, pixels / 255.0) or 0.0
    line = f"self-check: {path.name} encoded and decoded, PSNR {value:.1f} dB"
    if not (config.trained and of_published_size(config)):
        return line, True
    line += f"; GLD states {STATED} dB of its files"
    return line, value >= LEAST


def size_text(count: int) -> str:
    """Bytes to three digits, in decimal units."""
    for unit, power in (("GB", 9), ("MB", 6), ("kB", 3)):
        if count >= 10**power:
            return f"{count / 10**power:.3g} {unit}"
    return f"{count} bytes"


# Records of a stage's log that are kept.
RECORDS = 150


def pack(
    training: Path,  # of ``gvtools train --out``, or a weights folder
    out: Path,
    *,
    dtype: str = "float16",
    text_encoder: Path | None = None,  # Wan's, for a video prior without the empty prompt
) -> Path:  # the folder that the weights came from
    """Write the last stage's weights and every stage's record, or a weights folder as one file."""
    whole = any(part.find(training) for part in (WHOLE, *parts_of(configs.named("base"))))
    source = training if whole else _last_weights(training)
    if out.resolve().is_relative_to(training.resolve()):
        raise ProjectError(f"{out} lies within {training}; choose another folder")
    video = source / VIDEO_FOLDER
    lacking = video.is_dir() and not (video / EMPTY_PROMPT).is_file()
    if lacking and text_encoder is None:
        raise CheckpointError(
            f"{video}: no {EMPTY_PROMPT}; name Wan's text encoder with --text-encoder, once"
        )
    if text_encoder is not None and not lacking:
        raise OptionError(f"--text-encoder: no {video} that lacks {EMPTY_PROMPT}; leave it out")
    model = from_pretrained(source, video=False)
    make_folder(out)
    if video.is_dir():
        make_folder(out / VIDEO_FOLDER)
        # Linked, or copied to another disk.
        with folder_replaced_when_written(out / VIDEO_FOLDER) as new:
            for path in sorted(path for path in video.rglob("*") if path.is_file()):
                target = new / path.relative_to(video)
                make_folder(target.parent)
                link_or_copy(path, target)
            if text_encoder is not None:
                write_empty_prompt(text_encoder, new)
    save_pretrained(model, out, dtype=dtype, about="packed")
    for stage in () if whole else STAGES:
        for name in (f"log_{stage}.jsonl", f"training_{stage}.json"):
            (out / name).unlink(missing_ok=True)
        records = read_log(training / stage)
        if not records:
            continue
        step = max(1, len(records) // RECORDS)
        kept = [*records[:-1][::step], records[-1]]
        lines = (json.dumps({k: float(f"{v:.5g}") for k, v in line.items()}) for line in kept)
        write_text(out / f"log_{stage}.jsonl", "\n".join(lines) + "\n")
        if (training / stage / SETTINGS).exists():
            settings = read_json(training / stage / SETTINGS)
            # Where its samples were kept is of no use elsewhere.
            settings["data"]["cache"] = None
            write_text(out / f"training_{stage}.json", json.dumps(settings, indent=2) + "\n")
    return source


def _last_weights(training: Path) -> Path:
    """The weights of the last stage that a training has finished."""
    folders = [training / name / WEIGHTS for name in STAGES]
    finished = [folder for folder in folders if folder.is_dir() and config_of(folder).trained]
    if not finished:
        raise ProjectError(
            f"{training}: no finished denoiser; expected {training / 'denoiser' / WEIGHTS}; run "
            "gvtools train first"
        )
    source = finished[-1]
    weights = [folder / WHOLE_FILE for folder in finished]
    newest = max(weights, key=lambda path: path.stat().st_mtime)
    if newest != weights[-1]:
        raise ProjectError(
            f"{source}: older than {newest.parent}, which an earlier stage made; run the later "
            "stage again, with its folder removed"
        )
    return source
