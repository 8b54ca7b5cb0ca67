"""ScanNet v2: ``[scans/]SCENE`` with exported folders, or with the native ``SCENE.sens``.

Exported: ``color``, ``depth``, ``pose`` and ``intrinsic``, as the data set's reader writes them.
Poses are world_from_cam of the colour camera, with infinity where tracking was lost; depth is
16-bit millimetres of a camera of its own, registered into the colour camera. Intrinsics count the
first pixel's centre as (0, 0). A ``.sens`` file holds the same, each frame's colour as JPEG and
depth through zlib; it is indexed at opening and read frame by frame.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from gvtools.cameras import rigid_transform
from gvtools.errors import GvError, ProjectError
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.mvsnet_cameras import picture_size
from gvtools.scenes.data_sets.posed_pictures import (
    Float64,
    PosedPicture,
    natural,
    pinhole_lens,
    posed_scene,
)
from gvtools.scenes.data_sets.sens import SensFile, read_color, read_sens_depth
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.images import read_depth
from gvtools.scenes.photographs import Registration
from gvtools.scenes.rgbd_recording import MILLIMETRES, load_matrix, pictures_in
from gvtools.scenes.scannet import SCANNET
from gvtools.scenes.scene import Finding, Scene

FOLDERS = ("", "scans", "scans_test")


def _scenes(root: Path) -> tuple[str, ...]:
    folders = [
        folder
        for home in FOLDERS
        for folder in (root / home).glob("scene*/")
        if SCANNET.matches(folder) or any(folder.glob("*.sens"))
    ]
    return natural(folder.relative_to(root).as_posix() for folder in folders)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    pictures, findings = _exported(folder) if SCANNET.matches(folder) else _native(folder)
    return posed_scene(folder, pictures, poses="world_from_cam", metric=True, findings=findings)


def _exported(folder: Path) -> tuple[list[PosedPicture], list[Finding]]:
    cameras = folder / "intrinsic"
    K = load_matrix(cameras / "intrinsic_color.txt", (4, 4), (3, 3))[:3, :3]
    registration = None
    if (cameras / "intrinsic_depth.txt").is_file():
        depth_K = load_matrix(cameras / "intrinsic_depth.txt", (4, 4), (3, 3))[:3, :3]
        extrinsics = [_extrinsic(cameras / f"extrinsic_{kind}.txt") for kind in ("color", "depth")]
        registration = _registration(depth_K, *extrinsics)
    colors = {path.stem: path for path in pictures_in(folder / "color")}
    stems = natural([*colors, *(path.stem for path in (folder / "pose").glob("*.txt"))])
    size = next((s for p in colors.values() if (s := picture_size(p)) > (2, 2)), (2, 2))
    lens = pinhole_lens(_corner_origin(K), size)
    pictures = []
    for stem in stems:
        color = colors.get(stem, folder / "color" / f"{stem}.jpg")
        pictures.append(
            PosedPicture(
                color.name,
                color,
                lens,
                _pose(folder / "pose" / f"{stem}.txt"),
                folder / "depth" / f"{stem}.png",
                partial(read_depth, unit=MILLIMETRES),
                registration=registration,
            )
        )
    return pictures, []


def _pose(path: Path) -> Float64 | None:
    """(4, 4) as read; None where it is absent or damaged."""
    try:
        return load_matrix(path, (4, 4))
    except GvError:
        return None


def _extrinsic(path: Path) -> Float64:
    """(4, 4) camera from rig; identity where the export has no such file."""
    return load_matrix(path, (4, 4)) if path.is_file() else np.eye(4)


def _registration(depth_K: Float64, color: Float64, depth: Float64) -> Registration:
    """Of the depth camera, from both cameras' extrinsics."""
    color_from_rig, _ = rigid_transform(color, what="extrinsic_color")
    depth_from_rig, _ = rigid_transform(depth, what="extrinsic_depth")
    color_from_depth = color_from_rig @ np.linalg.inv(depth_from_rig)
    return Registration(_corner_origin(depth_K), color_from_depth)


def _corner_origin(K: Float64) -> Float64:
    """(3, 3) with the first pixel's centre at (0.5, 0.5) instead of (0, 0)."""
    moved = np.array(K[:3, :3], np.float64)
    moved[:2, 2] += 0.5
    return moved


def _native(folder: Path) -> tuple[list[PosedPicture], list[Finding]]:
    path = min(folder.glob("*.sens"), default=None)
    if path is None:
        raise ProjectError(f"{folder}: neither exported folders nor a .sens file")
    sens = SensFile.open(path)
    registration = _registration(sens.depth_K, sens.color_extrinsic, sens.depth_extrinsic)
    lens = pinhole_lens(_corner_origin(sens.color_K), sens.color_size)
    pictures = [
        PosedPicture(
            f"{i}",
            path,
            lens,
            frame.world_from_cam,
            path if frame.depth_bytes else None,
            partial(read_sens_depth, frame=frame, sens=sens),
            registration=registration,
            read=partial(read_color, frame=frame),
        )
        for i, frame in enumerate(sens.frames)
    ]
    findings = [Finding("info", f"frames are read from {path.name}")]
    lost = sens.count - len(sens.frames)
    if lost:
        line = f"{lost} of {sens.count} frames are past the end of {path.name}: dropped"
        findings.append(Finding("warning", line))
    return pictures, findings


LAYOUT = Layout("scans/sceneNNNN_NN with color, depth, pose, intrinsic or a .sens", _scenes, _read)
