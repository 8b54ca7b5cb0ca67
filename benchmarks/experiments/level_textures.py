"""The pictures of a level's surfaces in one array, with halved copies for distant surfaces."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.experiments.quake_levels import Archives

# Longest side that is kept, px; surfaces are seen in small pictures.
LONGEST = 256
ENDINGS = (".jpg", ".tga", ".png", ".jpeg")
# Of surfaces without a picture.
GREY = 128


class Textures:
    """Pictures by row, to be read at many places at once.

    Args:
        pictures: (H, W, 3) uint8 each.
    """

    def __init__(self, pictures: Sequence[NDArray[np.uint8]]) -> None:
        levels = [_halved(picture) for picture in pictures]
        self._last = np.array([len(each) - 1 for each in levels])
        most = int(self._last.max(initial=0)) + 1
        self.sizes = np.ones((len(levels), most, 2), np.int64)
        self._begins = np.zeros((len(levels), most), np.int64)
        total, flat = 0, []
        for row, each in enumerate(levels):
            for level, picture in enumerate(each):
                self.sizes[row, level] = picture.shape[1::-1]
                self._begins[row, level] = total
                flat.append(picture.reshape(-1, 3))
                total += len(flat[-1])
        self._texels = np.concatenate(flat) if flat else np.zeros((0, 3), np.uint8)

    def read(
        self, row: NDArray[np.int64], uv: NDArray[np.float32], texels: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """(N, 3) colours in [0, 1].

        Args:
            row: (N,) pictures.
            uv: (N, 2) places; 1 is a picture's width and height, beyond which it repeats.
            texels: (N,) texels of the whole picture that one ray stands for, along a side.
        """
        level = np.log2(np.maximum(texels, 1)).astype(np.int64)
        level = np.minimum(level, self._last[row])
        size = self.sizes[row, level]
        # Far-off coordinates are damaged; any texel does.
        place = np.floor(np.nan_to_num(uv % 1) * size).astype(np.int64)
        x, y = np.minimum(place, size - 1).T
        at = self._begins[row, level] + y * size[:, 0] + x
        return self._texels[at] / np.float32(255)


class Pictures:
    """Finds the pictures of surfaces in a level's archives; each is read once.

    Args:
        archives: with pictures, and scripts that name those of surfaces without one of their own.
    """

    def __init__(self, archives: Archives) -> None:
        self._archives = archives
        self._named: dict[str, str] = {}
        self._read: dict[str, NDArray[np.uint8]] = {}
        for name in archives.names(".shader"):
            self._named |= shown_pictures(archives.read(name).decode("latin1"))

    def of(self, materials: Sequence[str]) -> Textures:
        """The pictures of surfaces, in their order; grey where there is none."""
        return Textures([self._picture(name) for name in materials])

    def _picture(self, material: str) -> NDArray[np.uint8]:
        if material not in self._read:
            grey = np.full((1, 1, 3), GREY, np.uint8)
            names = [
                re.sub(r"\.(jpe?g|tga|png)$", "", name) + ending
                for name in (material, self._named.get(material, material))
                for ending in ENDINGS
            ]
            found = next((name for name in names if name in self._archives), None)
            self._read[material] = grey if found is None else _decoded(self._archives.read(found))
        return self._read[material]


def shown_pictures(script: str) -> dict[str, str]:
    """The picture of each surface of a script: what the editor shows, else its first layer's."""
    found: dict[str, str] = {}
    depth, name = 0, ""
    for line in script.lower().splitlines():
        words = line.split("//")[0].replace("{", " { ").replace("}", " } ").split()
        for position, word in enumerate(words):
            if word in "{}":
                depth += 1 if word == "{" else -1
            elif depth == 0:
                name = word
            elif word in ("map", "clampmap", "qer_editorimage") and position + 1 < len(words):
                picture = words[position + 1]
                if not picture.startswith("$") and (word[0] == "q" or name not in found):
                    found[name] = picture
    return found


def _decoded(data: bytes) -> NDArray[np.uint8]:
    with Image.open(io.BytesIO(data)) as image:
        picture = image.convert("RGB")
    share = LONGEST / max(picture.size)
    if share < 1:
        width, height = (max(1, round(share * side)) for side in picture.size)
        picture = picture.resize((width, height), Image.Resampling.BOX)
    return np.asarray(picture)


def _halved(picture: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """The picture, and copies of half the size down to one pixel."""
    levels = [picture]
    while max(levels[-1].shape[:2]) > 1:
        height, width = (max(1, side // 2) for side in levels[-1].shape[:2])
        image = Image.fromarray(levels[-1]).resize((width, height), Image.Resampling.BOX)
        levels.append(np.asarray(image))
    return levels
