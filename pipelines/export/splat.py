"""3D Gaussians as the PLY that INRIA's "3D Gaussian Splatting" writes; also read.

Its conventions: natural logarithms of standard deviations, opacity before the sigmoid, quaternions
w, x, y, z, and coefficients of spherical harmonics channel by channel.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.project_kernels import (
    LOG_SCALE,
    LOGIT,
    QUATERNION,
    SH,
    VALUES,
)
from gvtools.errors import MemoryFileError
from gvtools.ply import read_ply, write_ply
from pipelines.export.source import ExportOptions, Source
from pipelines.export.splats import Splats, splats_of


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write the Gaussians."""
    splats = splats_of(source, options)
    comments = ["3D Gaussians by gvtools, axes of the input's world frame, scene units"]
    if splats.origin.any():
        comments.append("origin " + " ".join(repr(float(x)) for x in splats.origin))
    write_ply(path, vertices(splats), comments=tuple(comments))
    return f"{splats.summary()} in {path}"


def vertices(splats: Splats) -> NDArray[np.void]:
    """(N,) rows as the PLY has them; normals are zero, as INRIA's are."""
    rest = splats.harmonics[:, 1:].transpose(0, 2, 1).reshape(len(splats), -1)
    columns: dict[tuple[str, ...], NDArray[Any]] = {
        ("x", "y", "z"): splats.positions,
        ("nx", "ny", "nz"): np.zeros((len(splats), 3)),
        _numbered("f_dc", 3): splats.harmonics[:, 0],
        _numbered("f_rest", rest.shape[1]): rest,
        ("opacity",): splats.logits[:, None],
        _numbered("scale", 3): splats.log_scales,
        _numbered("rot", 4): splats.quaternions,
    }
    rows = np.empty(len(splats), [(name, "<f4") for names in columns for name in names])
    for names, values in columns.items():
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    return rows


def is_splat(names: Collection[str]) -> bool:
    """Whether a PLY with properties of these names holds Gaussians."""
    needed = {*"xyz", *_numbered("f_dc", 3), "opacity", *_numbered("scale", 3)}
    return needed.union(_numbered("rot", 4)) <= set(names)


def read(path: Path) -> Splats:
    """The Gaussians of a file; harmonics above degree 2 and values that are none are left out."""
    rows = read_ply(path)
    names = rows.dtype.names or ()
    if not is_splat(names):
        raise MemoryFileError(f"{path}: a PLY without Gaussians; expected f_dc_0, scale_0, rot_0")

    def columns(of: Sequence[str]) -> NDArray[np.float32]:
        return np.stack([rows[name].astype(np.float32) for name in of], axis=1)

    values = np.zeros((len(rows), VALUES), np.float32)
    values[:, :LOG_SCALE] = columns("xyz")
    values[:, LOG_SCALE:QUATERNION] = columns(_numbered("scale", 3))
    values[:, QUATERNION:LOGIT] = columns(_numbered("rot", 4))
    values[:, LOGIT] = rows["opacity"]
    values[:, SH : SH + 3] = columns(_numbered("f_dc", 3))
    rest = [name for name in _numbered("f_rest", len(names)) if name in names]
    if rest and len(rest) % 3 == 0:
        kept = columns(rest).reshape(len(rows), 3, -1).transpose(0, 2, 1)
        kept = kept.reshape(len(rows), -1)[:, : VALUES - SH - 3]
        values[:, SH + 3 : SH + 3 + kept.shape[1]] = kept
    values = values[np.isfinite(values).all(axis=1) & values[:, QUATERNION:LOGIT].any(axis=1)]
    return Splats(values, _origin(path), len(values), 0, np.zeros(len(values), np.int32))


def _origin(path: Path) -> NDArray[np.float64]:
    """(3,) what positions count from, as ``write`` says it in a comment; zero without one."""
    with path.open("rb") as file:
        for line in file:
            words = line.split()
            if words[:2] == [b"comment", b"origin"] and len(words) == 5:
                try:
                    return np.array([float(word) for word in words[2:]])
                except ValueError:
                    break
            if words[:1] == [b"end_header"]:
                break
    return np.zeros(3)


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{number}" for number in range(count))
