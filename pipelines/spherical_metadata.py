"""Metadata by which players and viewers know an equirectangular picture or film.

Pictures carry Google's photo sphere schema (GPano) as XMP. Films carry the boxes of Spherical Video
V2 (``st3d``, ``sv3d``) and of V1 (a ``uuid`` box with XML), which other players read.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from gvtools.capture.photographs import JPEG_QUALITY

TOOL = "gvtools"
GPANO = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
    'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" GPano:UsePanoramaViewer="True" '
    'GPano:ProjectionType="equirectangular" GPano:StitchingSoftware="{tool}" '
    'GPano:PosePitchDegrees="0" GPano:PoseRollDegrees="0" '
    'GPano:FullPanoWidthPixels="{width}" GPano:FullPanoHeightPixels="{height}" '
    'GPano:CroppedAreaImageWidthPixels="{width}" GPano:CroppedAreaImageHeightPixels="{height}" '
    'GPano:CroppedAreaLeftPixels="0" GPano:CroppedAreaTopPixels="0"/></rdf:RDF></x:xmpmeta>'
)
V1_ID = UUID("ffcc8263-f855-4a93-8814-587a02521fdd").bytes
V1 = (
    '<?xml version="1.0"?><rdf:SphericalVideo '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
    "<GSpherical:Spherical>true</GSpherical:Spherical>"
    "<GSpherical:Stitched>true</GSpherical:Stitched>"
    f"<GSpherical:StitchingSoftware>{TOOL}</GSpherical:StitchingSoftware>"
    "<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType></rdf:SphericalVideo>"
)
# Boxes on the way to the offsets of the film's chunks, and to the description of its pictures.
CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
# Bytes of a description of pictures (VisualSampleEntry) before the boxes in it.
ENTRY = 78


def write_panorama(path: Path, picture: NDArray[np.uint8], *, form: str = "PNG") -> None:
    """Write a whole equirectangular picture (H, W, 3) as PNG or JPEG."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    xmp = GPANO.format(tool=TOOL, width=picture.shape[1], height=picture.shape[0])
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", xmp)
    options = {"pnginfo": text, "compress_level": 1} if form == "PNG" else {
        "xmp": xmp.encode(), "quality": JPEG_QUALITY, "subsampling": 0,
    }  # fmt: skip
    Image.fromarray(picture).save(path, format=form, **options)


def mark_mp4(path: Path) -> None:
    """Say in an MP4 film of one track that it is equirectangular, in place."""
    boxes = list(_boxes(path.read_bytes()))
    kinds = [kind for kind, _ in boxes]
    # Where the index comes first, all chunks move by what it grows.
    grows = len(_described(b"")) + len(_box(b"uuid", V1_ID, V1.encode()))
    moved = grows if kinds.index(b"moov") < kinds.index(b"mdat") else 0
    with path.open("wb") as file:
        for kind, body in boxes:
            file.write(_box(kind, _marked(kind, body, moved)))


def _described(entry: bytes) -> bytes:
    """The boxes in a description of pictures, with V2's after the decoder's configuration."""
    full = bytes(4)
    projection = _box(
        b"proj", _box(b"prhd", full, bytes(12)), _box(b"equi", full, bytes(16)),
    )  # fmt: skip
    spherical = _box(b"sv3d", _box(b"svhd", full, TOOL.encode() + b"\0"), projection)
    decoder = int.from_bytes(entry[:4], "big")
    return entry[:decoder] + _box(b"st3d", full, bytes(1)) + spherical + entry[decoder:]


def _marked(kind: bytes, body: bytes, moved: int) -> bytes:
    """The body of a box with the boxes of V1 and V2 in it, for chunks that are ``moved`` so far."""
    if kind in CONTAINERS:
        within = [_box(name, _marked(name, inner, moved)) for name, inner in _boxes(body)]
        if kind == b"trak":
            within.append(_box(b"uuid", V1_ID, V1.encode()))
        return b"".join(within)
    if kind == b"stsd":
        ((name, entry),) = _boxes(body[8:])
        return body[:8] + _box(name, entry[:ENTRY], _described(entry[ENTRY:]))
    if kind in (b"stco", b"co64"):
        number = ">u4" if kind == b"stco" else ">u8"
        offsets = np.frombuffer(body[8:], number) + np.uint64(moved)
        return body[:8] + offsets.astype(number).tobytes()
    return body


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and body of each box."""
    at = 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        head = 8
        if size == 1:
            (size,), head = struct.unpack_from(">Q", data, at + 8), 16
        yield kind, data[at + head : at + size]
        at += size


def _box(kind: bytes, *parts: bytes) -> bytes:
    size = 8 + sum(map(len, parts))
    if size < 1 << 32:
        return struct.pack(">I4s", size, kind) + b"".join(parts)
    return struct.pack(">I4sQ", 1, kind, size + 8) + b"".join(parts)
