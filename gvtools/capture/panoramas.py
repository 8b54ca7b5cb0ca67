"""Panoramas and fisheye pictures of a capture: recognised, and panoramas cut into faces.

Features are found and matched on overlapping perspective faces. For mapping the faces of a panorama
are a rig: they share a centre, and their relative rotations are known exactly.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gvtools.cameras import reduced_size
from gvtools.capture.photographs import JPEG_QUALITY, CapturedPhotograph
from gvtools.colmap import pycolmap
from gvtools.errors import OptionError
from gvtools.scenes.images import read_image, read_mask
from gvtools.scenes.undistort import FACE_DEGREES, PANORAMA, Face, face_name, panorama_faces

LENSES = ("auto", "perspective", "equirectangular", "fisheye")
# XMP of Google's photo sphere schema, near the beginning of a file.
XMP_KEY, XMP_VALUE, XMP_WITHIN = b"ProjectionType", b"equirectangular", 1 << 18
# Lenses are recognised at this length of the longer side. [pixels]
JUDGED_SIDE = 512
# A 2:1 picture is a panorama if its left and right borders continue each other: the mean difference
# between first and last column is at most this many times that of neighbouring columns, plus one.
# [grey levels]
MEETS = 2.0
# Corners of a fisheye picture, outside its image circle, are at most so bright. [grey levels]
DARK = 12
# Field of view across a fisheye's image circle that mapping starts from. [degrees]
FISHEYE_DEGREES = 180.0


@dataclass(frozen=True, eq=False)
class FaceRig:
    """The faces of panoramas of one size."""

    faces: tuple[Face, ...]  # how each face is sampled from a panorama
    panoramas: tuple[str, ...]  # names of the panoramas

    def prefix(self, face: Face) -> str:
        """Folder of a face's files during mapping, as COLMAP's rigs need it; see rename_faces."""
        width, height = face.source_size
        return f"{width}x{height}/{face.face}/"

    def names(self, face: Face) -> list[str]:
        """Names of one face of all panoramas during mapping."""
        return [f"{self.prefix(face)}{name}" for name in self.panoramas]

    def config(self) -> pycolmap.RigConfig:
        """The rig as COLMAP has it: the first face is its reference."""
        reference = self.faces[0].rotation
        cameras = []
        for number, face in enumerate(self.faces):
            turn = pycolmap.Rotation3d(face.rotation @ reference.T)
            camera = pycolmap.RigConfigCamera(
                ref_sensor=number == 0, image_prefix=self.prefix(face), camera=face.target
            )
            if number:
                camera.cam_from_rig = pycolmap.Rigid3d(turn, np.zeros(3))
            cameras.append(camera)
        return pycolmap.RigConfig(cameras=cameras)


def lens_of(photographs: Sequence[CapturedPhotograph], lens: str) -> str:
    """The kind of lens, one of LENSES but "auto"; recognised from the pictures if ``lens`` is."""
    if lens == "equirectangular":
        wrong = [item.name for item in photographs if item.size[0] != 2 * item.size[1]]
        if wrong:
            raise OptionError(
                f"--lens equirectangular: {len(wrong)} of {len(photographs)} pictures are not "
                f"twice as wide as high (first {wrong[0]}); expected full ones; leave these out"
            )
    if lens != "auto":
        return lens
    spherical = [item.name for item in photographs if _is_panorama(item)]
    if spherical and len(spherical) < len(photographs):
        raise OptionError(
            f"{len(spherical)} of {len(photographs)} pictures are panoramas (first "
            f"{spherical[0]}); expected all or none; capture them apart, or give --lens"
        )
    if spherical:
        return "equirectangular"
    return "fisheye" if all(_is_fisheye(item) for item in photographs) else "perspective"


def _is_panorama(item: CapturedPhotograph) -> bool:
    width, height = item.size
    if width != 2 * height:
        return False
    with item.path.open("rb") as file:
        head = file.read(XMP_WITHIN)
    if XMP_KEY in head and XMP_VALUE in head:
        return True
    grey = _grey(item)
    inside = np.abs(np.diff(grey, axis=1)).mean()
    across = np.abs(grey[:, 0] - grey[:, -1]).mean()
    # The first and the last row each show a single point, so they have one colour.
    poles = max(np.abs(np.diff(grey[row])).mean() for row in (0, -1))
    return bool(across <= MEETS * (inside + 1) and poles <= inside + 1)


def _is_fisheye(item: CapturedPhotograph) -> bool:
    grey = _grey(item)
    y, x = np.mgrid[: grey.shape[0], : grey.shape[1]] + 0.5
    radius = np.hypot(x - grey.shape[1] / 2, y - grey.shape[0] / 2) / (max(grey.shape) / 2)
    dark = grey[radius > 1.05]
    return bool(len(dark) and dark.max() <= DARK and grey[radius < 0.5].mean() > 2 * DARK)


def _grey(item: CapturedPhotograph) -> NDArray[np.float64]:
    with Image.open(item.path) as opened:
        image = opened.convert("L")
        size = reduced_size(image.width, image.height, JUDGED_SIDE)
        return np.asarray(image.resize(size, Image.Resampling.BOX), np.float64)


def fisheye_params(photographs: Sequence[CapturedPhotograph]) -> str:
    """Initial parameters of OPENCV_FISHEYE for mapping, as COLMAP writes them.

    The circle of FISHEYE_DEGREES is taken to touch the long sides of a picture with dark corners,
    and to pass through the corners of a picture without.
    """
    width, height = photographs[0].size
    across = min(width, height) if _is_fisheye(photographs[0]) else math.hypot(width, height)
    focal = across / math.radians(FISHEYE_DEGREES)
    return f"{focal},{focal},{width / 2},{height / 2},0,0,0,0"


def write_faces(
    photographs: Sequence[CapturedPhotograph], images: Path, *, masks: Path | None, face_masks: Path
) -> list[FaceRig]:
    """Cut panoramas into faces, see ``FaceRig.names``, and their masks ``NAME.png`` likewise."""
    sizes: dict[tuple[int, int], list[CapturedPhotograph]] = {}
    for item in photographs:
        sizes.setdefault(item.size, []).append(item)
    rigs = []
    for (width, height), group in sizes.items():
        camera = pycolmap.Camera(model=PANORAMA, width=width, height=height, params=[width, height])
        faces = panorama_faces(camera, degrees=FACE_DEGREES)
        rig = FaceRig(faces, tuple(item.name for item in group))
        for item in group:
            rgb = read_image(item.path).rgb
            mask = None if masks is None else masks / f"{item.name}.png"
            usable = read_mask(mask) if mask is not None and mask.is_file() else None
            for face in faces:
                name = rig.prefix(face) + item.name
                _save(face.image(rgb), images / name)
                if usable is not None:
                    seen = face.nearest(usable).astype(np.uint8) * 255
                    _save(seen, face_masks / f"{name}.png")
        rigs.append(rig)
    return rigs


def _save(pixels: NDArray[np.uint8], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    options = {"quality": JPEG_QUALITY} if path.suffix.lower() in (".jpg", ".jpeg") else {}
    Image.fromarray(pixels).save(path, **options)  # type: ignore[arg-type]


def rename_faces(
    model: pycolmap.Reconstruction, rigs: Sequence[FaceRig], *, images: Path, face_masks: Path
) -> None:
    """Give faces, their files and their masks the names of views: ``room@front.jpg``."""
    names = {
        rig.prefix(face) + name: face_name(name, face.face)
        for rig in rigs
        for face in rig.faces
        for name in rig.panoramas
    }
    for image in model.images.values():
        image.name = names[image.name]
    for folder, suffix in ((images, ""), (face_masks, ".png")):
        for old, new in names.items():
            if (folder / f"{old}{suffix}").is_file():
                (folder / f"{new}{suffix}").parent.mkdir(parents=True, exist_ok=True)
                (folder / f"{old}{suffix}").rename(folder / f"{new}{suffix}")
        for path in sorted(folder.rglob("*"), reverse=True):
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def panorama_pairs(pairs: Mapping[tuple[str, str], int]) -> dict[tuple[str, str], int]:
    """Verified matches of pairs of panoramas: the sums over their pairs of faces."""
    found: Counter[tuple[str, str]] = Counter()
    for pair, count in pairs.items():
        first, second = sorted(name.split("/", 2)[2] for name in pair)
        if first != second:
            found[first, second] += count
    return dict(found)
