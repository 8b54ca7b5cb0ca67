"""The 7-Scenes layout: ``frame-XXXXXX.{color.png|jpg, depth.png, pose.txt}`` in one folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

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
from gvtools.scenes.scene import Finding, Scene

COLOR_SUFFIXES = (".color.png", ".color.jpg", ".color.jpeg")
INTRINSICS = "camera-intrinsics.txt"


def is_sevenscenes(root: Path) -> bool:
    """Whether ``root`` holds ``*.pose.txt`` beside ``*.color.*`` files."""
    return any(root.glob("*.pose.txt")) and any(root.glob("*.color.*"))


def read_sevenscenes(root: Path, *, options: RgbdOptions | None = None) -> Scene:
    """A folder in the 7-Scenes layout.

    Poses are camera-to-world, depth is 16-bit millimetres with 0 and 65535 for no reading.
    ``camera-intrinsics.txt`` (3x3, in the folder or its parent) counts pixel centres as integers,
    like the Kinect's published calibration; the cameras read here lie half a pixel further.

    Args:
        root: the folder.
        options: units, and the depth camera where depth is not of the colour camera.

    Returns:
        The scene, metric.

    Raises:
        ProjectError: no intrinsics, no complete frame, or a malformed file.
        ShapeError: a pose with NaN, a scale or a mirror.
    """
    root = Path(root)
    resolved, findings = resolve_options(root, options)
    frames, unposed = [], []
    for color in sorted(path for path in root.iterdir() if path.name.endswith(COLOR_SUFFIXES)):
        stem = color.name[: color.name.rindex(".color.")]
        pose = root / f"{stem}.pose.txt"
        if not pose.is_file():
            unposed.append(color.name)
            continue
        depth = root / f"{stem}.depth.png"
        frames.append(
            RgbdFrame(
                color.name,
                color,
                depth if depth.is_file() else None,
                load_matrix(pose, (4, 4), (3, 4)),
                str(pose),
            )
        )
    posed = sum(1 for _ in root.glob("*.pose.txt"))
    if posed > len(frames):
        message = f"{posed - len(frames)} poses have no picture: dropped"
        findings.append(Finding("warning", message))
    if unposed:
        findings.append(
            Finding("warning", f"{len(unposed)} pictures have no pose: dropped ({named(unposed)})")
        )
    files = [folder / INTRINSICS for folder in (root, root.resolve().parent)]
    path = next((path for path in files if path.is_file()), None)
    if path is None and resolved.color_K is None:
        raise ProjectError(
            f"{root}: no {INTRINSICS} there or in the parent folder; expected three lines "
            "'fx 0 cx', '0 fy cy', '0 0 1'; write it, or give color_K"
        )
    K = np.asarray(resolved.color_K) if path is None else load_matrix(path, (3, 3))
    return rgbd_scene(Recording(root, frames, K, findings=findings), resolved)
