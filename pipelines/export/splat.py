"""3D Gaussians as the PLY that INRIA's "3D Gaussian Splatting" writes.

Its conventions: natural logarithms of standard deviations, opacity before the sigmoid, quaternions
w, x, y, z, and coefficients of spherical harmonics channel by channel.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.memory.io.ply import write_ply
from pipelines.export.source import ExportOptions, Source
from pipelines.export.splats import Splats, splats_of


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write the Gaussians.

    Raises:
        OptionError: fewer are allowed than were fitted, or nothing is left.
        ProjectError: the file cannot be written.
    """
    splats = splats_of(source, options)
    comments = ["3D Gaussians by gvtools, axes of the input's world frame, scene units"]
    if splats.origin.any():
        comments.append("origin " + " ".join(repr(float(x)) for x in splats.origin))
    write_ply(path, vertices(splats), comments=tuple(comments))
    return f"{splats.told()} in {path}"


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


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{number}" for number in range(count))
