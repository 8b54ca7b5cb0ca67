"""The ScanNet export layout: ``color/``, ``depth/``, ``pose/`` and ``intrinsic/``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gvtools.cameras import rigid_transform
from gvtools.errors import ProjectError
from gvtools.scenes.photographs import named
from gvtools.scenes.rgbd import (
    Recording,
    RgbdFrame,
    RgbdOptions,
    load_matrix,
    resolve_options,
    rgbd_scene,
)
from gvtools.scenes.scene import Finding, Scene, natural_key

PICTURES = (".jpg", ".jpeg", ".png")


def is_scannet(root: Path) -> bool:
    """Whether ``root`` holds the four folders of an exported ScanNet scene."""
    return all((root / name).is_dir() for name in ("color", "depth", "pose", "intrinsic"))


def read_scannet(root: Path, *, options: RgbdOptions | None = None) -> Scene:
    """An exported ScanNet scene.

    Poses are camera-to-world of the colour camera; frames that the tracker lost hold infinity and
    are dropped. Depth is 16-bit millimetres of a camera of its own, registered here through
    ``intrinsic_depth.txt``, ``extrinsic_depth.txt`` and ``extrinsic_color.txt``. The intrinsics
    count pixel centres as integers; the cameras read here lie half a pixel further.

    Args:
        root: the scene's folder.
        options: overrides of units, intrinsics and extrinsics.

    Returns:
        The scene, metric.

    Raises:
        ProjectError: a file is absent or malformed, or every frame was lost.
        ShapeError: a pose that is finite but no rigid transform.
    """
    root = Path(root)
    resolved, findings = resolve_options(root, options)
    frames, unposed, lost = [], [], []
    colors = [path for path in (root / "color").iterdir() if path.suffix.lower() in PICTURES]
    for color in sorted(colors, key=lambda path: natural_key(path.name)):
        pose = root / "pose" / f"{color.stem}.txt"
        if not pose.is_file():
            unposed.append(color.name)
            continue
        matrix = load_matrix(pose, (4, 4))
        if np.isinf(matrix).any():
            lost.append(color.name)
            continue
        depth = root / "depth" / f"{color.stem}.png"
        frames.append(
            RgbdFrame(color.name, color, depth if depth.is_file() else None, matrix, str(pose))
        )
    for names, reason in ((unposed, "have no pose file"), (lost, "were lost by the tracker")):
        if names:
            message = f"{len(names)} of {len(colors)} frames {reason}: dropped ({named(names)})"
            findings.append(Finding("warning", message))
    folder = root / "intrinsic"
    if resolved.color_K is not None:
        K = np.asarray(resolved.color_K)
    elif (folder / "intrinsic_color.txt").is_file():
        K = load_matrix(folder / "intrinsic_color.txt", (4, 4), (3, 3))[:3, :3]
    else:
        raise ProjectError(f"{folder}: no intrinsic_color.txt; export it, or give color_K")
    depth_K = color_from_depth = None
    if (folder / "intrinsic_depth.txt").is_file():
        depth_K = load_matrix(folder / "intrinsic_depth.txt", (4, 4), (3, 3))[:3, :3]
        color_from_depth = _extrinsic(folder, "color") @ np.linalg.inv(_extrinsic(folder, "depth"))
        if resolved.color_from_depth is None and not np.allclose(color_from_depth, np.eye(4)):
            # Exports with other than identity are rare, and tools read them both ways.
            message = "extrinsics are taken as camera-from-rig; if not, give color_from_depth"
            findings.append(Finding("warning", message))
    recording = Recording(
        root, frames, K, depth_K=depth_K, color_from_depth=color_from_depth, findings=findings
    )
    return rgbd_scene(recording, resolved)


def _extrinsic(folder: Path, camera: str) -> np.ndarray:
    """(4, 4) camera from rig; identity where the export has no such file."""
    path = folder / f"extrinsic_{camera}.txt"
    if not path.is_file():
        return np.eye(4)
    return rigid_transform(load_matrix(path, (4, 4)), what=str(path))[0]
