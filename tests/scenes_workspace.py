"""Small projects on disk for the tests of the readers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 96, 72

# Parameters for 96x72 pictures of every perspective model that COLMAP has.
LENSES: dict[str, list[float]] = {
    "SIMPLE_PINHOLE": [90, 48, 36],
    "PINHOLE": [90, 92, 47, 37],
    "SIMPLE_RADIAL": [90, 48, 36, -0.15],
    "RADIAL": [90, 48, 36, 0.1, -0.02],
    "OPENCV": [90, 91, 48, 36, 0.05, -0.07, 0.002, -0.002],
    "FULL_OPENCV": [90, 91, 48, 36, 0.1, 0.01, 0.001, 0.001, 0.01, 0.02, 0.01, 0.01],
    "FOV": [90, 91, 48, 36, 0.4],
    "SIMPLE_DIVISION": [90, 48, 36, -0.05],
    "DIVISION": [90, 91, 48, 36, -0.05],
    "EUCM": [90, 91, 48, 36, 0.5, 1.0],
    "SIMPLE_FISHEYE": [90, 48, 36],
    "FISHEYE": [90, 91, 48, 36],
    "SIMPLE_RADIAL_FISHEYE": [90, 48, 36, 0.05],
    "RADIAL_FISHEYE": [90, 48, 36, 0.05, 0.01],
    "OPENCV_FISHEYE": [90, 91, 48, 36, 0.02, 0.01, 0.0, 0.0],
    "THIN_PRISM_FISHEYE": [90, 91, 48, 36, 0.02, 0.01, 0.001, 0.001, 0, 0, 0.001, 0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(90, 91, 48, 36),
        *(0.02, 0.01, 0, 0, 0, 0),
        *(0.001, 0.001),
        *(0.001, 0, 0.001, 0),
    ],
}


def ramp(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """(H, W, 3) uint8 picture whose red and green tell where a pixel lies."""
    x = (np.arange(width) + 0.5) / width * 255
    y = (np.arange(height) + 0.5) / height * 255
    picture = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 60.0), axis=-1)
    return picture.round().astype(np.uint8)


def save(path: Path, array: np.ndarray) -> Path:
    """Write a picture, making its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)
    return path


def synthetic_model(model: str = "SIMPLE_RADIAL", **options: Any) -> Any:
    """A reconstruction of exact synthetic points, made by pycolmap."""
    import pycolmap

    pycolmap.set_random_seed(3)
    settings = {
        "num_rigs": 1,
        "num_cameras_per_rig": 1,
        "num_frames_per_rig": 4,
        "num_points3D": 40,
        "camera_width": WIDTH,
        "camera_height": HEIGHT,
        "camera_model_id": pycolmap.CameraModelId.__members__[model],
        "camera_params": [float(value) for value in LENSES[model]],
        **options,
    }
    return pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(**settings))


def workspace(
    root: Path,
    model: str = "SIMPLE_RADIAL",
    *,
    text: bool = False,
    classic: bool = False,
    place: str = "sparse/0",
    **options: Any,
) -> Any:
    """Write a COLMAP workspace below ``root`` and return its reconstruction."""
    reconstruction = synthetic_model(model, **options)
    folder = root / place
    folder.mkdir(parents=True)
    if text:
        reconstruction.write_text(folder)
    else:
        reconstruction.write_binary(folder)
    if classic:
        for stem in ("rigs", "frames"):
            (folder / f"{stem}{'.txt' if text else '.bin'}").unlink()
    for image in reconstruction.images.values():
        save(root / "images" / image.name, ramp())
    return reconstruction


def pose_matrix(x: float = 0.0) -> np.ndarray:
    """(4, 4) camera-to-world: turned a little about y, moved along x."""
    angle = 0.1
    pose = np.eye(4)
    pose[0, 0] = pose[2, 2] = np.cos(angle)
    pose[0, 2], pose[2, 0] = np.sin(angle), -np.sin(angle)
    pose[:3, 3] = (x, 0.1, -0.2)
    return pose


def depth_picture(metres: float = 2.0, unit: float = 1e-3) -> np.ndarray:
    """(H, W) uint16 constant depth with one pixel of each "no reading" code."""
    depth = np.full((HEIGHT, WIDTH), round(metres / unit), np.uint16)
    depth[0, 0], depth[0, 1] = 0, 65535
    return depth


def sevenscenes(root: Path, frames: int = 3) -> Path:
    """Write a folder in the 7-Scenes layout."""
    root.mkdir(parents=True, exist_ok=True)
    K = np.array([[90, 0, 47.5], [0, 90, 35.5], [0, 0, 1]])
    np.savetxt(root / "camera-intrinsics.txt", K)
    for i in range(frames):
        save(root / f"frame-{i:06d}.color.png", ramp())
        save(root / f"frame-{i:06d}.depth.png", depth_picture())
        np.savetxt(root / f"frame-{i:06d}.pose.txt", pose_matrix(0.1 * i))
    return root


def transforms(root: Path, frames: list[dict[str, Any]], **shared: Any) -> Path:
    """Write a transforms.json."""
    root.mkdir(parents=True, exist_ok=True)
    (root / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    return root / "transforms.json"
