"""Camera files of MVSNet and its relatives: ``cams/NNNNNNNN_cam.txt`` beside ``images``.

A file holds the word "extrinsic" with a 4x4 cam_from_world, the word "intrinsic" with a 3x3 matrix
in pixels, and the range of depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.posed_pictures import Float64, PosedPicture, pinhole_lens
from gvtools.scenes.images import read_header
from gvtools.untrusted import read_text

SUFFIX = "_cam.txt"
# How far a principal point may be from the middle, as a share of a side, to be of that picture.
CENTRED = 0.2
NOWHERE = (2, 2)  # the size of a picture that is not there


@dataclass(frozen=True, eq=False)
class MvsCamera:
    """One camera file.

    Attributes:
        K: (3, 3) float64, pixels, as stored.
        cam_from_world: (4, 4) float64, stored units.
    """

    K: Float64
    cam_from_world: Float64


def read_camera(path: Path) -> MvsCamera:
    """A camera file."""
    try:
        words = read_text(path).split()
        at = words.index("extrinsic") + 1
        pose = np.array(words[at : at + 16], np.float64).reshape(4, 4)
        at = words.index("intrinsic") + 1
        K = np.array(words[at : at + 9], np.float64).reshape(3, 3)
    except (OSError, ValueError) as error:
        raise ProjectError(
            f"{path}: {error}; expected 'extrinsic' with 4x4 and 'intrinsic' with 3x3 numbers"
        ) from None
    return MvsCamera(K, pose)


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture; of one that cannot be read, which will be left out, 2 x 2."""
    try:
        header = read_header(path)
    except ProjectError:
        return NOWHERE
    return header.width, header.height


def size_of_intrinsics(
    K: Float64, picture: tuple[int, int], *others: tuple[int, int]
) -> tuple[int, int]:
    """Which pictures intrinsics are of: the first size in whose middle the principal point lies.

    Args:
        K: (3, 3), pixels.
        picture: width and height of the picture at hand.
        others: further sizes that the data set's files may be of.

    >>> size_of_intrinsics([[361, 0, 82], [0, 360, 66], [0, 0, 1]], (640, 512), (160, 128))
    (160, 128)
    """
    matrix = np.asarray(K, np.float64)
    for width, height in (picture, *others):
        off = np.abs(matrix[:2, 2] / (width, height) - 0.5)
        if off.max() <= CENTRED:
            return width, height
    return picture


def posed_picture(
    name: str, image: Path, camera: MvsCamera, *, sizes: tuple[tuple[int, int], ...], unit: float
) -> PosedPicture:
    """A frame of a camera file.

    Args:
        name: the view's.
        image: where its picture should be.
        camera: as read.
        sizes: further sizes that the intrinsics may be of.
        unit: metres (or whatever the scene's unit is) in a stored unit.
    """
    size = size_of_intrinsics(camera.K, picture_size(image), *sizes)
    pose = camera.cam_from_world.copy()
    pose[:3, 3] *= unit
    return PosedPicture(name, image, pinhole_lens(camera.K, size), pose)
