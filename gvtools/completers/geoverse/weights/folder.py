"""``GeoVerse`` from a folder and into one, and what precisely does not fit.

A weights folder is one of two: our own (``config.json`` and ``geoverse.safetensors`` with every
tensor), or one of published files as they were downloaded (``published.py``). The video prior lies
in ``video/`` of either. Loading and checking both go through ``examine``, so that what passes the
check can be loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gvtools.completers.geoverse import config as configs
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.control import ControlBranch
from gvtools.completers.geoverse.denoiser import Denoiser
from gvtools.completers.geoverse.model import GeoVerse, empty_model
from gvtools.completers.geoverse.shared_attention import SharedAttention
from gvtools.completers.geoverse.video_prior.prior import VideoPrior
from gvtools.completers.geoverse.weights.published import (
    CONFIG_FILE,
    VIDEO_FOLDER,
    WHOLE,
    WHOLE_FILE,
    Part,
    expected_of,
    is_extension,
    parts_of,
    read_part,
)
from gvtools.errors import CheckpointError
from gvtools.files import replaced_when_written
from gvtools.networks.tensors import Fit, fit, load, not_finite, save_tensors

# Of the random numbers of an untrained extension; none of them reaches the output.
_SEED = 0


@dataclass(frozen=True)
class PartReport:
    """What was found of one part of a folder.

    Attributes:
        name: of the part.
        path: its file or folder, or None.
        ok: it can be loaded, or the model does without it.
        summary: one line.
        fit: names, shapes and types, where a file could be read.
        bytes: on disk.
        parameters: numbers in the tensors that fit.
        types: what they are stored as.
        ignored: names in the file that are not looked at.
    """

    name: str
    path: Path | None
    ok: bool
    summary: str
    fit: Fit | None = None
    bytes: int = 0
    parameters: int = 0
    types: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        found = asdict(self.fit or Fit(0, (), (), (), ()))
        own = {key: value for key, value in vars(self).items() if key != "fit"}
        tensors = found.pop("expected") if self.fit else None
        path = None if self.path is None else str(self.path)
        return {**own, "path": path, "tensors": tensors, **found}


def check_is_folder(folder: Path) -> None:
    """Raises CheckpointError where a weights folder is absent, or a file."""
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "does not exist"
        raise CheckpointError(
            f"{folder} {found}; expected a folder with GeoVerse weights (gvtools weights list)"
        )


def config_of(folder: Path) -> GeoVerseConfig:
    """The folder's own configuration.

    Published files without one are ``base`` where the video prior is beside them, else ``gld``.
    """
    check_is_folder(folder)
    if (folder / CONFIG_FILE).is_file():
        return configs.read(folder / CONFIG_FILE)
    if (folder / WHOLE_FILE).is_file():
        raise CheckpointError(
            f"{folder}: {WHOLE_FILE} without its {CONFIG_FILE}; expected both; save or copy the "
            "model again"
        )
    config = configs.named("base" if (folder / VIDEO_FOLDER).is_dir() else "gld")
    if any(part.find(folder) for part in parts_of(config)):
        return config
    raise CheckpointError(
        f"{folder}: neither {CONFIG_FILE} nor a published file in it; gvtools weights list names "
        "what a weights folder holds"
    )


def parts_in(folder: Path, config: GeoVerseConfig) -> tuple[Part, ...]:
    """The files that count: ``geoverse.safetensors`` alone where it is there, else published."""
    return (WHOLE,) if WHOLE.find(folder) else parts_of(config)


def examine(
    folder: Path, part: Part, model: GeoVerse, *, numbers: bool = True
) -> tuple[PartReport, dict[str, Tensor]]:
    """Read one file and compare; the tensors by their names in ``GeoVerse``, if all is well.

    Args:
        folder: of weights.
        part: of the folder.
        model: of its configuration; may be on the meta device.
        numbers: False looks at names, shapes and types alone, which is quick.
    """
    path = part.find(folder)
    if path is None:
        absent = f"absent: neither {WHOLE_FILE} nor {part.files[0]} is there ({part.source})"
        if part.optional:
            absent = f"absent, and not needed: {part.files[0]}, {part.note}"
        return PartReport(part.name, None, part.optional, absent), {}
    size = path.stat().st_size
    try:
        tensors, ignored = read_part(path, part, numbers=numbers)
    except CheckpointError as error:
        summary = str(error).removeprefix(f"{path}: ")
        return PartReport(part.name, path, False, summary, bytes=size), {}
    expected = expected_of(model, part)
    found = fit(tensors, expected)
    left = {}
    if part.lenient:
        left = {"missing": found.missing, "unexpected": found.unexpected}
        found = replace(found, missing=(), unexpected=())
        tensors = {name: tensor for name, tensor in tensors.items() if name in expected}
    bad = not_finite(tensors) if found.ok and numbers else None
    ok = found.ok and bad is None
    summary = str(found) if bad is None else f"{bad} holds values that are not finite"
    types = sorted({str(t.dtype).removeprefix("torch.") for t in tensors.values()})
    if ok:
        summary += f", {' and '.join(types)}"
    for kind, names in left.items():
        if not names:
            continue
        also = f" and {len(names) - 1} more" if len(names) > 1 else ""
        summary += f"; {kind}, as its publisher's code lets pass: {names[0]}{also}"
    if ignored:
        summary += f"; {len(ignored)} others in the file ignored"
    report = PartReport(
        part.name,
        path,
        ok,
        summary,
        fit=found,
        bytes=size,
        parameters=sum(t.numel() for n, t in tensors.items() if n in expected),
        types=tuple(types),
        ignored=ignored,
    )
    return report, {part.module + n: tensor for n, tensor in tensors.items()} if ok else {}


def check_folder(folder: Path | str, config: GeoVerseConfig | None = None) -> list[PartReport]:
    """Every part of a folder, looked at without building the model.

    All tensors but the video prior's are read, so that a NaN is found; of that, names and shapes.
    The folder can be loaded if every report is ``ok``.

    Args:
        folder: of weights.
        config: instead of the folder's own.
    """
    folder = Path(folder)
    check_is_folder(folder)
    config = config or config_of(folder)
    model = empty_model(config, where=folder)
    reports = [examine(folder, part, model)[0] for part in parts_in(folder, config)]
    if config.video is not None and not needs_video(folder, config):
        absent = "absent, and not needed before the branch that takes its features is trained"
        reports.append(PartReport("video", None, True, absent))
    elif config.video is not None:
        video = folder / VIDEO_FOLDER
        try:
            check_video_folder(video)
            summary = VideoPrior.from_pretrained(video, config=config.video, device="meta").summary
            size = sum(path.stat().st_size for path in video.rglob("*.safetensors"))
            reports.append(PartReport("video", video, True, summary, bytes=size))
        except CheckpointError as error:
            path = video if video.exists() else None
            problem = str(error).removeprefix(f"{video}: ")
            reports.append(PartReport("video", path, False, problem))
    return reports


def check_headers(folder: Path | str) -> GeoVerseConfig:
    """Refuse a folder that cannot be loaded, by what can be seen without reading weights.

    Args:
        folder: of weights.

    Returns:
        Its configuration.
    """
    folder = Path(folder)
    config = config_of(folder)
    _tensors(folder, empty_model(config, where=folder), numbers=False)
    if needs_video(folder, config):
        check_video_folder(folder / VIDEO_FOLDER)
    return config


def needs_video(folder: Path, config: GeoVerseConfig) -> bool:
    """Whether a model is to be loaded with its video prior.

    Published files come without the control branch, whose outputs are then zero: without features
    of a video model the result is the same to the bit, and 15 GB are not needed.
    """
    if config.video is None:
        return False
    there = (folder / VIDEO_FOLDER).is_dir()
    return there or config.injection != "control" or WHOLE.find(folder) is not None


def check_video_folder(folder: Path) -> None:
    """Raises CheckpointError where there is no folder for the video prior."""
    if not folder.is_dir():
        raise CheckpointError(
            f"{folder}: absent; expected the truncated Wan2.2-VACE, which the configuration asks "
            "for; make it with gvtools weights truncate-wan"
        )


def from_pretrained(
    folder: Path | str,
    *,
    config: GeoVerseConfig | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
    video: bool = True,
    offload: str = "auto",
) -> GeoVerse:
    """The model of a weights folder, strictly loaded, in evaluation mode.

    What GeoVerse adds to published files starts untrained, without an effect (``fresh_extension``).

    Args:
        folder: with ``geoverse.safetensors``, or with published files (``gvtools weights list``).
        config: instead of the folder's own, see ``config_of``.
        device: of the weights.
        dtype: of the autocast that the model is run in, see ``GeoVerse.hold_in``.
        video: load the video prior, where the configuration has one; see ``needs_video``.
        offload: whether its weights leave the device between passes, see ``VideoPrior``.
    """
    folder = Path(folder)
    check_is_folder(folder)
    config = config or config_of(folder)
    model = empty_model(config, where=folder)
    wanted, video = video, video and needs_video(folder, config)
    if video:
        check_video_folder(folder / VIDEO_FOLDER)
    tensors = _tensors(folder, model)
    if not WHOLE.find(folder):
        tensors |= fresh_extension(model, tensors)
    # Rounded before they are moved: the device never holds both.
    load(model, tensors, where=folder, device=device if dtype == torch.float32 else "cpu")
    model.freeze()
    model.hold_in(dtype)
    model.to(device).eval()
    if video:
        prior = VideoPrior.from_pretrained(
            folder / VIDEO_FOLDER, config=config.video, device=device, offload=offload
        )
        model.attach_video(prior)
    model.without_video = wanted and config.video is not None and not video
    return model


def _tensors(folder: Path, model: GeoVerse, *, numbers: bool = True) -> dict[str, Tensor]:
    """All tensors in a folder, by a model's names."""
    loaded: dict[str, Tensor] = {}
    for part in parts_in(folder, model.config):
        report, tensors = examine(folder, part, model, numbers=numbers)
        if not report.ok:
            what = f"{folder}: {report.name}" if report.path is None else f"{report.path}"
            raise CheckpointError(
                f"{what}: {report.summary}; gvtools weights list names what is needed"
            )
        loaded |= tensors
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
    """
    folder = Path(folder)
    path, config_path = folder / WHOLE_FILE, folder / CONFIG_FILE
    with replaced_when_written(config_path) as new_config:
        configs.write(model.config, new_config)
        with replaced_when_written(path) as new_weights:
            tensors = model.state_dict()
            exact = {name for name, _ in model.named_buffers()}
            exact |= {name for name in tensors if name.endswith(".t_embedder.W")}
            words = ", ".join(filter(None, (f"GeoVerse {model.config.name}", about)))
            save_tensors(tensors, new_weights, dtype=dtype, exact=exact, about=words)
            if config_path.is_file() and config_path.read_bytes() != new_config.read_bytes():
                # Should the machine stop between the two names, the folder is not taken for whole.
                config_path.unlink()
    return path


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
