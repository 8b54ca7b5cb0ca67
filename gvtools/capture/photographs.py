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

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from scipy.ndimage import gaussian_filter

from gvtools.errors import ProjectError
from gvtools.scenes.images import (
    IMAGE_SUFFIXES,
    UNREADABLE,
    orientation_of,
    read_mask,
    resize_nearest,
    same_aspect,
)
from gvtools.scenes.matching import find_renamed, is_hidden, named
from gvtools.scenes.scene import Finding, natural_key
from gvtools.untrusted import is_file, open_picture, read_bytes

# EXIF tags (Exif 2.32) and the sub-folders that hold them.
EXIF_FOLDER, GPS_FOLDER = 0x8769, 0x8825
ORIENTATION, MAKE, MODEL = 0x0112, 0x010F, 0x0110
FOCAL, FOCAL_35MM = 0x920A, 0xA405
GPS_LATITUDE, GPS_LONGITUDE, GPS_ALTITUDE = 2, 4, 6
# Quality of a JPEG that had to be turned.
JPEG_QUALITY = 97
# Pictures that cameras write and Pillow does not read.
HEIF = (".heic", ".heif", ".avif")
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".insv")
# Photographs have more colours; masks, blank frames and covers have these.
FEW_COLORS = 4
# Pictures are judged at this height, and one whose sharpness is below this share of the median's is
# called blurred. [pixels]
JUDGED_HEIGHT, BLURRED = 480, 0.15
# Pictures at this size [pixels] show the same where they correlate by more; those of a series,
# which may be alike, by more and with less difference on average, by which others are known, too
# [grey levels]. Their detail, freed of what varies slowly, correlates as well: skies are all alike.
THUMBNAIL, SAME, EXACT, NEAR, DETAIL = (32, 32), 0.9985, 0.9999, 1.5, 0.9
# Where the median itself is below this, all are called soft (photographs in focus: 100 and more).
SOFT = 10.0


@dataclass(frozen=True, eq=False)
class CapturedPhotograph:
    """One readable picture."""

    path: Path  # where it is
    name: str  # relative to the folder, with "/"
    size: tuple[int, int]  # width and height when upright, pixels
    camera: str  # pictures of equal text were taken by one camera at one focal length
    turned: bool  # whether its pixels are stored on their side
    sharpness: float  # variance of the Laplacian at JUDGED_HEIGHT, grey levels squared
    thumbnail: NDArray[np.uint8]  # (w h,) grey levels of the picture at THUMBNAIL
    # Latitude and longitude in degrees, height in metres; None without GPS.
    location: tuple[float, float, float] | None = None
    few_colors: bool = False  # as masks and blank frames
    deep: bool = False  # grey of more than 8 bits, as depth maps and some cameras' pictures


def find_photographs(folder: Path) -> tuple[list[CapturedPhotograph], list[Finding]]:
    """The readable, different pictures below a folder in natural order, and what was met."""
    every = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*"))}
    files = {name: path for name, path in every.items() if not is_hidden(name)}
    pictures = [
        name for name, path in every.items()
        if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()
    ]  # fmt: skip
    hidden = [name for name in pictures if name not in files]
    names = [name for name in pictures if name in files]
    foreign = [name for name, path in files.items() if path.suffix.lower() in (*HEIF, *RAW)]
    found: list[CapturedPhotograph] = []
    damaged: list[str] = []
    copies: list[str] = []
    digests: set[bytes] = set()
    for name in sorted(names, key=natural_key):
        digest = hashlib.sha256(read_bytes(files[name])).digest()
        if digest in digests:
            copies.append(name)
            continue
        digests.add(digest)
        try:
            found.append(_look_at(files[name], name))
        except UNREADABLE:
            damaged.append(name)
    # All pictures of a camera may be so; beside others they are masks, and depth maps.
    shown = [item for item in found if not item.few_colors]
    shown = shown if len(shown) > 1 else found
    masks = [item.name for item in found if item not in shown]
    found = [item for item in shown if not item.deep]
    found = found if len(found) > 1 else shown
    depth = [item.name for item in shown if item not in found]
    again = _copies(found)
    found = [item for item in found if item.name not in again]
    stems = {path.with_suffix("") for path in map(files.__getitem__, [*names, *foreign])}
    videos = [
        name for name, path in files.items()
        if path.suffix.lower() in VIDEOS and path.with_suffix("") not in stems
    ]  # fmt: skip
    some_of = f"of {len(names)} pictures"
    warnings = [
        f"{len(some)} {what} left out ({named(some)}){advice}"
        for some, what, advice in (
            (damaged, f"{some_of} cannot be read:", ""),
            (copies, f"{some_of} are copies of others:", ""),
            (masks, f"{some_of} have at most {FEW_COLORS} colours, as masks (give these with "
             "--masks):", ""),
            (depth, f"{some_of} are grey of 16 bits beside others of 8, as depth maps:", ""),
            (again, f"{some_of} are others again: reduced, turned, edited or saved once more:", ""),
            (hidden, "pictures lie in hidden folders or those of systems:", ""),
            (foreign, "pictures are HEIC, AVIF or raw:", "; convert them to JPEG"),
            (videos, "videos are", "; give one instead of the folder"),
        )
        if some
    ]  # fmt: skip
    if len(found) < 2:
        met = f" ({'; '.join(warnings)})" if warnings else ""
        raise ProjectError(
            f"{folder}: {len(found)} readable pictures{met}; expected at least two photographs of "
            "one place, taken from different points"
        )
    return found, [*(Finding("warning", text) for text in warnings), *_oddities(found)]


def _copies(found: Sequence[CapturedPhotograph]) -> list[str]:
    """Names of pictures that show what larger ones, or as large ones of shorter names, show."""
    order = sorted(found, key=lambda item: (-item.size[0] * item.size[1], len(item.name)))
    grey = np.array([item.thumbnail for item in order], np.float32).reshape(-1, *THUMBNAIL)
    whole, detail = _all_ways(grey), _all_ways(grey - gaussian_filter(grey, (0, 2, 2)))
    copies: list[str] = []
    kept: list[int] = []
    for number, item in enumerate(order):
        alike, fine = (ways[:, number] @ ways[0][kept].T for ways in (whole, detail))
        series = np.array([_one_form(item, order[row]) for row in kept], np.bool_)
        near = np.abs(grey[kept] - grey[number]).mean(axis=(1, 2)) < NEAR
        same = ((alike > SAME) & (fine > DETAIL)).any(axis=0) | (near & (fine[0] > DETAIL))
        if np.where(series, near & (alike[0] > EXACT), same).any():
            copies.append(item.name)
        else:
            kept.append(number)
    return sorted(copies, key=natural_key)


def _all_ways(pictures: NDArray[np.float32]) -> NDArray[np.float32]:
    """(8, N, pixels) unit vectors of pictures as they stand, turned and mirrored."""
    ways = [np.rot90(side, k, (1, 2)) for side in (pictures, pictures[:, :, ::-1])
            for k in range(4)]  # fmt: skip
    flat = np.reshape(ways, (8, len(pictures), THUMBNAIL[0] * THUMBNAIL[1]))
    flat = flat - flat.mean(axis=2, keepdims=True)
    return flat / np.maximum(np.linalg.norm(flat, axis=2, keepdims=True), np.float32(1e-6))


def _one_form(a: CapturedPhotograph, b: CapturedPhotograph) -> bool:
    """Whether pictures may be two of a series: of one size and kind, no name made of the other."""
    short, long = sorted((a.path.stem, b.path.stem), key=len)
    added = long.replace(short, "", 1)
    other = short not in long or not added or added.isdigit()
    return (a.size, a.path.suffix) == (b.size, b.path.suffix) and other


def _look_at(path: Path, name: str) -> CapturedPhotograph:
    with open_picture(path) as image:
        deep = image.mode.startswith(("I", "F"))
        few = not deep and image.convert("RGB").getcolors(FEW_COLORS) is not None
        exif = image.getexif()
        more, gps = exif.get_ifd(EXIF_FOLDER), exif.get_ifd(GPS_FOLDER)
        turned = orientation_of(exif) > 1
        upright = _upright(image)
        grey = upright.convert("L")
    lens = (exif.get(MAKE, ""), exif.get(MODEL, ""), more.get(FOCAL, ""), more.get(FOCAL_35MM, ""))
    camera = "/".join(str(part).strip("\0 ") for part in (*lens, *upright.size))
    height = min(JUDGED_HEIGHT, grey.height)
    width = max(1, round(grey.width * height / grey.height))
    sharp = sharpness(np.asarray(grey.resize((width, height), Image.Resampling.BOX)))
    thumbnail = np.asarray(grey.resize(THUMBNAIL, Image.Resampling.BOX)).ravel()
    return CapturedPhotograph(
        path, name, upright.size, camera, turned, sharp, thumbnail, _location(gps), few, deep
    )


def _upright(image: Image.Image) -> Image.Image:
    """The picture turned as its orientation says, of whatever type the tag is."""
    exif = image.getexif()
    told = orientation_of(exif)
    if told == 1:
        exif.pop(ORIENTATION, None)
        return image
    exif[ORIENTATION] = told
    return ImageOps.exif_transpose(image)


def sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian of an (H, W) uint8 picture: low where it is blurred."""
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
    middle = float(np.median([item.sharpness for item in found]))
    blurred = [item.name for item in found if item.sharpness < BLURRED * middle]
    turned = sum(item.turned for item in found)
    sizes = sorted({item.size for item in found})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes)
    met = (
        (bool(blurred), "warning", f"{len(blurred)} of {len(found)} pictures are blurred beside "
         f"the others ({named(blurred)}); they are tried all the same"),
        (middle < SOFT, "warning", f"most of the {len(found)} pictures have hardly any edges: "
         "blurred, dark, or of bare walls"),
        (turned > 0, "info", f"{turned} pictures were stored on their side: turned upright"),
        (len(sizes) > 1, "info", f"pictures of {len(sizes)} sizes ({shown}): one camera each"),
    )  # fmt: skip
    return [Finding(level, text) for there, level, text in met if there]


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
            upright = _upright(image)
            options = {"quality": JPEG_QUALITY} if form in ("JPEG", "MPO", "WEBP") else {}
            # exif_transpose has taken the orientation out; focal length and camera stay.
            upright.save(
                target, format="JPEG" if form == "MPO" else form, exif=upright.getexif(), **options
            )


def complete_masks(
    photographs: Sequence[CapturedPhotograph], masks: Path, *, out: Path
) -> list[Finding]:
    """Write a mask for every picture: COLMAP finds nothing in a picture without one.

    ``masks`` holds ``a.jpg.png`` for ``a.jpg``, black where nothing is to be matched; pictures
    without a mask are used whole.
    """
    listed = [masks / f"{item.name}.png" for item in photographs]
    where = [f"--masks {masks}"] * len(listed)
    files, findings = find_renamed(masks, listed, where=where, noun="masks")
    absent = [item.name for item, file in zip(photographs, files, strict=True) if not is_file(file)]
    if len(absent) == len(photographs):
        raise ProjectError(
            f"--masks {masks}: holds no mask of the {len(photographs)} pictures; expected "
            f"{absent[0]}.png for {absent[0]}"
        )
    for item, file in zip(photographs, files, strict=True):
        mask = Image.new("L", item.size, 255)
        if is_file(file):
            mask = Image.fromarray(read_mask(file))
            if mask.size != item.size and same_aspect(mask.size, item.size):
                mask = Image.fromarray(resize_nearest(np.asarray(mask), *item.size))
            if mask.size != item.size:
                raise ProjectError(
                    f"{file}: {mask.width}x{mask.height} pixels; expected those of the upright "
                    f"picture, {item.size[0]}x{item.size[1]}"
                )
        target = out / f"{item.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        mask.convert("L").save(target)
    text = (
        f"{len(absent)} of {len(photographs)} pictures have no mask ({named(absent)}): used whole"
    )
    return [*findings, Finding("warning", text)] if absent else findings
