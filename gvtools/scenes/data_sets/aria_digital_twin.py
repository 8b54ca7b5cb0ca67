"""Aria Digital Twin: ``[SEQUENCE/]RECORDING/{video.vrs, depth_images.vrs, aria_trajectory.csv}``.

The recording is a VRS file, read through the official ``projectaria_tools``; its colour camera (a
fisheye of 1408x1408) becomes a pinhole. The trajectory is world_from_device in metres by the
device's clock (microseconds); frames between two poses get their interpolation. Quaternions are
stored w x y z in version 1.0 of the data set (``metadata.json`` or ``gt-metadata.json``; 1.0 where
it names none) and x y z w since. Depth is of the same fisheye pixels, millimetres along z. The
glasses' colour sensor lies on its side: pictures are read as stored, not turned upright.
"""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path

import numpy as np

from gvtools.cameras import invert_rigid
from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.aria_vrs import read_rgb, read_rgb_depth, rgb_camera, rgb_times
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import (
    Float64,
    PosedPicture,
    natural,
    posed_scene,
    quaternion_pose,
)
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.data_sets.timed_poses import pose_at
from gvtools.scenes.scene import Finding, Scene
from gvtools.untrusted import read_json, regular

VIDEO, TRAJECTORY, DEPTH = "video.vrs", "aria_trajectory.csv", "depth_images.vrs"
METADATA = ("metadata.json", "gt-metadata.json")
FIRST_VERSION = "1.0"
SAME, LONGEST_GAP = 1_000, 100_000_000  # nanoseconds


def _scenes(root: Path) -> tuple[str, ...]:
    found = [
        path.parent
        for pattern in (f"*/{VIDEO}", f"*/*/{VIDEO}")
        for path in root.glob(pattern)
        if (path.parent / TRAJECTORY).is_file()
    ]
    return natural(path.relative_to(root).as_posix() for path in found)


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    version = _version(folder)
    times, world_from_device = read_trajectory(folder / TRAJECTORY, version=version)
    camera = rgb_camera(folder / VIDEO)
    cam_from_world = invert_rigid(world_from_device @ camera.device_from_cam)
    depth = folder / DEPTH
    pictures = [
        PosedPicture(
            str(time),
            folder / VIDEO,
            camera.pinhole,
            pose_at(time, times, cam_from_world, same=SAME, longest_gap=LONGEST_GAP),
            depth if depth.is_file() else None,
            partial(read_rgb_depth, time=time, camera=camera),
            read=partial(read_rgb, index=i, camera=camera),
        )
        for i, time in enumerate(rgb_times(folder / VIDEO))
    ]
    (width, height), focal = camera.lens.size, camera.lens.values[0]
    line = f"Aria's fisheye {width}x{height} to PINHOLE with focal length {focal:.1f} px"
    findings = [Finding("info", f"{line}; quaternions of version {version}")]
    return posed_scene(folder, pictures, poses="cam_from_world", metric=True, findings=findings)


def _version(folder: Path) -> str:
    """The data set's version, which tells the order of quaternions."""
    for home in (folder, folder.parent):
        for name in METADATA:
            path = home / name
            if path.is_file():
                try:
                    data = read_json(path)
                    return str(data.get("dataset_version", FIRST_VERSION))
                except (OSError, ValueError, AttributeError) as error:
                    raise ProjectError(f"{path}: {error}; copy it again") from None
    raise ProjectError(
        f"{folder}: neither {' nor '.join(METADATA)}, which tell the order of quaternions; "
        "complete the download"
    )


def read_trajectory(path: Path, *, version: str) -> tuple[Float64, Float64]:
    """The glasses' trajectory: (N,) nanoseconds, increasing, and (N, 4, 4) world_from_device.

    Args:
        path: ``aria_trajectory.csv``, whose columns 1 and 3 to 9 are read.
        version: of the data set.
    """
    try:
        with regular(path).open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))[1:]
        values = np.array([[row[1], *row[3:10]] for row in rows if row], np.float64)
    except (OSError, ValueError, IndexError) as error:
        raise ProjectError(f"{path}: {error}; expected a head and 20 columns") from None
    if not len(values):
        raise ProjectError(f"{path}: no pose; complete the download")
    values = values[np.argsort(values[:, 0], kind="stable")]
    quaternions = values[:, 4:]
    if version != FIRST_VERSION:
        quaternions = quaternions[:, [3, 0, 1, 2]]
    poses = [quaternion_pose(q, t) for q, t in zip(quaternions, values[:, 1:4], strict=True)]
    return values[:, 0] * 1000, np.stack(poses)


LAYOUT = Layout(f"SEQUENCE/{VIDEO} with {TRAJECTORY} and {DEPTH}", _scenes, _read)
