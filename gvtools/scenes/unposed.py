"""RGB-D folders whose frames have no poses yet, as ``gvtools capture`` takes them.

They are those of the posed layouts less their poses: 7-Scenes without ``*.pose.txt``, TUM without
``groundtruth.txt``, ScanNet without ``pose``, Redwood without a ``.log`` trajectory. Every frame
stands at the identity here.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gvtools.scenes import redwood, scannet, sevenscenes, tum
from gvtools.scenes.rgbd_recording import Recording, RgbdFrame, RgbdOptions, pictures_in
from gvtools.scenes.scene import Finding

LOOKS_LIKE = (
    "7-Scenes (*.color.*, *.depth.png)",
    "TUM (rgb.txt, depth.txt)",
    "ScanNet (color, depth, intrinsic)",
    "Redwood and Open3D (color, depth)",
)


def count_unposed(root: Path) -> int:
    """How many RGB-D frames a folder holds that is no project; 0 where it holds none."""
    kind = _kind(root)
    return 0 if kind is None else len(_files(root, kind, RgbdOptions()))


def read_unposed(root: Path, options: RgbdOptions) -> Recording | None:
    """The frames with depth of such a folder, all at the identity; None where it is of no layout.

    Args:
        root: the folder.
        options: what it does not tell by itself.
    """
    kind = _kind(root)
    if kind is None:
        return None
    files = _files(root, kind, options)
    frames = [
        RgbdFrame(color.name, color, depth, np.eye(4), str(color))
        for color, depth in files
        if depth is not None and depth.is_file()
    ]
    findings = []
    if len(frames) < len(files):
        message = f"{len(files) - len(frames)} of {len(files)} pictures have no depth map: left out"
        findings.append(Finding("warning", message))
    if kind == "scannet":
        recording = scannet.calibrated(root, options, frames=frames)
        return replace(recording, findings=[*findings, *recording.findings])
    if kind == "sevenscenes":
        return Recording(root, frames, sevenscenes.intrinsics(root, options), findings=findings)
    if kind == "tum":
        K, distortion, source = tum.intrinsics(root)
        if options.color_K is None:
            findings.append(Finding("info", f"intrinsics: {source}"))
        return Recording(
            root, frames, K, distortion, depth_unit=tum.DEPTH_UNIT, findings=findings
        )  # fmt: skip
    K, met = redwood.intrinsics(root, options)
    return Recording(root, frames, K, findings=[*findings, *met])


def _kind(root: Path) -> str | None:
    if any(root.glob("*.color.*")) and any(root.glob("*.depth.png")):
        return "sevenscenes"
    if (root / "rgb.txt").is_file() and (root / "depth.txt").is_file():
        return "tum"
    if not (root / "depth").is_dir():
        return None
    if (root / "color").is_dir() and (root / "intrinsic").is_dir():
        return "scannet"
    return None if redwood.color_folder(root) is None else "redwood"


def _files(root: Path, kind: str, options: RgbdOptions) -> list[tuple[Path, Path | None]]:
    """Picture and depth map of each frame, in order of time."""
    if kind == "sevenscenes":
        return [(color, depth) for color, depth, _ in sevenscenes.frame_files(root)]
    if kind == "tum":
        listed, _ = tum.frame_files(root, options.max_time_difference)
        return [(color, depth) for _, color, depth in sorted(listed, key=lambda item: item[:2])]
    if kind == "scannet":
        return [(color, depth) for color, depth, _ in scannet.frame_files(root)]
    folder = redwood.color_folder(root)
    assert folder is not None
    colors = pictures_in(folder)
    depth_of = redwood.pair_by_name(colors, pictures_in(root / "depth"))
    return [(color, depth_of.get(color)) for color in colors]
