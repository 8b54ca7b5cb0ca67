"""The 7-Scenes layout: ``frame-XXXXXX.{color.png|jpg, depth.png, pose.txt}`` in one folder.

Poses are camera-to-world, depth is 16-bit millimetres with 0 and 65535 for no reading.
``camera-intrinsics.txt`` (3x3, in the folder or its parent) counts pixel centres as integers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.rgbd import RgbdLayout
from gvtools.scenes.rgbd_recording import Recording, RgbdOptions, load_matrix, posed_frames
from gvtools.scenes.scene import Finding

COLOR_SUFFIXES = (".color.png", ".color.jpg", ".color.jpeg")
INTRINSICS = "camera-intrinsics.txt"


def _matches(root: Path) -> bool:
    return any(root.glob("*.pose.txt")) and any(root.glob("*.color.*"))


def _record(root: Path, options: RgbdOptions) -> Recording:
    files = frame_files(root)
    frames, findings = posed_frames(files, (4, 4), (3, 4))
    without = set(root.glob("*.pose.txt")) - {pose for _, _, pose in files}
    if without:
        findings.append(Finding("warning", f"{len(without)} poses have no picture: dropped"))
    return Recording(root, frames, intrinsics(root, options), findings=findings)


def frame_files(root: Path) -> list[tuple[Path, Path, Path]]:
    """Picture, depth map and pose of each frame; the last two may be absent."""
    colors = sorted(path for path in root.iterdir() if path.name.endswith(COLOR_SUFFIXES))
    stems = [root / color.name[: color.name.rindex(".color.")] for color in colors]
    return [
        (color, Path(f"{stem}.depth.png"), Path(f"{stem}.pose.txt"))
        for color, stem in zip(colors, stems, strict=True)
    ]


def intrinsics(root: Path, options: RgbdOptions) -> NDArray[np.float64]:
    """(3, 3) of the colour camera as published: the folder's file, else the option."""
    files = [folder / INTRINSICS for folder in (root, root.resolve().parent)]
    path = next((path for path in files if path.is_file()), None)
    if path is None and options.color_K is None:
        raise ProjectError(
            f"{root}: no {INTRINSICS} there or in the parent folder; expected three lines "
            "'fx 0 cx', '0 fy cy', '0 0 1'; write it, or give color_K (--color-intrinsics)"
        )
    return np.asarray(options.color_K) if path is None else load_matrix(path, (3, 3))


SEVENSCENES = RgbdLayout("7-Scenes (*.color.*, *.depth.png, *.pose.txt)", _matches, _record)
read_sevenscenes = SEVENSCENES.read
