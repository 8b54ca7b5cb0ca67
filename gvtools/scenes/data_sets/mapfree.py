"""MapFree: ``SPLIT/SCENE/{poses.txt, intrinsics.txt, seq0, seq1}``.

A line of ``poses.txt`` holds a picture's path and qw qx qy qz tx ty tz of cam_from_world, metric;
a line of ``intrinsics.txt`` the path and fx fy cx cy width height. Poses of the test split are
withheld: all of their numbers are 0, except for the reference picture of ``seq0``. The data set
holds no depth; maps that were estimated beside a picture (``NAME.METHOD.png`` in millimetres,
``NAME.npy`` or ``NAME.METHOD.npy`` in metres) are read.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import (
    Float64,
    PosedPicture,
    natural,
    pinhole_lens,
    posed_scene,
    quaternion_pose,
)
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.images import read_depth
from gvtools.scenes.rgbd_recording import MILLIMETRES
from gvtools.scenes.scene import Finding, Scene
from gvtools.untrusted import read_text

POSES, INTRINSICS = "poses.txt", "intrinsics.txt"


def _scenes(root: Path) -> tuple[str, ...]:
    found = (*root.glob(f"*/{INTRINSICS}"), *root.glob(f"*/*/{INTRINSICS}"))
    return natural(path.parent.relative_to(root).as_posix() for path in found)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    lenses = _table(folder / INTRINSICS, 6)
    if any(not np.isfinite(values).all() for values in lenses.values()):
        raise ProjectError(f"{folder / INTRINSICS}: numbers that are not finite; copy it again")
    poses = _table(folder / POSES, 7) if (folder / POSES).is_file() else {}
    depths = _depth_maps(folder)
    pictures = []
    for name, (fx, fy, cx, cy, width, height) in lenses.items():
        depth = depths.get(name.rpartition(".")[0])
        if depth is None and depths:
            depth = folder / f"{name.rpartition('.')[0]}.npy"
        unit = MILLIMETRES if depth is not None and depth.suffix == ".png" else 1.0
        pictures.append(
            PosedPicture(
                name,
                folder / name,
                pinhole_lens([fx, fy, cx, cy], (round(width), round(height))),
                _pose(poses.get(name)),
                depth,
                partial(read_depth, unit=unit),
            )
        )
    findings = []
    if depths:
        line = f"{len(depths)} depth maps lie beside the pictures: estimated, not of the data set"
        findings.append(Finding("info", line))
    return posed_scene(folder, pictures, poses="cam_from_world", metric=True, findings=findings)


def _pose(values: Float64 | None) -> Float64 | None:
    """(4, 4) cam_from_world; None where the pose is absent or withheld."""
    if values is None or not values[:4].any():
        return None
    return quaternion_pose(values[:4], values[4:])


def _depth_maps(folder: Path) -> dict[str, Path]:
    """By path without suffix, the depth map beside each picture."""
    found: dict[str, Path] = {}
    for pattern in ("seq*/frame_*.png", "seq*/frame_*.npy"):
        for path in sorted(folder.glob(pattern)):
            stem = path.name.partition(".")[0]
            found.setdefault(f"{path.parent.name}/{stem}", path)
    return found


def _table(path: Path, columns: int) -> dict[str, Float64]:
    """Lines of a name and numbers; comments begin with #."""
    rows = {}
    try:
        for line in read_text(path).splitlines():
            words = line.split()
            if not words or line.startswith("#"):
                continue
            values = np.array(words[1:], np.float64)
            if len(values) != columns:
                raise ValueError(f"{words[0]} has {len(values)} numbers")
            rows[words[0]] = values
    except (OSError, ValueError) as error:
        raise ProjectError(
            f"{path}: {error}; expected a picture's path and {columns} numbers a line"
        ) from None
    return rows


LAYOUT = Layout(f"SPLIT/SCENE/{POSES} and {INTRINSICS} with seq0 and seq1", _scenes, _read)
