"""One view as the files of a WebDataset sample, and back.

A sample is ``KEY.jpg`` or ``KEY.png`` with the picture, ``KEY.depth.png`` or ``KEY.depth.npz`` with
its depth where it has any, ``KEY.mask.png`` where it has a mask, and ``KEY.json`` with its camera.
All but a picture that was compressed with a loss already comes back bit by bit.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gvtools.errors import ProjectError
from gvtools.scenes.images import DEPTH_SATURATED, UNREADABLE
from gvtools.scenes.scene import Frame, View
from gvtools.untrusted import load_arrays, open_picture

PICTURES = ("jpg", "png")
DEPTH_PNG, DEPTH_NPZ, MASK, CAMERA = "depth.png", "depth.npz", "mask.png", "json"
# Pictures from any other file are kept without a loss.
LOSSY = frozenset({".jpg", ".jpeg", ".webp", ".mp4", ".mov", ".avi", ".mkv", ".webm"})
JPEG = {"quality": 95, "subsampling": 0}
# Metres of a stored unit that depth of recordings has: millimetres, TUM RGB-D's.
UNITS = (0.001, 0.0002)


def encoded(
    view: View, frame: Frame, about: Mapping[str, Any]
) -> tuple[dict[str, bytes], float | None]:
    """A view's files by the end of their names, and scene units of a stored one of depth pictures.

    ``about`` is what else the camera's file tells.
    """
    lossy = any(path.suffix.lower() in LOSSY for path in view.files[:1])
    members = {"jpg" if lossy else "png": _picture(frame.rgb, lossy=lossy)}
    unit = None
    if frame.depth is not None:
        unit = exact_unit(frame.depth)
        if unit is None:
            members[DEPTH_NPZ] = _arrays(depth=frame.depth)
        else:
            stored = np.rint(frame.depth / np.float32(unit)).astype(np.uint16)
            members[DEPTH_PNG] = _png(Image.fromarray(stored))
    if frame.mask is not None:
        members[MASK] = _png(Image.fromarray(frame.mask))
    camera = {
        "name": view.name,
        "width": int(view.camera.width[0]),
        "height": int(view.camera.height[0]),
        "K": view.camera.K[0].tolist(),
        "cam_from_world": view.camera.cam_from_world[0].tolist(),
        "depth_unit": unit,
        **about,
    }
    members[CAMERA] = json.dumps(camera).encode()
    return members, unit


def decoded(members: Mapping[str, bytes], *, depth_unit: float | None, where: str) -> Frame:
    """The pixels of a view from its files, by the end of their names."""
    try:
        picture = next(members[name] for name in PICTURES if name in members)
        rgb = np.array(open_picture(picture).convert("RGB"))
        depth = mask = None
        if DEPTH_PNG in members:
            raw = np.asarray(open_picture(members[DEPTH_PNG]))
            depth = raw.astype(np.float32) * np.float32(depth_unit or 1.0)
        elif DEPTH_NPZ in members:
            depth = load_arrays(members[DEPTH_NPZ], "depth")["depth"]
        if MASK in members:
            mask = np.asarray(open_picture(members[MASK])).astype(bool)
    except (*UNREADABLE, StopIteration) as error:
        raise ProjectError(
            f"{where}: cannot be decoded ({error}); expected a view as gvtools data shards writes "
            "it; convert again"
        ) from None
    return Frame(rgb, depth, mask)


def exact_unit(depth: NDArray[np.float32]) -> float | None:
    """The unit in which 16-bit numbers are exactly these depths; None where there is none."""
    for unit in UNITS:
        stored = np.rint(depth / np.float32(unit))
        fits = (stored >= 0) & (stored < DEPTH_SATURATED)
        if fits.all() and np.array_equal(stored * np.float32(unit), depth):
            return unit
    return None


def _picture(rgb: NDArray[np.uint8], *, lossy: bool) -> bytes:
    if not lossy:
        return _png(Image.fromarray(rgb))
    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "JPEG", **JPEG)
    return file.getvalue()


def _png(image: Image.Image) -> bytes:
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def _arrays(**arrays: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    # Members of the archive carry the date 1980-01-01, so that equal depth is equal bytes.
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()
