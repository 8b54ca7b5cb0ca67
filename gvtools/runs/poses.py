"""Poses of a run other than those of its project."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.gaussians import UNREADABLE
from gvtools.cameras import Cameras, rigid_transform
from gvtools.errors import MemoryFileError, ShapeError
from gvtools.runs.layout import APPEARANCE, POSES, round_folder
from gvtools.scenes.scene import Scene
from gvtools.untrusted import expect, load_arrays


@dataclass(frozen=True, eq=False)
class RunPoses:
    """Refined poses (V, 4, 4) cam_from_world of a run's context and targets, in its order."""

    context: NDArray[np.float64]
    targets: NDArray[np.float64]
    # Whether features determined them, to a fraction of a pixel.
    by_features: bool = False
    # Typical, scene units, where other cameras err like the context near them; else 0.
    depth: float = 0.0

    def save(self, path: Path) -> None:
        """Write them into one file."""
        with path.open("wb") as file:
            np.savez(file, **self.arrays)

    @property
    def arrays(self) -> dict[str, Any]:
        """As ``load`` finds them in a file, which may hold more."""
        return {
            "context_poses": self.context,
            "target_poses": self.targets,
            "poses_by_features": self.by_features,
            "poses_depth": self.depth,
        }

    @classmethod
    def load(cls, path: Path) -> RunPoses | None:
        """Read what ``save`` wrote; None where the file holds no poses."""
        try:
            data = load_arrays(path)
            if "context_poses" not in data:
                return None
            context, targets = (
                _rigid(data[name], name) for name in ("context_poses", "target_poses")
            )
            by_features, depth = data.get("poses_by_features", False), data.get("poses_depth", 0.0)
            poses = cls(context, targets, bool(by_features), float(depth))
        except (*UNREADABLE, ShapeError) as error:
            raise MemoryFileError(
                f"{path}: expected refined poses; found none: {error}; start the run again with "
                "another --out"
            ) from error
        return poses


def _rigid(poses: NDArray[Any], name: str) -> NDArray[np.float64]:
    """(N, 4, 4) finite poses, as they are."""
    stacked = poses.ndim == 3 and poses.shape[1:] == (4, 4) and poses.dtype == np.float64
    expect(stacked, f"{name} of shape {poses.shape} and type {poses.dtype}")
    for pose in poses:
        rigid_transform(pose, what=name)
    return poses


def refined_poses_of(run: Path) -> RunPoses | None:
    """The poses that a run's memory was built from; None where these are its project's."""
    folder = round_folder(run, 0)
    for path in (folder / APPEARANCE, folder / POSES):
        poses = RunPoses.load(path) if path.exists() else None
        if poses is not None:
            return poses
    return None


def with_poses(scene: Scene, names: Sequence[str], poses: NDArray[np.float64]) -> Scene:
    """A scene with other poses (V, 4, 4) of some views."""
    if len(names) != len(poses):
        raise MemoryFileError(
            f"{len(poses)} refined poses of {len(names)} views; expected one each; start the run "
            "again with another --out"
        )
    moved = dict(zip(names, poses, strict=True))
    views = tuple(
        replace(view, camera=posed(view.camera, moved[view.name][None]))
        if view.name in moved
        else view
        for view in scene.views
    )
    return replace(scene, views=views)


def posed(cameras: Cameras, cam_from_world: NDArray[np.float64]) -> Cameras:
    """Cameras with other poses (V, 4, 4)."""
    return Cameras(cameras.K, cam_from_world, cameras.width, cameras.height, cameras.names)
