"""OmniWorld-Game as its authors' script unpacks it: ``SCENE`` with ``color`` and ``camera``.

Recordings are cut into splits, each with cameras of its own, so that a split is a scene here.
``split_info.json`` lists the frames of each split; ``camera/split_0.json`` holds for them ``quats``
(w, x, y, z) and ``trans`` of cam_from_world with OpenCV axes, ``focals``, ``cx`` and ``cy`` in
pixels whose first centre is (0.5, 0.5). Depth is a 16-bit PNG of a depth buffer between a near
plane at 1 and a far one at 1000, times 250; the unit is not published. Masks of what moves are not
applied.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.drawn import NO_LENS, numbers_in, picture_size, pose_of
from gvtools.scenes.data_sets.layouts import Layout
from gvtools.scenes.data_sets.posed_pictures import PosedPicture, natural, pinhole_lens, posed_scene
from gvtools.scenes.data_sets.spec import DataSetSpec
from gvtools.scenes.images import UNREADABLE
from gvtools.scenes.scene import Finding, Scene
from gvtools.untrusted import open_picture, read_json

Float64 = NDArray[np.float64]

IMAGE = "{:06d}.png"
NEAR, FAR, SCALE = 1.0, 1000.0, 250.0
# Shares of the buffer's range, as the authors' script has them: nearer is too close, farther sky.
NEAREST, FARTHEST = 0.0015, 65500 / 65535


def buffer_depth(path: Path) -> NDArray[np.float32]:
    """(H, W) float32 z-depth of OmniWorld's 16-bit depth buffers, 0 where they hold none."""
    try:
        with open_picture(path) as image:
            mode, raw = image.mode, np.asarray(image)
    except UNREADABLE as error:
        raise ProjectError(f"{path}: unreadable ({error}); download it again") from None
    if not mode.startswith("I"):
        raise ProjectError(f"{path}: depth as {mode}; expected 16-bit grey")
    share = raw.astype(np.float64) / 65535
    depth = SCALE * share / (FAR - (FAR - NEAR) * share)
    return np.where((share >= NEAREST) & (share <= FARTHEST), depth, 0).astype(np.float32)


def _scenes(root: Path) -> tuple[str, ...]:
    files = (f for above in ("", "*/", "*/*/") for f in root.glob(f"{above}camera/split_*.json"))
    return natural(
        f"{file.parent.parent.relative_to(root).as_posix()}/{file.stem}".removeprefix("./")
        for file in files
        if re.fullmatch(r"split_[0-9]+", file.stem)
    )


def _read(root: Path, scene: str, spec: DataSetSpec) -> Scene:
    above, _, split = scene.rpartition("/")
    folder = root / above
    number = int(split.removeprefix("split_"))
    info, path = folder / "split_info.json", folder / "camera" / f"{split}.json"
    try:
        frames = [int(frame) for frame in _json(info)["split"][number]]
        poses, lenses = _cameras(_json(path), len(frames))
    except (ValueError, KeyError, IndexError, OverflowError, TypeError) as error:
        raise ProjectError(
            f"{path}: does not fit {info.name} ({type(error).__name__}: {error}); expected quats, "
            "trans, focals, cx and cy of the split's frames; download both again"
        ) from None
    images = folder / "color"
    size = picture_size(images / IMAGE.format(frame) for frame in frames)
    pictures = [
        PosedPicture(
            IMAGE.format(frame),
            images / IMAGE.format(frame),
            pinhole_lens(lens, size) if lens[0] > 0 else NO_LENS,
            pose,
            folder / "depth" / IMAGE.format(frame),
            buffer_depth,
        )
        for frame, pose, lens in zip(frames, poses, lenses, strict=True)
    ]
    findings = []
    if numbers_in(folder / "gdino_mask", IMAGE):
        findings.append(Finding("info", "gdino_mask is not applied: what moves is part of views"))
    return posed_scene(folder, pictures, poses="cam_from_world", metric=False, findings=findings)


def _json(path: Path) -> Any:
    try:
        return read_json(path)
    except (OSError, ValueError) as error:
        raise ProjectError(f"{path}: unreadable ({error}); download it again") from None


def _cameras(values: Any, count: int) -> tuple[Float64, Float64]:
    """(N, 4, 4) cam_from_world and (N, 4) fx, fy, cx, cy."""
    from scipy.spatial.transform import Rotation

    quaternions = np.array(values["quats"], np.float64).reshape(count, 4)
    turns = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    poses = pose_of(turns, np.array(values["trans"], np.float64).reshape(count, 3))
    lens = (np.broadcast_to(values[key], count) for key in ("focals", "focals", "cx", "cy"))
    return poses, np.stack(list(lens), axis=-1).astype(np.float64)


LAYOUT = Layout("SCENE/camera/split_N.json with split_info.json, color and depth", _scenes, _read)
