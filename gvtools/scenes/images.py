"""Pictures, masks, depth maps and frames of videos, and what their headers say.

HDF5 and OpenEXR are read by packages that come with ``gvtools[data]``. EXIF orientation is never
applied: intrinsics and poses were solved on the pixels as stored, so a turned picture would no
longer fit its camera.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from gvtools.errors import ProjectError
from gvtools.files import replaced_when_written
from gvtools.optional import require
from gvtools.ranges import PICTURE_OUTLIERS, WHOLE, to_bytes, white_of
from gvtools.scenes.scene import Frame
from gvtools.untrusted import (
    DAMAGED,
    UNPACKED_BYTES,
    UNPACKED_RATIO,
    expect,
    load_array,
    load_arrays,
    open_picture,
    read_bytes,
    reading,
    regular,
)

if TYPE_CHECKING:
    import h5py

Depth = NDArray[np.float32]

DEPTH_SATURATED = 65535  # "no reading" of Kinect-like 16-bit depth, besides 0
# What a folder of pictures may hold.
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm")
# Pillow's layouts of pixels with an alpha channel.
WITH_ALPHA = ("RGBA", "LA", "PA", "RGBa", "La")
# Pictures that tell the range of a project's, of so many that are opened.
SAMPLED, LOOKED_AT = 8, 100
LOSSY = ("JPEG", "MPO", "JPEG2000")
# What becomes of it, and what findings say of that.
ALPHA = {"mask": "read as a mask", "ignore": "ignored", "white": "laid on white",
         "black": "laid on black"}  # fmt: skip
OPAQUE_FROM = 128  # an alpha at or above this counts as part of the picture

_EXIF_ORIENTATION = 0x0112
# COLMAP's dense depth maps: ``width&height&channels&``, then float32 row by row.
_COLMAP_HEAD = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")
UNREADABLE = (*DAMAGED, Image.DecompressionBombError)


@dataclass(frozen=True)
class ImageHeader:
    """What a picture's header says, without decoding its pixels."""

    width: int  # pixels, as stored
    height: int  # pixels, as stored
    mode: str  # Pillow's name of the pixel layout ("RGB", "L", "RGBA", "I;16", ...)
    orientation: int = 1  # EXIF orientation of a JPEG, 1 when absent
    has_alpha: bool = False  # whether pixels may be transparent, which is read as a mask


def read_header(path: Path) -> ImageHeader:
    """Size and layout of the picture at ``path``."""
    with _picture(path) as image:
        # Other formats are decoded whole when asked for EXIF.
        exif = image.getexif() if image.format in ("JPEG", "MPO") else {}
        turned = orientation_of(exif)
        return ImageHeader(image.width, image.height, image.mode, turned, _has_alpha(image))


def orientation_of(exif: Mapping[int, Any]) -> int:
    """From 1 to 8, whatever type a program gave the tag; 1 where it says nothing."""
    told = exif.get(_EXIF_ORIENTATION)
    told = told[0] if isinstance(told, tuple | bytes) and told else told
    told = str(told).strip("\0 ").removesuffix(".0")  # rationals and floats, too
    return int(told) if told in list("12345678") else 1


def read_image(path: Path, *, white: float = 65535, alpha: str = "mask") -> Frame:
    """The picture at ``path`` as 8-bit RGB, with its alpha channel as ``ALPHA`` says, a mask.

    Grey is repeated over the channels, palettes are resolved, 16 bits a channel become eight, of
    which full brightness is ``white``. EXIF orientation is not applied (see the module's text).
    """
    with _picture(path) as image:
        if white != 65535 and _is_deep(image):
            levels = to_bytes(_levels(path, image), white)
            if levels.ndim == 3 and levels.shape[2] == 4:
                return _without_alpha(levels, alpha)
            rgb = levels if levels.ndim == 3 else np.repeat(levels[..., None], 3, axis=-1)
            return Frame(rgb)
        return _decode(image, path, alpha=alpha)


def _without_alpha(rgba: NDArray[np.uint8], alpha: str) -> Frame:
    """(H, W, 4) as a picture: opaque pixels alone, all as stored, or laid on white or black."""
    rgb = np.ascontiguousarray(rgba[..., :3])
    if alpha in ("white", "black"):
        share = rgba[..., 3:].astype(np.float32) / 255
        rgb = np.rint(rgb * share + (255 if alpha == "white" else 0) * (1 - share)).astype(np.uint8)
    mask = rgba[..., 3] >= OPAQUE_FROM
    return Frame(rgb, mask=None if alpha != "mask" or mask.all() else mask)


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in WITH_ALPHA or "transparency" in image.info


def _is_deep(image: Image.Image) -> bool:
    """Whether a picture has 16 bits a channel, of which Pillow's layout keeps eight in colour."""
    tile: Any = getattr(image, "tile", None)
    wide = bool(tile) and tile[0][0] == "ppm" and tile[0][3][1] > WHOLE[0]
    return image.mode.startswith("I;16") or ";16" in str(tile) or wide


def _levels(path: Path, image: Image.Image) -> NDArray[np.uint16]:
    """(H, W) or (H, W, 3 or 4) of a picture with 16 bits a channel."""
    if image.mode.startswith("I;16"):
        return np.asarray(image, np.uint16)
    import cv2

    found = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if found is None or found.dtype != np.uint16:
        raise ProjectError(f"{path}: 16 bits a channel cannot be read; save it as 16-bit PNG")
    order = [2, 1, 0, 3][: found.shape[2]] if found.ndim == 3 else ...
    return np.asarray(found[..., order], np.uint16)


def white_of_pictures(paths: Sequence[Path]) -> float:
    """Full brightness of a project's pictures of 16 bits a channel, from a few of them."""
    seen = list[NDArray[np.uint16]]()
    for path in paths[:: -(-len(paths) // LOOKED_AT) or 1]:
        if len(seen) == SAMPLED:
            break
        try:
            with _picture(path) as image:
                if not _is_deep(image):  # others may be
                    continue
                levels = _levels(path, image)
        except ProjectError:
            continue
        levels = levels[..., :3] if levels.ndim == 3 else levels
        seen.append(levels[:: -(-levels.shape[0] // 512), :: -(-levels.shape[1] // 512)].ravel())
    if not seen:
        return WHOLE[-1]
    return white_of(np.concatenate(seen), tops=WHOLE, outliers=PICTURE_OUTLIERS)


def decode_picture(data: bytes, *, where: str) -> Frame:
    """The picture that an encoded file in another file is, as ``read_image`` has it."""
    with _picture(data, where) as image:
        return _decode(image, where)


@contextmanager
def _picture(source: Path | bytes, where: str = "") -> Iterator[Image.Image]:
    place = where or str(source)
    with reading(place, also=(Image.DecompressionBombError,)), open_picture(source) as image:
        yield image


def _decode(image: Image.Image, path: Path | str, *, alpha: str = "mask") -> Frame:
    if image.mode in ("I", "F"):
        raise ProjectError(
            f"{path}: the picture holds 32-bit values ({image.mode}); "
            "expected 8 or 16 bits a channel; save it as PNG or JPEG"
        )
    if image.mode.startswith("I;16"):
        grey = (np.asarray(image) >> 8).astype(np.uint8)
        return Frame(np.repeat(grey[..., None], 3, axis=-1))
    if _has_alpha(image):
        return _without_alpha(np.array(image.convert("RGBA")), alpha)
    return Frame(np.array(image.convert("RGB")))


def read_mask(path: Path) -> NDArray[np.bool_]:
    """(H, W) bool mask at ``path``: black or transparent is ignored, False, all else used."""
    with _picture(path) as image:
        # Where black is stored with loss, it is not quite black.
        least = OPAQUE_FROM if image.format in LOSSY else 1
        used = np.asarray(image if image.mode.startswith("I") else image.convert("L")) >= least
        if not _has_alpha(image):
            return used
        opaque = np.asarray(image.convert("RGBA"))[..., 3] >= OPAQUE_FROM
    if opaque.all():
        return used
    return opaque if used.all() or not used.any() else used & opaque


def read_depth(
    path: Path, *, unit: float = 1.0, maximum: float | None = None
) -> NDArray[np.float32]:
    """(H, W) float32 z-depth, scene units, of a depth map whose stored unit is ``unit``.

    It is a 16-bit PNG, PGM or TIFF, float TIFF, PFM or OpenEXR, ``.npy``, ``.npz`` with the key
    ``depth``, or COLMAP's ``.bin``. 0 stands where the file says 0, a negative number, NaN,
    infinity, more than ``maximum``, or, in 16-bit files, 65535.
    """
    raw = _load_depth(path)
    return readings(_one_map(raw, str(path)), unit=unit, maximum=maximum)


def _one_map(raw: NDArray[Any], where: str) -> NDArray[Any]:
    """(H, W) numbers of an array that may have a further axis of length 1."""
    if raw.ndim == 3 and 1 in (raw.shape[0], raw.shape[2]):
        raw = raw[..., 0] if raw.shape[2] == 1 else raw[0]
    if raw.ndim != 2 or raw.dtype.kind not in "uif":
        raise ProjectError(
            f"{where}: depth of shape {raw.shape} and type {raw.dtype}; expected (height, width) "
            "numbers"
        )
    return raw


def readings(
    raw: NDArray[Any], *, unit: float = 1.0, maximum: float | None = None
) -> NDArray[np.float32]:
    """Stored depths as float32, scene units, 0 for what is no reading as ``read_depth`` says."""
    with np.errstate(all="ignore"):  # what overflows is no reading
        depth = raw.astype(np.float32) * np.float32(unit)
    valid = np.isfinite(depth) & (depth > 0)
    if raw.dtype.kind in "ui":
        valid &= raw != DEPTH_SATURATED
    if maximum is not None:
        valid &= depth <= maximum
    return np.where(valid, depth, np.float32(0))


def _load_depth_image(path: Path) -> NDArray[Any]:
    with _picture(path) as image:
        _check_deep(path, image.mode)
        return np.asarray(image)


def _check_deep(path: Path, mode: str) -> None:
    if not mode.startswith("I") and mode != "F":
        raise ProjectError(
            f"{path}: a depth map with 8 bits a channel ({mode}); expected 16-bit grey; export raw "
            "depth instead of a preview"
        )


def _load_array(path: Path) -> NDArray[Any]:
    with reading(path, "expected one array, in an archive with the key 'depth'; copy it again"):
        with regular(path).open("rb") as file:
            packed = file.read(2) == b"PK"
        return load_arrays(path, "depth")["depth"] if packed else load_array(path)


def holds_fractions(path: Path) -> bool:
    """Whether a depth map's numbers are no whole ones, which are metres in most files."""
    return path.suffix.lower() != ".png" and _load_depth(path).dtype.kind == "f"


def _load_depth(path: Path) -> NDArray[Any]:
    return DEPTH_LOADERS.get(path.suffix.lower(), _load_depth_image)(path)


def stored_depth_size(path: Path) -> tuple[int, int] | None:
    """Width and height of a depth map, without its pixels; None for arrays."""
    if path.suffix.lower() == ".bin":
        return _colmap_head(path)[:2]
    if path.suffix.lower() in DEPTH_LOADERS:
        return None
    header = read_header(path)
    _check_deep(path, header.mode)
    return header.width, header.height


def _colmap_head(path: Path) -> tuple[int, int, int]:
    """Width, height and where the values begin of COLMAP's depth map, which has to be whole."""
    with reading(path, "expected 'width&height&1&' and so many floats; compute or copy it again"):
        with regular(path).open("rb") as file:
            head = _COLMAP_HEAD.match(file.read(64))
        if head is None:
            raise ValueError("no COLMAP depth map")
        width, height, channels = (int(group) for group in head.groups())
        size, expected = path.stat().st_size, head.end() + 4 * width * height * channels
        told = f"{width}x{height}x{channels} in {size} bytes, not {expected}"
        expect(channels == 1 and size == expected, told)
        return width, height, head.end()


def _load_colmap(path: Path) -> NDArray[np.float32]:
    width, height, start = _colmap_head(path)
    return np.fromfile(regular(path), "<f4", offset=start).reshape(height, width)


def write_depth_map(path: Path, depth: ArrayLike) -> None:
    """Write (H, W) z-depth, scene units, 0 = none, in COLMAP's form."""
    values = np.asarray(depth, "<f4")
    head = f"{values.shape[1]}&{values.shape[0]}&1&".encode()
    with replaced_when_written(path) as temporary:
        temporary.write_bytes(head + values.tobytes())


def resize_nearest(array: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """(h, w, ...) resampled to (height, width, ...), each pixel taking the one it falls into."""
    row = ((np.arange(height) + 0.5) * (array.shape[0] / height)).astype(np.int64)
    column = ((np.arange(width) + 0.5) * (array.shape[1] / width)).astype(np.int64)
    return array[row[:, None], column[None, :]]


def same_aspect(size: tuple[int, int], expected: tuple[int, int]) -> bool:
    """Whether ``size`` is ``expected`` (both width, height) scaled and rounded to whole pixels."""
    (w, h), (width, height) = size, expected
    if min(w, h, width, height) < 1:
        return False
    return abs(h - height * w / width) <= 1 and abs(w - width * h / height) <= max(1, width / w)


def fit_depth(
    depth: NDArray[np.float32], width: int, height: int, *, path: Path
) -> NDArray[np.float32]:
    """Depth brought to its picture's size: as it is, or by nearest pixel at the same aspect."""
    size = (depth.shape[1], depth.shape[0])
    if size == (width, height):
        return depth
    if not same_aspect(size, (width, height)):
        raise ProjectError(
            f"{path}: a depth map of {size[0]}x{size[1]} for a picture of {width}x{height}; "
            "expected the same size or the same aspect; give the depth camera's intrinsics, "
            "or export depth at the picture's size"
        )
    return resize_nearest(depth, width, height)


def check_size(
    found: tuple[int, int], expected: tuple[int, int], *, path: Path, orientation: int = 1
) -> None:
    """Refuse a picture or mask whose (width, height) is not its camera's."""
    if found == expected:
        return
    advice = "give the images that the cameras were solved on"
    if found == expected[::-1] and orientation >= 5:
        advice = "the file is turned by EXIF orientation, which is not applied; store it turned"
    raise ProjectError(
        f"{path}: {found[0]}x{found[1]} pixels; its camera expects {expected[0]}x{expected[1]}; "
        f"{advice}"
    )


# --- frames of videos, through PyAV ----------------------------------------------------------


@dataclass(frozen=True)
class VideoHeader:
    """Size and length of a video."""

    size: tuple[int, int]  # width and height, pixels
    seconds: float  # infinity where the file does not say
    frame_seconds: float  # from one frame to the next, on average


def video_header(path: Path) -> VideoHeader:
    """Size and length of a video; nothing is decoded."""
    with _video(path) as container:
        stream = container.streams.video[0]
        seconds = np.inf
        if stream.duration is not None:
            seconds = float(stream.duration * stream.time_base)
        elif container.duration is not None:
            seconds = container.duration / 1e6
        rate = stream.average_rate or stream.guessed_rate or 30
        if min(stream.width, stream.height) < 1:
            raise ProjectError(f"{path}: pictures of no size; expected a video; copy it again")
        return VideoHeader((stream.width, stream.height), seconds, float(1 / rate))


def frame_seconds(path: Path, *, edits: bool = True) -> NDArray[np.float64]:
    """(N,) seconds of all frames in order; with ``edits``, without those of the edit list."""
    with _video_reading(path), _video(path, edits=edits) as container:
        stream = container.streams.video[0]
        ticks = sorted(
            packet.pts
            for packet in container.demux(stream)
            if packet.pts is not None and not packet.is_discard
        )
        begin = stream.start_time or 0
        return (np.array(ticks, np.float64) - begin) * float(stream.time_base)


def read_frame(path: Path, *, seconds: float, edits: bool = True) -> Frame:
    """The frame whose time stamp is nearest, in seconds from the video's beginning."""
    best, best_off = None, np.inf
    with _video_reading(path, f" at {seconds:.3f} s"), _video(path, edits=edits) as container:
        stream = container.streams.video[0]
        begin = (stream.start_time or 0) * stream.time_base
        target = round((seconds + float(begin)) / float(stream.time_base))
        container.seek(max(target, 0), stream=stream, backward=True)
        for frame in container.decode(stream):
            if frame.pts is None:
                continue
            off = abs(frame.pts - target)
            if off >= best_off:
                break
            best, best_off = frame, off
        else:
            # The last frame stands for its own time alone, or a copy that was cut off would give
            # it for all that is missing.
            rate = stream.average_rate or stream.guessed_rate or 30
            if best is not None and best_off * stream.time_base > 0.75 / float(rate):
                best = None
        if best is None:
            raise ValueError("no frame")
        return Frame(np.ascontiguousarray(best.to_ndarray(format="rgb24")))


def _video(path: Path, *, edits: bool = True) -> Any:
    with _video_reading(path):
        # Text of the file's own, which may be no UTF-8, is not looked at.
        container = _av().open(
            str(regular(path)),
            options={} if edits else {"ignore_editlist": "1"},
            metadata_errors="replace",
        )
    streams = container.streams.video
    if not streams or streams[0].codec_context is None:
        container.close()
        what = "whose codec is not known" if streams else "without video stream"
        raise ProjectError(f"{path}: a file {what}; expected a video")
    return container


def _video_reading(path: Path, place: str = "") -> AbstractContextManager[None]:
    errors = (_av().error.FFmpegError,)
    return reading(f"{path}{place}", "expected a whole video; copy it again", also=errors)


def _av() -> Any:
    return require(
        "av", extra="data", purpose="reading a video", instead="or give frames as pictures"
    )


# --- HDF5, OpenEXR, PFM ---------------------------------------------------------------------


@contextmanager
def hdf5_file(path: Path) -> Iterator[h5py.File]:
    """The HDF5 file at ``path``, open for reading."""
    h5py = require("h5py", extra="data", purpose=f"{path}: HDF5")
    with reading(path), h5py.File(regular(path), "r") as file:
        yield file


def read_dataset(path: Path, found: Any) -> NDArray[Any]:
    """A data set of h5py, of the HDF5 file at ``path``."""
    size = path.stat().st_size
    if getattr(found, "nbytes", np.inf) > UNPACKED_RATIO * size + UNPACKED_BYTES:
        raise ValueError(f"{found!r} in {size} bytes; expected an array that they can hold")
    return np.asarray(found[()])


def hdf5_array(path: Path, key: str) -> NDArray[Any]:
    """The array of that name in an HDF5 file."""
    with hdf5_file(path) as file:
        if key not in file:
            raise KeyError(f"holds {', '.join(list(file)[:5]) or 'nothing'}; expected {key!r}")
        return read_dataset(path, file[key])


def hdf5_depth(path: Path, *, key: str) -> Depth:
    """(H, W) float32 z-depth in an array of an HDF5 file, 0 for none."""
    return readings(_one_map(hdf5_array(path, key), f"{path}, {key}"))


def exr_depth(path: Path, *, channels: tuple[str, ...]) -> Depth:
    """(H, W) float32 z-depth of an OpenEXR file: the first of the channels that is there."""
    OpenEXR = require("OpenEXR", extra="data", purpose=f"{path}: EXR")
    # Else R, G and B come as one array.
    with reading(path), OpenEXR.File(str(regular(path)), separate_channels=True) as file:
        found = dict(file.channels())
        name = next((name for name in channels if name in found), None)
        if name is None:
            raise ValueError(
                f"holds the channels {', '.join(sorted(found))}; expected {' or '.join(channels)}"
            )
        return readings(np.array(found[name].pixels, np.float32))


def read_pfm_depth(path: Path, *, unit: float = 1.0) -> Depth:
    """(H, W) float32 z-depth of a grey PFM file, whose rows run from the bottom up; 0 for none."""
    with reading(path, "expected a grey PFM; copy or export it again"):
        with regular(path).open("rb") as file:
            kind = file.readline().split()
            width, height = (int(word) for word in file.readline().split())
            dtype = np.dtype("<f4" if float(file.readline()) < 0 else ">f4")
            expect(kind == [b"Pf"], f"it begins with {kind}, not with Pf")
            values = np.frombuffer(file.read(width * height * 4), dtype).reshape(height, width)
        return readings(values[::-1], unit=unit)


# Of depth maps that are no pictures.
DEPTH_LOADERS: Mapping[str, Callable[[Path], NDArray[Any]]] = {
    ".npy": _load_array,
    ".npz": _load_array,
    ".bin": _load_colmap,
    ".pfm": read_pfm_depth,
    ".exr": partial(exr_depth, channels=("Y", "Z", "R", "V")),
}
DEPTH_SUFFIXES = (".png", ".pgm", ".tif", ".tiff", *DEPTH_LOADERS)
