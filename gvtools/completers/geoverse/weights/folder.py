"""``GeoVerse`` from a folder and into one.

A weights folder is one of two: our own (``config.json`` and ``geoverse.safetensors`` with every
tensor), or one of published files as they were downloaded (``published.py``), with or without a
trained extension. The video prior lies in ``video/`` of either.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from gvtools.completers.geoverse import config as configs
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.control import ControlBranch
from gvtools.completers.geoverse.denoiser import Denoiser
from gvtools.completers.geoverse.model import GeoVerse, empty_model
from gvtools.completers.geoverse.shared_attention import SharedAttention
from gvtools.completers.geoverse.video_prior.prior import VideoPrior
from gvtools.completers.geoverse.weights.checks import (
    check_is_folder,
    check_video_folder,
    config_of,
    examine,
    pieces_of,
)
from gvtools.completers.geoverse.weights.published import (
    CONFIG_FILE,
    EXTENSION_FILE,
    VIDEO_FOLDER,
    WHOLE_FILE,
    is_extension,
)
from gvtools.errors import CheckpointError
from gvtools.files import replaced_when_written
from gvtools.networks.tensors import load, save_tensors

# Of the random numbers of an untrained extension; none of them reaches the output.
_SEED = 0


def from_pretrained(
    folder: Path | str,
    *,
    config: GeoVerseConfig | None = None,
    device: torch.device | str = "cpu",
    video: bool = True,
) -> GeoVerse:
    """The model of a weights folder, strictly loaded, in evaluation mode.

    Tensors are mapped from disk and copied only where they are not float32, on another device, or
    not aligned as torch would have them.

    Args:
        folder: with ``geoverse.safetensors``, or with published files (``gvtools weights list``).
        config: instead of the folder's ``config.json``; ``base`` where a folder of published files
            has none.
        device: of the weights.
        video: load the video prior, where the configuration has one.

    Raises:
        CheckpointError: a file or a tensor is missing, unexpected, of another shape or not finite.
    """
    folder = Path(folder)
    check_is_folder(folder)
    config = config or config_of(folder)
    model = empty_model(config, where=folder)
    video = video and config.video is not None
    if video:
        check_video_folder(folder / VIDEO_FOLDER)
    load(model, _tensors(folder, model), where=folder, device=device)
    model.freeze()
    model.eval()
    if video:
        prior = VideoPrior.from_pretrained(
            folder / VIDEO_FOLDER, config=config.video, device=device
        )
        model.attach_video(prior)
    return model


def _tensors(folder: Path, model: GeoVerse) -> dict[str, Tensor]:
    """All tensors of a model, by its names."""
    loaded: dict[str, Tensor] = {}
    for piece in pieces_of(folder, model):
        report, tensors = examine(piece)
        if not report.ok:
            what = f"{folder}: {report.name}" if report.path is None else f"{report.path}"
            raise CheckpointError(
                f"{what}: {report.summary}; gvtools weights list names what is needed"
            )
        loaded |= tensors
    absent = [name for name in model.state_dict() if name not in loaded]
    if any(is_extension(name) for name in absent):
        loaded |= fresh_extension(model, loaded)
    return loaded


def save_pretrained(
    model: GeoVerse, folder: Path | str, *, dtype: str = "float32", about: str = ""
) -> Path:
    """Write ``config.json`` and ``geoverse.safetensors``; the video prior keeps its own folder.

    Each appears under its name when it is whole, and the weights of an earlier model are never
    beside the configuration of a later one.

    Args:
        model: to be saved.
        folder: made if absent.
        dtype: of the stored weights, one of ``DTYPES``. Statistics, tables and Fourier frequencies,
            whose rounding would change what the others mean, keep their float32.
        about: further words for the weights' metadata.

    Returns:
        The weights' file.

    Raises:
        CheckpointError: numbers that are not finite, or too large for ``dtype``.
        ProjectError: a file cannot be written.
    """
    folder = Path(folder)
    path, config_path = folder / WHOLE_FILE, folder / CONFIG_FILE
    with replaced_when_written(config_path) as new_config:
        configs.write(model.config, new_config)
        with replaced_when_written(path) as new_weights:
            _save(model, new_weights, model.state_dict(), dtype, about)
            if config_path.is_file() and config_path.read_bytes() != new_config.read_bytes():
                # Should the machine stop between the two names, the folder is not taken for whole.
                config_path.unlink()
    return path


def save_extension(model: GeoVerse, folder: Path | str, *, dtype: str = "float32") -> Path:
    """Write what GeoVerse adds to published networks, to lie beside their files.

    It belongs to a model whose other parts are still as published.

    Args:
        model: to be saved.
        folder: made if absent.
        dtype: of the stored weights, one of ``DTYPES``.

    Returns:
        The extension's file.

    Raises:
        CheckpointError: the configuration extends nothing; or see ``save_pretrained``.
        ProjectError: the file cannot be written.
    """
    path = Path(folder) / EXTENSION_FILE
    tensors = {name: value for name, value in model.state_dict().items() if is_extension(name)}
    if not tensors:
        raise CheckpointError(
            f"configuration {model.config.name!r} adds nothing to the published networks; save the "
            "whole model with save_pretrained"
        )
    with replaced_when_written(path) as temporary:
        _save(model, temporary, tensors, dtype, "extension of published networks")
    return path


def _save(model: GeoVerse, file: Path, tensors: dict[str, Tensor], dtype: str, about: str) -> None:
    exact = {name for name, _ in model.named_buffers()}
    exact |= {name for name in tensors if name.endswith(".t_embedder.W")}
    words = ", ".join(filter(None, (f"GeoVerse {model.config.name}", about)))
    save_tensors(tensors, file, dtype=dtype, exact=exact, about=words)


def fresh_extension(model: GeoVerse, loaded: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Untrained extensions, the same at every call.

    The output is bit for bit that of the published networks, but for the ungated MoT variant.

    Args:
        model: may be on the meta device.
        loaded: the published tensors by their names in ``model``; the control branch starts as a
            copy of some.
    """
    config = model.config
    fresh = {
        name: torch.zeros(tuple(tensor.shape))
        for name, tensor in model.state_dict().items()
        if name.startswith("level1.depth_embedder.")
    }
    if config.video is None:
        return fresh
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(_SEED)
        if model.control is not None:
            control = ControlBranch(
                config.control,
                _published_level1(model, loaded),
                video_channels=config.video.channels,
            )
            fresh |= {f"control.{name}": value for name, value in control.state_dict().items()}
        if model.shared is not None:
            shared = SharedAttention(
                config.shared,
                width=config.level1.width,
                heads=config.level1.heads,
                video_channels=config.video.channels,
            )
            fresh |= {f"shared.{name}": value for name, value in shared.state_dict().items()}
    return fresh


def _published_level1(model: GeoVerse, loaded: Mapping[str, Tensor]) -> Denoiser:
    with torch.device("meta"):
        denoiser = Denoiser(replace(model.config.level1, depth_condition=False))
    tensors = {
        name.removeprefix("level1."): tensor
        for name, tensor in loaded.items()
        if name.startswith("level1.") and not is_extension(name)
    }
    load(denoiser, tensors, where="level1")
    return denoiser
