"""SOG, splats as PlayCanvas streams them: numbers in pictures, which ``meta.json`` explains.

The files lie in a ZIP archive or in a folder. Version 1 has ranges of numbers, from the least to
the greatest, where version 2 has a codebook. Positions are logarithms, sign(x) log(1 + |x|).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import MemoryFileError
from gvtools.splats import TERMS
from gvtools.untrusted import (
    archive,
    named_file,
    open_picture,
    other_version,
    parse_json,
    read_bytes,
    read_json,
)

META, VERSION = "meta.json", 2
PARTS = ("means", "scales", "quats", "sh0", "shN")
# Of a quaternion's fourth byte: the place of the greatest part is what is above it.
PLACES = 252
# Sets of harmonics in a row of their picture.
IN_ROW = 64
Pixels = NDArray[np.uint8]


def read_sog(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """What ``meta.json`` says, and arrays of N Gaussians.

    ``positions`` (N, 3), ``log_scales`` (N, 3), ``quaternions`` (N, 4) w, x, y, z, zero where the
    file has none, ``sh`` (N, H, 3), and either ``opacities`` or ``logits`` (N,).
    """
    if path.suffix.lower() == ".json":
        meta = read_json(path)
        if "lodLevels" in meta:
            raise MemoryFileError(
                f"{path}: a list of pieces by level of detail; expected the {META} of one piece; "
                "give a piece's folder, or convert the scene into one .sog"
            )
        names = {name for part in PARTS if part in meta for name in meta[part]["files"]}
        files = {name: named_file(path.parent, name, where=str(path)) for name in names}
        size = sum(file.stat().st_size for file in files.values())
        return meta, _decoded(meta, lambda name: read_bytes(files[name]), size=size)
    with archive(path) as members:
        meta = parse_json(members.read(META))
        return meta, _decoded(meta, members.read, size=path.stat().st_size)


def _decoded(
    meta: dict[str, Any], read: Callable[[str], bytes], *, size: int
) -> dict[str, NDArray[Any]]:
    version = meta.get("version", 1)
    if version not in (1, VERSION):
        raise MemoryFileError(
            f"SOG version {version}; expected 1 or {VERSION}; "
            f"{other_version(version, VERSION, 'save it again')}"
        )
    count = meta["means"]["shape"][0] if version == 1 else meta["count"]
    # Blank pictures are packed without end: a Gaussian takes at least a byte.
    if not 0 <= count <= size:
        raise ValueError(f"{count} Gaussians in {size} bytes")

    def picture(part: str, number: int = 0) -> Pixels:
        return np.asarray(open_picture(read(meta[part]["files"][number])).convert("RGBA"))

    def pixels(part: str, number: int = 0) -> Pixels:
        """(N, 4) of a picture of one pixel for each Gaussian."""
        found = picture(part, number).reshape(-1, 4)
        if count > len(found):
            raise ValueError(f"{part} of {len(found)} Gaussians, where {count} are said to be")
        return found[:count]

    def numbers(part: str, stored: Pixels) -> NDArray[np.float32]:
        """What bytes (..., C) stand for."""
        told = meta[part]
        if "codebook" in told:
            return np.asarray(told["codebook"], np.float32)[stored]
        low, high = (np.asarray(told[key], np.float32) for key in ("mins", "maxs"))
        return low + stored / np.float32(255) * (high - low)

    means = meta["means"]
    low, high = (np.asarray(means[key], np.float64) for key in ("mins", "maxs"))
    share = (pixels("means").astype(np.float64) + 256.0 * pixels("means", 1))[:, :3] / 65535
    logs = low + share * (high - low)
    shades = pixels("sh0")
    sh = numbers("sh0", shades if version == 1 else shades[:, :3])
    parts = {
        "positions": np.sign(logs) * np.expm1(np.abs(logs)),
        "log_scales": numbers("scales", pixels("scales")[:, :3]),
        "quaternions": _quaternions(pixels("quats")),
        "sh": sh[:, None, :3],
    }
    parts |= {"logits": sh[:, 3]} if version == 1 else {"opacities": shades[:, 3] / 255}
    if "shN" in meta:
        palette = picture("shN")
        terms = palette.shape[1] // IN_ROW
        if terms + 1 not in TERMS[1:] or palette.shape[1] % IN_ROW:
            raise ValueError(f"harmonics in a picture {palette.shape[1]} pixels wide")
        labels = pixels("shN", 1).astype(np.int64)
        stored = palette[..., :3].reshape(-1, terms, 3)[labels[:, 0] + 256 * labels[:, 1]]
        parts["sh"] = np.concatenate([parts["sh"], numbers("shN", stored)], axis=1)
    return parts


def _quaternions(stored: Pixels) -> NDArray[np.float64]:
    """(N, 4) of three parts in bytes and the place of the greatest one, which they leave."""
    rest = (stored[:, :3] / 127.5 - 1) / np.sqrt(2)
    greatest = np.sqrt(np.maximum(1 - np.square(rest).sum(axis=1), 0))
    out = np.zeros((len(stored), 4))
    for place in range(4):
        rows = stored[:, 3] == PLACES + place
        out[rows] = np.insert(rest[rows], place, greatest[rows], axis=1)
    return out
