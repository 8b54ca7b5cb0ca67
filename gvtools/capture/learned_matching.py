"""Learned features in COLMAP's database: keypoints, and the matches that LightGlue finds.

What follows, verification and mapping, is the same as with SIFT.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from gvtools.errors import ShapeError
from gvtools.features import FeatureMatcher, Features
from gvtools.scenes.images import check_size, read_image, read_mask

# The longer side that pictures are reduced to, pixels: that of the pictures LightGlue's authors
# test with.
MAX_SIDE = 1024
# Keypoints of a picture, of the highest score.
MAX_FEATURES = 1024
# Lines about progress come after so many pictures or pairs.
EVERY = 100

Say = Callable[[str], object]


def extract(
    images: Path,
    names: Sequence[str],
    matcher: FeatureMatcher,
    *,
    masks: Path | None = None,
    say: Say = lambda text: None,
) -> dict[str, Features]:
    """Features of pictures, in the pixels of the pictures as they are stored.

    Args:
        images: the folder of the pictures.
        names: of the pictures.
        matcher: of the features.
        masks: folder of masks as COLMAP has them, ``a.jpg.png`` for ``a.jpg``, black where no
            features are to be found; a picture without one is used whole.
        say: told now and then.
    """
    found = {}
    for number, name in enumerate(names, start=1):
        features = _of_picture(read_image(images / name).rgb, matcher)
        mask = None if masks is None else masks / f"{name}.png"
        if mask is not None and mask.is_file():
            usable = read_mask(mask)
            check_size(usable.shape[::-1], (features.width, features.height), path=mask)
            x, y = np.floor(features.xy).astype(int).T
            features = features[usable[y, x]]
        found[name] = features
        if number % EVERY == 0:
            say(f"features of {number} of {len(names)} pictures")
    return found


def _of_picture(rgb: np.ndarray, matcher: FeatureMatcher) -> Features:
    height, width = rgb.shape[:2]
    scale = min(1.0, MAX_SIDE / max(height, width))
    small = (max(1, round(width * scale)), max(1, round(height * scale)))
    if small != (width, height):
        rgb = np.asarray(Image.fromarray(rgb).resize(small, Image.Resampling.LANCZOS))
    features = matcher.extract(np.ascontiguousarray(rgb))
    # Pixels' centres are at +0.5 in both pictures, so that positions scale.
    xy = features.xy * (np.array([width, height]) / small)
    # A learned position may lie half a pixel outside.
    return Features(
        np.clip(xy, 0.5, [width - 0.5, height - 0.5]), features.descriptors, width, height
    )


def write_keypoints(database: Path, features: Mapping[str, Features]) -> None:
    """Write keypoints of the database's pictures; the first pixel's centre is (0.5, 0.5) there.

    Args:
        database: of COLMAP, with the pictures.
        features: by their names.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            found = features[image.name]
            camera = opened.read_camera(image.camera_id)
            if (camera.width, camera.height) != (found.width, found.height):
                raise ShapeError(
                    f"{image.name}: features of {found.width}x{found.height} pixels; expected "
                    f"{camera.width}x{camera.height}"
                )
            opened.write_keypoints(image.image_id, found.xy.astype(np.float32))


def write_matches(
    database: Path,
    features: Mapping[str, Features],
    pairs: Sequence[tuple[str, str]],
    *,
    matcher: FeatureMatcher,
    say: Say = lambda text: None,
) -> None:
    """Match pairs of pictures and write the matches, not verified yet.

    Args:
        database: with the pictures' keypoints.
        features: of the pictures by name.
        pairs: of names.
        matcher: of the features.
        say: told now and then.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        for number, (first, second) in enumerate(pairs, start=1):
            rows = matcher.match(features[first], features[second])
            opened.write_matches(numbers[first], numbers[second], rows.astype(np.uint32))
            if number % EVERY == 0:
                say(f"{number} of {len(pairs)} pairs matched")
