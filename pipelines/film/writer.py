"""Frames to a file: H.264 in MP4 through PyAV, or an animated GIF or WebP through Pillow."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.files import replaced_when_written
from gvtools.optional import require

SUFFIXES = (".mp4", ".gif", ".webp")
# x264's constant rate factor: 18 is visually almost lossless, 23 is its default.
QUALITY = 18
WEBP_QUALITY = 80


def check_suffix(path: Path) -> None:
    """Refuse a file name that no film can be written to, before anything is drawn."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise OptionError(f"--out {path}: expected a name that ends with {', '.join(SUFFIXES)}")
    if suffix == ".mp4":
        purpose, instead = f"--out {path}: MP4", "or write a .gif or .webp"
        require("av", extra="film", purpose=purpose, instead=instead)


def write_film(path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: float) -> None:
    """Write a film; the file appears when it is whole.

    Args:
        path: with one of SUFFIXES.
        frames: (H, W, 3) pictures, all of one even size.
        fps: frames a second.
    """
    with replaced_when_written(path) as temporary:
        if path.suffix.lower() == ".mp4":
            _write_mp4(temporary, frames, fps=fps)
        else:
            _write_animation(temporary, frames, form=path.suffix[1:].upper(), fps=fps)


def _write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: float) -> None:
    import av

    rate = Fraction(fps).limit_denominator(1001)
    # "faststart" moves the index to the front, so that browsers play it while it loads.
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": str(QUALITY)})
        # The pixel format that every player can decode.
        stream.pix_fmt = "yuv420p"
        for number, frame in enumerate(frames):
            if number == 0:
                stream.height, stream.width = frame.shape[:2]
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def _write_animation(
    path: Path, frames: Iterable[NDArray[np.uint8]], *, form: str, fps: float
) -> None:
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    options = {"quality": WEBP_QUALITY} if form == "WEBP" else {}
    with path.open("wb") as file:
        images[0].save(
            file, format=form, save_all=True, append_images=images[1:],
            duration=max(1, round(1000 / fps)), loop=0, **options,
        )  # fmt: skip
