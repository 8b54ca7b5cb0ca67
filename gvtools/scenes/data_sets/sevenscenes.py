"""7-Scenes as published: ``SCENE/seq-NN/frame-NNNNNN.{color.png, depth.png, pose.txt}``."""

from __future__ import annotations

from pathlib import Path

from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.rgbd_recording import RgbdOptions
from gvtools.scenes.scene import Scene, natural_key
from gvtools.scenes.sevenscenes import INTRINSICS, SEVENSCENES

# The published values of the depth camera, pixels: the download holds no file of them.
KINECT = [[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]]


def _scenes(root: Path) -> tuple[str, ...]:
    folders = {path.parent for path in root.glob("*/seq-*/frame-*.pose.txt")}
    return tuple(sorted((f.relative_to(root).as_posix() for f in folders), key=natural_key))


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    folder = root / scene
    has_file = any((place / INTRINSICS).is_file() for place in (folder, folder.parent))
    options = None if has_file else RgbdOptions(color_K=KINECT)
    return SEVENSCENES.read(folder, options=options)


LAYOUT = Layout("SCENE/seq-NN/frame-NNNNNN.pose.txt with .color.png and .depth.png", _scenes, _read)
