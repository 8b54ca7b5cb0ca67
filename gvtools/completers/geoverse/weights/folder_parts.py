"""The files of a weights folder, one by one: what each has to hold, and what it holds.

Loading and checking both go through ``examine``, so that what passes the check can be loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gvtools.completers.geoverse import config as configs
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.weights.checkpoints import (
    Fit,
    Shapes,
    Stored,
    expected_of,
    fit,
    is_extension,
    not_finite,
    read_about,
    read_stored,
    read_tensors,
    shapes,
)
from gvtools.completers.geoverse.weights.pickled_tensors import first_line
from gvtools.completers.geoverse.weights.published import (
    CONFIG_FILE,
    EXTENSION_FILE,
    WHOLE_FILE,
    Part,
    parts_of,
)
from gvtools.errors import CheckpointError, GvError


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
        absent: what is said where it is absent.
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
        said: one line.
        fit: names, shapes and types, where a file could be read.
        bytes: on disk.
        parameters: numbers in the tensors that fit.
        types: what they are stored as.
        passed_over: names in the file that are not looked at.
    """

    name: str
    path: Path | None
    ok: bool
    needed: bool
    said: str
    fit: Fit | None = None
    bytes: int = 0
    parameters: int = 0
    types: tuple[str, ...] = ()
    passed_over: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        found = self.fit
        return {
            "name": self.name,
            "path": None if self.path is None else str(self.path),
            "ok": self.ok,
            "needed": self.needed,
            "said": self.said,
            "bytes": self.bytes,
            "parameters": self.parameters,
            "types": list(self.types),
            "tensors": None if found is None else found.expected,
            "missing": [] if found is None else list(found.missing),
            "unexpected": [] if found is None else list(found.unexpected),
            "misshapen": [] if found is None else list(found.misshapen),
            "mistyped": [] if found is None else list(found.mistyped),
            "passed_over": list(self.passed_over),
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


def empty_model(config: GeoVerseConfig, *, where: object) -> GeoVerse:
    """The model on the meta device: names and shapes, no numbers, no memory.

    Raises:
        CheckpointError: the numbers in the configuration make no network.
    """
    try:
        with torch.device("meta"):
            return GeoVerse(config)
    except GvError:
        raise
    except Exception as error:
        # Dimensions that do not divide, that are negative or zero: each module has its own way.
        raise CheckpointError(
            f"{where}: no network comes of configuration {config.name!r} ({first_line(error)}); "
            "expected dimensions that fit each other, such as those of base or tiny"
        ) from error


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
        said = str(error).removeprefix(f"{path}: ")
        return PartReport(piece.name, path, False, True, said, bytes=size), {}
    tensors = stored.tensors
    found = fit(tensors, piece.expected)
    bad = not_finite(tensors) if found.ok else None
    said = str(found) if bad is None else f"{bad} holds values that are not finite"
    types = sorted({str(t.dtype).removeprefix("torch.") for t in tensors.values()})
    if found.ok and bad is None:
        said += f", {' and '.join(types)}" + (f" ({about})" if about else "")
    if stored.passed_over:
        said += f"; {len(stored.passed_over)} others in the file passed over"
    report = PartReport(
        piece.name,
        path,
        found.ok and bad is None,
        True,
        said,
        fit=found,
        bytes=size,
        parameters=sum(t.numel() for n, t in tensors.items() if n in piece.expected),
        types=tuple(types),
        passed_over=stored.passed_over,
    )
    if not report.ok:
        return report, {}
    return report, {piece.module + name: tensor for name, tensor in tensors.items()}
