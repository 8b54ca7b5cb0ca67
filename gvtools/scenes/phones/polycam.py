"""Polycam, raw data: ``keyframes/{images, cameras, depth, confidence}`` and what was corrected.

A frame's camera, a JSON, has t_00 to t_23, world_from_cam row by row for ARKit's axes, and fx, fy,
cx, cy, width, height of the picture. Where ``corrected_images`` and ``corrected_cameras`` are
there, both are read instead: poses are optimised and pictures undistorted, with a black border
where undistortion found nothing, which is masked. Poses of the two kinds are never mixed. Depth is
in millimetres, confidence 0, 127 or 255.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.posed_pictures import Float64, PosedPicture, natural, pinhole_lens
from gvtools.scenes.images import read_header, read_image
from gvtools.scenes.phones.arkit import (
    LidarMaps,
    PhoneLayout,
    numbers,
    opencv_pose,
    phone_scene,
    read_object,
)
from gvtools.scenes.scene import Finding, Frame, Scene
from gvtools.scenes.transforms_frame import LensParameters

NAME = "Polycam"
CORRECTED = "corrected_cameras", "corrected_images"
RECORDED = "cameras", "images"
POSE = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
LENS = ("fx", "fy", "cx", "cy")
BLACK = 8  # the compression of a JPEG leaves no more of a black border


def _home(root: Path) -> Path:
    """The folder of the keyframes, which may be given itself."""
    return root if root.name == "keyframes" else root / "keyframes"


def _matches(root: Path) -> bool:
    return any((_home(root) / cameras).is_dir() for cameras, _ in (CORRECTED, RECORDED))


def _read(root: Path) -> Scene:
    home, lidar = _home(root), LidarMaps()
    corrected = all((home / folder).is_dir() for folder in CORRECTED)
    cameras, images = CORRECTED if corrected else RECORDED
    said = "optimised, pictures undistorted" if corrected else "as ARKit tracked them"
    names = natural(
        path.stem
        for folder, kind in ((cameras, ".json"), (images, ".jpg"))
        for path in (home / folder).glob(f"*{kind}")
    )
    pictures = []
    for name in names:
        camera = read_object(home / cameras / f"{name}.json")
        pose = numbers([camera.get(key) for key in POSE], (3, 4))
        lens, image = _lens(camera), home / images / f"{name}.jpg"
        depth = home / "depth" / f"{name}.png"
        pictures.append(
            PosedPicture(
                f"{name}.jpg",
                image,
                lens,
                None if pose is None else opencv_pose(pose),
                depth,
                lidar.reader(depth, home / "confidence" / f"{name}.png"),
                read=read_undistorted if corrected and _of_size(image, lens) else None,
            )
        )
    findings = [Finding("info", f"poses: {said}"), *lidar.findings()]
    return phone_scene(root, NAME, pictures, findings=findings)


def _lens(camera: dict[str, object]) -> LensParameters | None:
    K = numbers([camera.get(key) for key in LENS], (4,))
    size = numbers([camera.get(key) for key in ("width", "height")], (2,))
    if K is None or size is None:
        return None
    return pinhole_lens(K, (int(size[0]), int(size[1])))


def _of_size(image: Path, lens: LensParameters | None) -> bool:
    """Whether a picture is readable and of its camera's size, so that a reader may be given."""
    try:
        header = read_header(image)
    except ProjectError:
        return False
    return lens is not None and (header.width, header.height) == lens.size


def read_undistorted(path: Path) -> Frame:
    """An undistorted picture, its black border masked."""
    picture = read_image(path)
    return Frame(picture.rgb, mask=~_border(picture.rgb))


def _border(rgb: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W): black pixels that hang together with the picture's edge."""
    from scipy.ndimage import label

    places, count = label(rgb.max(axis=-1) <= BLACK)
    edge: Float64 = np.concatenate([places[[0, -1]].ravel(), places[:, [0, -1]].ravel()])
    outside = np.zeros(count + 1, bool)
    outside[edge] = True
    outside[0] = False
    return outside[places]


POLYCAM = PhoneLayout(
    NAME, f"{NAME} (raw data: keyframes/ with cameras, images, depth)", _matches, _read
)
