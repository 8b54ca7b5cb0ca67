"""``GeoVerse`` from a folder and into one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from gvtools.completers.geoverse import config as configs
from gvtools.completers.geoverse.checkpoints import (
    Fit,
    check_finite,
    expected_of,
    fit,
    is_extension,
    load,
    read_part,
    read_tensors,
    shapes,
    write_tensors,
)
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.control import ControlBranch
from gvtools.completers.geoverse.denoiser import Denoiser
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.published import (
    CONFIG_FILE,
    EXTENSION_FILE,
    VIDEO_FOLDER,
    WHOLE_FILE,
    parts_of,
)
from gvtools.completers.geoverse.shared_attention import SharedAttention
from gvtools.completers.geoverse.video_prior import VideoPrior
from gvtools.errors import CheckpointError

DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class PartReport:
    """What was found of one part of a folder.

    Attributes:
        name: of the part.
        path: its file, or None.
        ok: it can be loaded.
        needed: the folder is of no use without it.
        said: one line.
        fit: names and shapes, where a file was read.
        bytes: on disk.
    """

    name: str
    path: Path | None
    ok: bool
    needed: bool
    said: str
    fit: Fit | None = None
    bytes: int = 0


def from_pretrained(
    folder: Path | str,
    *,
    config: GeoVerseConfig | None = None,
    device: torch.device | str = "cpu",
    video: bool = True,
) -> GeoVerse:
    """The model of a weights folder, strictly loaded, in evaluation mode.

    Args:
        folder: with ``geoverse.safetensors``, or with published files (``gvtools weights list``).
        config: instead of the folder's ``config.json``; ``base`` where a folder of published files
            has none.
        device: of the weights.
        video: load the video prior, where the configuration has one.

    Raises:
        CheckpointError: a file or a tensor is missing, unexpected, misshapen or not finite.
    """
    folder = Path(folder)
    config = config or config_of(folder)
    with torch.device("meta"):
        model = GeoVerse(config)
    whole = folder / WHOLE_FILE
    if whole.is_file():
        tensors = read_tensors(whole)
        check_finite(tensors, where=whole)
        load(model, tensors, where=whole)
    else:
        _load_published(model, folder)
    model.freeze()
    model = model.eval().to(device)
    if video and config.video is not None:
        prior = VideoPrior.from_pretrained(
            folder / VIDEO_FOLDER, config=config.video, device=device
        )
        model.attach_video(prior)
    return model


def save_pretrained(model: GeoVerse, folder: Path | str, *, dtype: str = "float32") -> Path:
    """Write ``config.json`` and ``geoverse.safetensors``; the video prior keeps its own folder.

    Args:
        model: to be saved.
        folder: made if absent.
        dtype: of the stored weights, one of ``DTYPES``; statistics keep their float32.

    Returns:
        The weights' file.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if dtype not in DTYPES:
        raise CheckpointError(f"dtype {dtype!r}; expected one of {', '.join(DTYPES)}")
    path = folder / WHOLE_FILE
    write_tensors(
        model.state_dict().items(), path, dtype=DTYPES[dtype], about=f"GeoVerse {model.config.name}"
    )
    configs.write(model.config, folder / CONFIG_FILE)
    return path


def check_folder(folder: Path | str, config: GeoVerseConfig | None = None) -> list[PartReport]:
    """What a folder holds of a configuration's parts, without building the model.

    Raises:
        CheckpointError: there is no such folder, or its ``config.json`` is damaged.
    """
    folder = Path(folder)
    config = config or config_of(folder)
    with torch.device("meta"):
        model = GeoVerse(config)
    reports = []
    whole = folder / WHOLE_FILE
    if whole.is_file():
        expected = shapes(model.state_dict())
        reports.append(_report("geoverse", whole, expected, lambda: read_tensors(whole)))
    else:
        for part in parts_of(config):
            path = part.find(folder)
            if path is None:
                said = f"absent: expected {part.files[0]} from {part.source}"
                reports.append(PartReport(part.name, None, False, True, said))
                continue
            reports.append(
                _report(
                    part.name,
                    path,
                    expected_of(model, part),
                    lambda path=path, part=part: read_part(path, part),
                )
            )
        extension = folder / EXTENSION_FILE
        wanted = {k: s for k, s in shapes(model.state_dict()).items() if is_extension(k)}
        if extension.is_file():
            reports.append(_report("extension", extension, wanted, lambda: read_tensors(extension)))
        elif wanted:
            said = f"absent: {len(wanted)} tensors start fresh; the published networks as they are"
            reports.append(PartReport("extension", None, True, False, said))
    if config.video is not None:
        reports.append(_video_report(folder / VIDEO_FOLDER))
    return reports


def _report(name, path, expected, read) -> PartReport:  # type: ignore[no-untyped-def]
    """Read one file and compare."""
    size = path.stat().st_size
    try:
        tensors = read()
        found = fit(shapes(tensors), expected)
        if found.ok:
            check_finite(tensors, where=path.name)
    except CheckpointError as error:
        return PartReport(name, path, False, True, str(error), bytes=size)
    return PartReport(name, path, found.ok, True, str(found), found, size)


def _video_report(folder: Path) -> PartReport:
    """The truncated video model's folder; its own module says what is wrong with it."""
    from gvtools.completers.geoverse.wan_folder import check_folder as check_video

    try:
        size, said = check_video(folder)
    except CheckpointError as error:
        path = folder if folder.exists() else None
        return PartReport("video", path, False, True, str(error))
    return PartReport("video", folder, True, True, said, bytes=size)


def _load_published(model: GeoVerse, folder: Path) -> None:
    """Fill a meta model from published files and, where there is one, the trained extension."""
    loaded: dict[str, Tensor] = {}
    for part in parts_of(model.config):
        path = part.find(folder)
        if path is None:
            raise CheckpointError(
                f"{folder}: neither {WHOLE_FILE} nor {part.files[0]}; expected a GeoVerse weights "
                "folder; gvtools weights list names the files"
            )
        tensors = read_part(path, part)
        found = fit(shapes(tensors), expected_of(model, part))
        if not found.ok:
            raise CheckpointError(f"{path}: {found}; the file is of another network or version")
        check_finite(tensors, where=path)
        loaded |= {part.module + name: tensor.float() for name, tensor in tensors.items()}
    extension = folder / EXTENSION_FILE
    fresh = [name for name in model.state_dict() if is_extension(name)]
    if extension.is_file():
        loaded |= read_tensors(extension)
    elif fresh:
        loaded |= _fresh_extension(model, loaded)
    load(model, loaded, where=folder)


def _fresh_extension(model: GeoVerse, loaded: dict[str, Tensor]) -> dict[str, Tensor]:
    """Untrained extensions of the published networks: they leave those networks as they are."""
    config = model.config
    fresh = {
        name: torch.zeros(tuple(tensor.shape))
        for name, tensor in model.state_dict().items()
        if name.startswith("level1.depth_embedder.")
    }
    if model.control is not None and config.video is not None:
        denoiser = Denoiser(replace(config.level1, depth_condition=False))
        load(
            denoiser,
            {
                name.removeprefix("level1."): tensor
                for name, tensor in loaded.items()
                if name.startswith("level1.")
            },
            where="level1",
        )
        control = ControlBranch(config.control, denoiser, video_channels=config.video.channels)
        fresh |= {f"control.{name}": value for name, value in control.state_dict().items()}
    if model.shared is not None and config.video is not None:
        shared = SharedAttention(
            config.shared,
            width=config.level1.width,
            heads=config.level1.heads,
            video_channels=config.video.channels,
        )
        fresh |= {f"shared.{name}": value for name, value in shared.state_dict().items()}
    return fresh


def config_of(folder: Path) -> GeoVerseConfig:
    """The folder's own configuration; ``base`` for published files without one."""
    if not folder.is_dir():
        raise CheckpointError(
            f"no folder {folder}; expected GeoVerse weights (gvtools weights list)"
        )
    if (folder / CONFIG_FILE).is_file():
        return configs.read(folder / CONFIG_FILE)
    base = configs.named("base")
    if any(part.find(folder) for part in parts_of(base)):
        return base
    raise CheckpointError(
        f"{folder}: neither {CONFIG_FILE} nor a published file in it; gvtools weights list names "
        "what a weights folder holds"
    )
