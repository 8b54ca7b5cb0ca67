"""Pictures of one method: each by its name, loaded when it is needed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import ProjectError
from gvtools.evaluation.picture_matching import IMAGE_ENDINGS
from gvtools.scenes.scene import Frame, natural_key
from gvtools.untrusted import open_picture

if TYPE_CHECKING:
    from PIL.Image import Image


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture.

    Attributes:
        name: by which it is matched: its path below the folder of the pictures.
        load: reads its pixels, and its depth where the method left any; raises ProjectError.
        load_truth: (H, W, 3) uint8, what the method's tool took for the truth, by which the order
            is checked; None where the tool keeps none.
    """

    name: str
    load: Callable[[], Frame]
    load_truth: Callable[[], NDArray[np.uint8]] | None = None


@dataclass(frozen=True, eq=False)
class PictureSet:
    """The pictures of one method.

    Attributes:
        path: what was given.
        layout: whose layout it has.
        pictures: in natural order of their names.
        alphabetical: whether numbers in the names count the views in alphabetical order of their
            names instead of natural order.
        notes: what was chosen or left out on reading.
    """

    path: Path
    layout: str
    pictures: tuple[Picture, ...]
    alphabetical: bool = False
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Of the pictures."""
        return tuple(picture.name for picture in self.pictures)


def image_files(folder: Path) -> list[Path]:
    """The pictures in a folder and below it, in natural order; hidden ones are left out."""
    found = [
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in IMAGE_ENDINGS
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
        and path.is_file()
    ]
    return in_natural_order(found, folder)


def in_natural_order(paths: Iterable[Path], folder: Path) -> list[Path]:
    """Paths in the natural order of what they are called below the folder."""
    return sorted(paths, key=lambda path: natural_key(path.relative_to(folder).as_posix()))


def plain_picture(path: Path, folder: Path) -> Picture:
    """A picture that is a file of its own, named by its path below ``folder``."""
    return Picture(path.relative_to(folder).as_posix(), lambda: Frame(read_rgb(path)))


def read_rgb(source: Path | IO[bytes], *, name: str = "") -> NDArray[np.uint8]:
    """(H, W, 3) uint8; what is transparent lies before black. EXIF orientation is not applied.

    Args:
        source: a file, or its bytes.
        name: of messages, for bytes.
    """
    from gvtools.scenes.images import UNREADABLE, read_header, read_image

    if isinstance(source, Path) and not read_header(source).has_alpha:
        return read_image(source).rgb
    try:
        with open_picture(source if isinstance(source, Path) else source.read()) as image:
            return _on_black(image)
    except UNREADABLE as error:
        raise ProjectError(
            f"{name or source}: no readable picture ({error}); expected PNG or JPEG"
        ) from None


def _on_black(image: Image) -> NDArray[np.uint8]:
    rgba: NDArray[Any] = np.asarray(image.convert("RGBA")).astype(np.float64)
    return np.rint(rgba[..., :3] * (rgba[..., 3:] / 255)).astype(np.uint8)


def right_half(canvas: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """The right one of two pictures of one size side by side."""
    return _half(canvas, name)[1]


def left_half(canvas: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """The left one of two pictures of one size side by side."""
    return _half(canvas, name)[0]


def _half(canvas: NDArray[np.uint8], name: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    width = canvas.shape[1]
    if width % 2:
        raise ProjectError(
            f"{name}: {width} pixels wide; expected truth and render of one width side by side"
        )
    return (
        np.ascontiguousarray(canvas[:, : width // 2]),
        np.ascontiguousarray(canvas[:, width // 2 :]),
    )
