"""3D Scanner App, "All Data": ``frame_N.json``, ``frame_N.jpg``, ``depth_N.png``, ``conf_N.png``.

A frame's JSON has ``cameraPoseARFrame``, world_from_cam row by row for ARKit's axes, and
``intrinsics``, 3x3 row by row, of the picture. The app stores more poses and depth maps than
pictures; only frames with a picture become views. Depth is in millimetres, confidence 0, 1 or 2.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.posed_pictures import PosedPicture, natural, pinhole_lens
from gvtools.scenes.images import read_header
from gvtools.scenes.phones.arkit import (
    LidarMaps,
    PhoneLayout,
    numbers,
    opencv_pose,
    phone_scene,
    read_object,
)
from gvtools.scenes.scene import Finding, Scene

NAME = "3D Scanner App"
POSE, LENS = "cameraPoseARFrame", "intrinsics"
PROBES = 5  # frames by which an export is recognised


def _matches(root: Path) -> bool:
    # Other programs name frames like that, too; a damaged file or two decide nothing.
    frames = root.glob("frame_*.json") if root.is_dir() else ()
    return any(POSE in read_object(path) for path in islice(frames, PROBES))


def _read(root: Path) -> Scene:
    poses = natural(path.stem for path in root.glob("frame_*.json"))
    shown = natural(path.stem for path in root.glob("frame_*.jpg"))
    size, lidar = _size(root, shown), LidarMaps()
    pictures = []
    for name in shown:
        number = name.removeprefix("frame_")
        said = read_object(root / f"{name}.json")
        pose, K = numbers(said.get(POSE), (4, 4)), numbers(said.get(LENS), (3, 3))
        depth = root / f"depth_{number}.png"
        pictures.append(
            PosedPicture(
                f"{name}.jpg",
                root / f"{name}.jpg",
                None if K is None else pinhole_lens(K, size),
                None if pose is None else opencv_pose(pose),
                depth,
                lidar.reader(depth, root / f"conf_{number}.png"),
            )
        )
    unseen = len(set(poses) - set(shown))
    findings = lidar.findings()
    if unseen:
        line = f"{unseen} of {len(poses)} frames were recorded without a picture: not used"
        findings.append(Finding("info", line))
    return phone_scene(root, NAME, pictures, findings=findings)


def _size(root: Path, names: tuple[str, ...]) -> tuple[int, int]:
    """Of the first readable picture: all are of one camera, and no file says it."""
    for name in names:
        try:
            header = read_header(root / f"{name}.jpg")
        except ProjectError:
            continue
        return header.width, header.height
    return 2, 2  # of no picture: each of them will be left out


SCANNER_APP = PhoneLayout(
    NAME, f"{NAME} (all data: frame_*.json, frame_*.jpg, depth_*.png)", _matches, _read
)
