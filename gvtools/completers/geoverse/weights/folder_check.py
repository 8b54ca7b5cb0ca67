"""What a weights folder holds of a configuration, and what precisely does not fit."""

from __future__ import annotations

from pathlib import Path

from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.video_prior.prior import VideoPrior, VideoPriorConfig
from gvtools.completers.geoverse.video_prior.wan_files import TensorFiles, check_tensors
from gvtools.completers.geoverse.weights.folder_parts import (
    PartReport,
    check_is_folder,
    config_of,
    empty_model,
    examine,
    pieces_of,
)
from gvtools.completers.geoverse.weights.published import VIDEO_FOLDER
from gvtools.errors import CheckpointError


def check_folder(folder: Path | str, config: GeoVerseConfig | None = None) -> list[PartReport]:
    """Every part of a folder, looked at without building the model.

    All tensors but the video prior's are read, so that a NaN is found; of that, names and shapes.
    The folder can be loaded if every report is ``ok``.

    Args:
        folder: of weights.
        config: instead of the folder's own.

    Raises:
        CheckpointError: there is no such folder, or its configuration is damaged.
    """
    folder = Path(folder)
    check_is_folder(folder)
    config = config or config_of(folder)
    model = empty_model(config, where=folder)
    reports = [examine(piece)[0] for piece in pieces_of(folder, model)]
    if config.video is not None:
        reports.append(_video_report(folder / VIDEO_FOLDER, config.video))
    return reports


def check_headers(folder: Path | str) -> GeoVerseConfig:
    """Refuse a folder that cannot be loaded, by what can be seen without reading weights.

    Args:
        folder: of weights.

    Returns:
        Its configuration.

    Raises:
        CheckpointError: a file is absent or damaged, or names and shapes in a .safetensors file do
            not fit.
    """
    folder = Path(folder)
    check_is_folder(folder)
    config = config_of(folder)
    for piece in pieces_of(folder, empty_model(config, where=folder)):
        if piece.path is None:
            if piece.needed:
                raise CheckpointError(f"{folder}: {piece.name} is {piece.absent}")
            continue
        if piece.path.suffix == ".safetensors" and piece.part is None:
            check_tensors(TensorFiles.find(piece.path), piece.expected, where=piece.path)
    if config.video is not None:
        check_video_folder(folder / VIDEO_FOLDER)
    return config


def check_video_folder(folder: Path) -> None:
    """Raises CheckpointError where there is no folder for the video prior."""
    if not folder.is_dir():
        raise CheckpointError(
            f"{folder}: absent; expected the truncated Wan2.2-VACE, which the configuration asks "
            "for; make it with gvtools weights truncate-wan"
        )


def _video_report(folder: Path, config: VideoPriorConfig) -> PartReport:
    """The truncated video model's folder; its own modules say what is wrong with it."""
    from gvtools.completers.geoverse.video_prior.wan_folder import check_folder as check_wan
    from gvtools.completers.geoverse.video_prior.wan_folder import read_empty_prompt
    from gvtools.completers.geoverse.video_prior.wan_library import empty_network, read_config

    try:
        check_video_folder(folder)
        empty = config.prompt == "empty"
        size, said = check_wan(folder, prompt=empty)
        # Made of shapes alone, it makes the same comparisons as when it is loaded.
        transformer, vae = (
            empty_network(name, read_config(folder / name)) for name in ("transformer", "vae")
        )
        prompt = read_empty_prompt(folder) if empty else None
        VideoPrior(transformer, vae, prompt, config=config)
    except CheckpointError as error:
        path = folder if folder.exists() else None
        return PartReport("video", path, False, True, str(error).removeprefix(f"{folder}: "))
    return PartReport("video", folder, True, True, said, bytes=size)
