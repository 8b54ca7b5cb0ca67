"""The photographs of a folder, looked at before features are extracted, and copied upright.

Structure from motion works on pixels as stored. A camera held upright stores its pictures on their
side and says so in EXIF; such pictures are turned here, once, so that everything later sees them
upright and one camera's pictures of both kinds are told apart.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from gvtools.errors import ProjectError
from gvtools.scenes.images import UNREADABLE
from gvtools.scenes.matching import named
from gvtools.scenes.project import PICTURES
from gvtools.scenes.scene import Finding, natural_key
from gvtools.untrusted import open_picture, read_bytes

# EXIF tags (Exif 2.32) and the sub-folders that hold them.
EXIF_FOLDER, GPS_FOLDER = 0x8769, 0x8825
ORIENTATION, MAKE, MODEL = 0x0112, 0x010F, 0x0110
FOCAL, FOCAL_35MM = 0x920A, 0xA405
GPS_LATITUDE, GPS_LONGITUDE, GPS_ALTITUDE = 2, 4, 6
# Quality of a JPEG that had to be turned.
JPEG_QUALITY = 97
# Pictures that cameras write and Pillow does not read.
FOREIGN = (
    ".heic",
    ".heif",
    ".avif",
    ".dng",
    ".cr2",
    ".cr3",
    ".nef",
    ".arw",
    ".raf",
    ".orf",
    ".rw2",
)
# Pictures are judged at this height, and one whose sharpness is below this share of the median's is
# called blurred. [pixels]
JUDGED_HEIGHT, BLURRED = 480, 0.15
# Where the median itself is below this, all are called soft (photographs in focus: 100 and more).
SOFT = 10.0


@dataclass(frozen=True)
class CapturedPhotograph:
    """One readable picture."""

    path: Path  # where it is
    name: str  # relative to the folder, with "/"
    size: tuple[int, int]  # width and height when upright, pixels
    camera: str  # pictures of equal text were taken by one camera at one focal length
    turned: bool  # whether its pixels are stored on their side
    sharpness: float  # variance of the Laplacian at JUDGED_HEIGHT, grey levels squared
    # Latitude and longitude in degrees, height in metres; None without GPS.
    location: tuple[float, float, float] | None = None


def find_photographs(folder: Path) -> tuple[list[CapturedPhotograph], list[Finding]]:
    """The readable, different pictures below a folder in natural order, and what was met."""
    paths = [
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in PICTURES and not path.name.startswith(".") and path.is_file()
    ]
    foreign = [
        path.relative_to(folder).as_posix()
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in FOREIGN and not path.name.startswith(".")
    ]
    paths.sort(key=lambda path: natural_key(path.relative_to(folder).as_posix()))
    found: list[CapturedPhotograph] = []
    damaged: list[str] = []
    copies: list[str] = []
    digests: set[bytes] = set()
    for path in paths:
        name = path.relative_to(folder).as_posix()
        digest = hashlib.sha256(read_bytes(path)).digest()
        if digest in digests:
            copies.append(name)
            continue
        digests.add(digest)
        try:
            found.append(_look_at(path, name))
        except UNREADABLE:
            damaged.append(name)
    findings = [
        Finding(
            "warning", f"{len(names)} of {len(paths)} pictures {reason}: left out ({named(names)})"
        )
        for names, reason in ((damaged, "cannot be read"), (copies, "are copies of others"))
        if names
    ]
    if foreign:
        text = (
            f"{len(foreign)} pictures are HEIC, AVIF or raw: left out ({named(foreign)}); convert "
            "them to JPEG"
        )
        findings.append(Finding("warning", text))
    if len(found) < 2:
        met = "; ".join(finding.message for finding in findings)
        raise ProjectError(
            f"{folder}: {len(found)} readable pictures{f' ({met})' if met else ''}; expected at "
            "least two photographs of one place, taken from different points"
        )
    return found, [*findings, *_oddities(found)]


def _look_at(path: Path, name: str) -> CapturedPhotograph:
    with open_picture(path) as image:
        exif = image.getexif()
        more, gps = exif.get_ifd(EXIF_FOLDER), exif.get_ifd(GPS_FOLDER)
        turned = int(exif.get(ORIENTATION, 1) or 1) > 1
        upright = ImageOps.exif_transpose(image)
        grey = upright.convert("L")
    lens = (exif.get(MAKE, ""), exif.get(MODEL, ""), more.get(FOCAL, ""), more.get(FOCAL_35MM, ""))
    camera = "/".join(str(part).strip("\0 ") for part in (*lens, *upright.size))
    height = min(JUDGED_HEIGHT, grey.height)
    small = grey.resize(
        (max(1, round(grey.width * height / grey.height)), height), Image.Resampling.BOX
    )
    return CapturedPhotograph(
        path, name, upright.size, camera, turned, sharpness(np.asarray(small)), _location(gps)
    )


def sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian of an (H, W) uint8 picture: low where it is blurred."""
    import cv2

    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def _location(gps: dict[int, object]) -> tuple[float, float, float] | None:
    """Latitude, longitude and height of a GPS folder."""
    try:
        degrees = []
        for tag in (GPS_LATITUDE, GPS_LONGITUDE):
            # Degrees, minutes, seconds; the tag before names the hemisphere.
            parts = [float(part) for part in gps[tag]]  # type: ignore[attr-defined]
            value = parts[0] + parts[1] / 60 + parts[2] / 3600
            degrees.append(-value if str(gps.get(tag - 1, "")).upper() in ("S", "W") else value)
        height = float(gps.get(GPS_ALTITUDE, 0.0))  # type: ignore[arg-type]
    except (KeyError, TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return (degrees[0], degrees[1], height) if np.isfinite([*degrees, height]).all() else None


def _oddities(found: Sequence[CapturedPhotograph]) -> list[Finding]:
    """What may keep pictures from being registered, or explains a model."""
    findings = []
    middle = float(np.median([item.sharpness for item in found]))
    blurred = [item.name for item in found if item.sharpness < BLURRED * middle]
    if blurred:
        findings.append(
            Finding(
                "warning",
                f"{len(blurred)} of {len(found)} pictures are blurred beside the others "
                f"({named(blurred)}); they are tried all the same",
            )
        )
    if middle < SOFT:
        findings.append(
            Finding(
                "warning",
                f"most of the {len(found)} pictures have hardly any edges: blurred, dark, or of "
                "bare walls",
            )
        )
    turned = [item.name for item in found if item.turned]
    if turned:
        findings.append(
            Finding("info", f"{len(turned)} pictures were stored on their side: turned upright")
        )
    sizes = {item.size for item in found}
    if len(sizes) > 1:
        text = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
        findings.append(
            Finding("info", f"pictures of {len(sizes)} sizes ({text}): one camera each")
        )
    return findings


def copy_upright(photographs: Iterable[CapturedPhotograph], folder: Path) -> None:
    """Copy pictures to ``folder`` under their names; those on their side are turned.

    A picture that is turned is coded again: JPEG at quality JPEG_QUALITY, others without loss.
    """
    for item in photographs:
        target = folder / item.name
        target.parent.mkdir(parents=True, exist_ok=True)
        if not item.turned:
            shutil.copyfile(item.path, target)
            continue
        with Image.open(item.path) as image:
            form = image.format
            upright = ImageOps.exif_transpose(image)
            options = {"quality": JPEG_QUALITY} if form in ("JPEG", "MPO", "WEBP") else {}
            # exif_transpose has taken the orientation out; focal length and camera stay.
            upright.save(
                target, format="JPEG" if form == "MPO" else form, exif=upright.getexif(), **options
            )
