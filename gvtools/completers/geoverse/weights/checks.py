"""What a weights folder holds of a configuration, and what precisely does not fit.

Loading and checking both go through ``examine``, so that what passes the check can be loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from gvtools.completers.geoverse import config as configs
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import GeoVerse, empty_model
from gvtools.completers.geoverse.video_prior.config import VideoPriorConfig
from gvtools.completers.geoverse.video_prior.prior import VideoPrior
from gvtools.completers.geoverse.video_prior.wan_files import TensorFiles, check_tensors
from gvtools.completers.geoverse.weights.published import (
    CONFIG_FILE,
    EXTENSION_FILE,
    VIDEO_FOLDER,
    WHOLE_FILE,
    Part,
    Stored,
    expected_of,
    is_extension,
    parts_of,
    read_stored,
)
from gvtools.errors import CheckpointError
from gvtools.networks.tensors import Fit, Shapes, fit, not_finite, read_about, read_tensors, shapes


@dataclass(frozen=True)
class Piece:
    """One file of a folder.

    Attributes:
        name: of the part.
        module: prefix of its keys in the state dict of ``GeoVerse``.
        path: the file, or None where it is absent.
        expected: what it has to hold, by names without the prefix.
        part: the published part; None for files of our own.
        needed: the folder is of no use without it.
        absent: the summary where it is absent.
    """

    name: str
    module: str
    path: Path | None
    expected: Shapes
    part: Part | None = None
    needed: bool = True
    absent: str = ""


@dataclass(frozen=True)
class PartReport:
    """What was found of one part of a folder.

    Attributes:
        name: of the part.
        path: its file or folder, or None.
        ok: it can be loaded, or the model does without it.
        needed: the folder is of no use without it.
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
    needed: bool
    summary: str
    fit: Fit | None = None
    bytes: int = 0
    parameters: int = 0
    types: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        found = self.fit
        return {
            "name": self.name,
            "path": None if self.path is None else str(self.path),
            "ok": self.ok,
            "needed": self.needed,
            "summary": self.summary,
            "bytes": self.bytes,
            "parameters": self.parameters,
            "types": list(self.types),
            "tensors": None if found is None else found.expected,
            "missing": [] if found is None else list(found.missing),
            "unexpected": [] if found is None else list(found.unexpected),
            "shape_mismatch": [] if found is None else list(found.shape_mismatch),
            "dtype_mismatch": [] if found is None else list(found.dtype_mismatch),
            "ignored": list(self.ignored),
        }


def check_is_folder(folder: Path) -> None:
    """Raises CheckpointError where a weights folder is absent, or a file."""
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "does not exist"
        raise CheckpointError(
            f"{folder} {found}; expected a folder with GeoVerse weights (gvtools weights list)"
        )


def config_of(folder: Path) -> GeoVerseConfig:
    """The folder's own configuration; ``base`` for published files without one.

    Raises:
        CheckpointError: there is no such folder, nothing of use in it, or a damaged config.json.
    """
    check_is_folder(folder)
    if (folder / CONFIG_FILE).is_file():
        return configs.read(folder / CONFIG_FILE)
    if (folder / WHOLE_FILE).is_file():
        raise CheckpointError(
            f"{folder}: {WHOLE_FILE} without its {CONFIG_FILE}; expected both; save or copy the "
            "model again"
        )
    base = configs.named("base")
    if any(part.find(folder) for part in parts_of(base)):
        return base
    raise CheckpointError(
        f"{folder}: neither {CONFIG_FILE} nor a published file in it; gvtools weights list names "
        "what a weights folder holds"
    )


def pieces_of(folder: Path, model: GeoVerse) -> list[Piece]:
    """The files of a folder: ``geoverse.safetensors`` alone where it is there, else published ones.

    Args:
        folder: of weights.
        model: of its configuration; may be on the meta device.
    """
    whole = folder / WHOLE_FILE
    if whole.is_file():
        return [Piece("geoverse", "", whole, shapes(model.state_dict()))]
    pieces = []
    for part in parts_of(model.config):
        absent = f"absent: neither {WHOLE_FILE} nor {part.files[0]} is there ({part.source})"
        if part.optional:
            absent = f"absent, and not needed: {part.files[0]}, {part.note}"
        pieces.append(
            Piece(
                part.name,
                part.module,
                part.find(folder),
                expected_of(model, part),
                part,
                not part.optional,
                absent,
            )
        )
    extension = folder / EXTENSION_FILE
    wanted = {name: s for name, s in shapes(model.state_dict()).items() if is_extension(name)}
    path = extension if extension.is_file() else None
    if path or wanted:
        absent = f"absent: its {len(wanted)} tensors start untrained"
        pieces.append(Piece("extension", "", path, wanted, None, False, absent))
    return pieces


def examine(piece: Piece) -> tuple[PartReport, dict[str, Tensor]]:
    """Read one file and compare; the tensors by their names in ``GeoVerse``, if all is well."""
    path = piece.path
    if path is None:
        return PartReport(piece.name, None, not piece.needed, piece.needed, piece.absent), {}
    size = path.stat().st_size
    try:
        if piece.part is None:
            stored, about = Stored(read_tensors(path)), read_about(path)
        else:
            stored, about = read_stored(path, piece.part), ""
    except CheckpointError as error:
        summary = str(error).removeprefix(f"{path}: ")
        return PartReport(piece.name, path, False, True, summary, bytes=size), {}
    tensors = stored.tensors
    found = fit(tensors, piece.expected)
    bad = not_finite(tensors) if found.ok else None
    summary = str(found) if bad is None else f"{bad} holds values that are not finite"
    types = sorted({str(t.dtype).removeprefix("torch.") for t in tensors.values()})
    if found.ok and bad is None:
        summary += f", {' and '.join(types)}" + (f" ({about})" if about else "")
    if stored.ignored:
        summary += f"; {len(stored.ignored)} others in the file ignored"
    report = PartReport(
        piece.name,
        path,
        found.ok and bad is None,
        True,
        summary,
        fit=found,
        bytes=size,
        parameters=sum(t.numel() for n, t in tensors.items() if n in piece.expected),
        types=tuple(types),
        ignored=stored.ignored,
    )
    if not report.ok:
        return report, {}
    return report, {piece.module + name: tensor for name, tensor in tensors.items()}


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
    from gvtools.completers.geoverse.video_prior.wan_folder import (
        empty_network,
        read_config,
        read_empty_prompt,
    )

    try:
        check_video_folder(folder)
        empty = config.prompt == "empty"
        size, summary = check_wan(folder, prompt=empty)
        # Made of shapes alone, it makes the same comparisons as when it is loaded.
        transformer, vae = (
            empty_network(name, read_config(folder / name)) for name in ("transformer", "vae")
        )
        prompt = read_empty_prompt(folder) if empty else None
        VideoPrior(transformer, vae, prompt, config=config)
    except CheckpointError as error:
        path = folder if folder.exists() else None
        return PartReport("video", path, False, True, str(error).removeprefix(f"{folder}: "))
    return PartReport("video", folder, True, True, summary, bytes=size)
