"""A set of anisotropic Gaussians: one array, which an Open3D point cloud shares."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.appearance.splat.project_kernels import (
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    QUATERNION,
    SH,
    VALUES,
)
from gvtools.errors import MemoryFileError, ShapeError
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.untrusted import load_arrays

if TYPE_CHECKING:
    import open3d as o3d

# What reading a file that is damaged, or of another kind, raises.
UNREADABLE = (OSError, EOFError, KeyError, TypeError, ValueError, BadZipFile, zlib.error)
# Opacity that a Gaussian begins with.
FIRST_OPACITY = 0.1
# The attributes of the point cloud, as Open3D names those of Gaussian splats: columns and shape.
ATTRIBUTES = {
    "positions": (0, LOG_SCALE, (3,)),
    "scale": (LOG_SCALE, QUATERNION, (3,)),
    "rot": (QUATERNION, LOGIT, (4,)),
    "opacity": (LOGIT, SH, (1,)),
    "f_dc": (SH, SH + 3, (3,)),
    "f_rest": (SH + 3, VALUES, (8, 3)),
}


class Gaussians:
    """Coloured, anisotropic Gaussians in a local frame; ``values`` (N, VALUES), a row a Gaussian.

    >>> some = Gaussians.at([[0, 0, 2], [1, 0, 2]], [[255, 0, 0], [0, 0, 255]], sizes=[0.1, 0.2])
    >>> some
    Gaussians(2 Gaussians)
    >>> some.cloud.point["f_dc"].shape
    SizeVector[2, 3]
    """

    def __init__(self, values: NDArray[np.float32], *, frame: LocalFrame | None = None) -> None:
        self.values = np.ascontiguousarray(values, np.float32)
        self.frame = frame or LocalFrame.at()

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,} Gaussians)"

    @classmethod
    def at(
        cls,
        positions: ArrayLike,
        colors: ArrayLike,
        *,
        sizes: ArrayLike,
        frame: LocalFrame | None = None,
    ) -> Gaussians:
        """Round, faint Gaussians: colours from 0 to 255, sizes are standard deviations."""
        values = np.zeros((len(np.asarray(positions)), VALUES), np.float32)
        values[:, :LOG_SCALE] = positions
        values[:, LOG_SCALE:QUATERNION] = np.log(np.asarray(sizes))[:, None]
        values[:, QUATERNION] = 1
        values[:, LOGIT] = np.log(FIRST_OPACITY / (1 - FIRST_OPACITY))
        values[:, SH : SH + 3] = (np.asarray(colors) / 255.0 - 0.5) / HARMONICS[0]
        return cls(values, frame=frame)

    @property
    def cloud(self) -> o3d.t.geometry.PointCloud:
        """The Gaussians as a point cloud with Open3D's names of splats.

        It shares ``values`` but for ``scale``, a copy: Open3D keeps standard deviations there, and
        not their logarithms as ``values`` and splat files do. ``rot`` are quaternions w, x, y, z,
        ``opacity`` is before the sigmoid, ``f_dc`` and ``f_rest`` are spherical harmonics.
        """
        from gvtools.o3d import o3d

        tensor = o3d.core.Tensor.from_numpy(self.values)
        cloud = o3d.t.geometry.PointCloud()
        for name, (first, last, shape) in ATTRIBUTES.items():
            cloud.point[name] = tensor[:, first:last].reshape((len(self), *shape))
        cloud.point["scale"] = cloud.point["scale"].exp()
        return cloud

    def save(self, path: Path) -> None:
        """Write values and frame, exactly."""
        with path.open("wb") as file:
            np.savez(file, values=self.values, origin=self.frame.origin, axes=self.frame.axes)

    @classmethod
    def load(cls, path: Path) -> Gaussians:
        """Read what ``save`` wrote."""
        try:
            arrays: dict[str, Any] = load_arrays(path)
            values = arrays["values"]
            if (
                values.ndim != 2
                or values.shape[1] != VALUES
                or values.dtype.kind != "f"
                or not np.isfinite(values.astype(np.float32)).all()
            ):
                raise ValueError(f"values {values.shape}")
            return cls(values, frame=LocalFrame.at(arrays["origin"], arrays["axes"]))
        except (*UNREADABLE, ShapeError) as error:
            raise MemoryFileError(f"{path}: no readable Gaussians ({error})") from None
