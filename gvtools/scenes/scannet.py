"""The layout that ScanNet's exporter writes: ``color``, ``depth``, ``pose`` and ``intrinsic``.

Poses are camera-to-world of the colour camera; frames that the tracker lost hold infinity. Depth is
16-bit millimetres of a camera of its own, registered into the colour camera through
``intrinsic_depth.txt``, ``extrinsic_depth.txt`` and ``extrinsic_color.txt``. The intrinsics count
pixel centres as integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gvtools.cameras import rigid_transform
from gvtools.errors import ProjectError
from gvtools.scenes.rgbd import RgbdLayout
from gvtools.scenes.rgbd_recording import (
    Recording,
    RgbdFrame,
    RgbdOptions,
    load_matrix,
    pictures_in,
    posed_frames,
)
from gvtools.scenes.scene import Finding


def _matches(root: Path) -> bool:
    return all((root / name).is_dir() for name in ("color", "depth", "pose", "intrinsic"))


def _record(root: Path, options: RgbdOptions) -> Recording:
    frames, findings = posed_frames(frame_files(root), (4, 4))
    recording = calibrated(root, options, frames=frames)
    return replace(recording, findings=[*findings, *recording.findings])


def frame_files(root: Path) -> list[tuple[Path, Path, Path]]:
    """Picture, depth map and pose of each frame; the last two may be absent."""
    return [
        (color, root / "depth" / f"{color.stem}.png", root / "pose" / f"{color.stem}.txt")
        for color in pictures_in(root / "color")
    ]


def calibrated(root: Path, options: RgbdOptions, *, frames: Sequence[RgbdFrame]) -> Recording:
    """The recording of these frames, with the calibration in ``intrinsic``."""
    findings = []
    folder = root / "intrinsic"
    if options.color_K is not None:
        K = np.asarray(options.color_K)
    elif (folder / "intrinsic_color.txt").is_file():
        K = load_matrix(folder / "intrinsic_color.txt", (4, 4), (3, 3))[:3, :3]
    else:
        raise ProjectError(
            f"{folder}: no intrinsic_color.txt; export it, or give color_K (--color-intrinsics)"
        )
    depth_K = color_from_depth = None
    if (folder / "intrinsic_depth.txt").is_file():
        depth_K = load_matrix(folder / "intrinsic_depth.txt", (4, 4), (3, 3))[:3, :3]
        color_from_depth = _extrinsic(folder, "color") @ np.linalg.inv(_extrinsic(folder, "depth"))
        if options.color_from_depth is None and not np.allclose(color_from_depth, np.eye(4)):
            # Exports with other than identity are rare, and tools read them both ways.
            message = "extrinsics are taken as camera-from-rig; if not, give color_from_depth"
            findings.append(Finding("warning", message))
    return Recording(
        root, frames, K, depth_K=depth_K, color_from_depth=color_from_depth, findings=findings
    )


def _extrinsic(folder: Path, camera: str) -> np.ndarray:
    """(4, 4) camera from rig; identity where the export has no such file."""
    path = folder / f"extrinsic_{camera}.txt"
    if not path.is_file():
        return np.eye(4)
    return rigid_transform(load_matrix(path, (4, 4)), what=str(path))[0]


SCANNET = RgbdLayout("ScanNet (color, depth, pose, intrinsic)", _matches, _record)
read_scannet = SCANNET.read
