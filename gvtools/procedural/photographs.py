"""The photographs that textures are cut from: files that installed wheels hold, no download.

scikit-image, which the project needs, brings most; scikit-learn's two are used where that optional
wheel is installed. The two splits share no photograph. The stereo pair that scikit-image ships is
in neither, since a sample of the project is made of it.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.optional import installed, package_folder

SPLITS = ("train", "held-out")

# Names in skimage.data, and of scikit-learn's sample images ("sklearn:").
PHOTOGRAPHS = {
    "train": (
        "astronaut",
        "brick",
        "camera",
        "cell",
        "chelsea",
        "coins",
        "gravel",
        "hubble_deep_field",
        "immunohistochemistry",
        "page",
        "retina",
        "rocket",
        "sklearn:china",
    ),
    "held-out": ("clock", "coffee", "colorwheel", "grass", "moon", "text", "sklearn:flower"),
}
LONGEST = 512  # side that larger photographs are reduced to, pixels


def check_split(split: str) -> int:
    """The number of a split."""
    if split not in SPLITS:
        raise OptionError(f"split {split!r}; expected one of {', '.join(SPLITS)}")
    return SPLITS.index(split)


def photograph_names(split: str) -> tuple[str, ...]:
    """The photographs of a split that are installed."""
    check_split(split)
    learn = installed("sklearn")
    return tuple(name for name in PHOTOGRAPHS[split] if learn or not name.startswith("sklearn:"))


@cache
def photograph(name: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 sRGB, at most ``LONGEST`` pixels a side."""
    from PIL import Image

    if name.startswith("sklearn:"):
        package = package_folder("sklearn", extra="train", purpose=f"photograph {name!r}")
        file = package / "datasets" / "images" / f"{name[8:]}.jpg"
        image = Image.open(file).convert("RGB")
    else:
        import skimage.data

        image = Image.fromarray(np.asarray(getattr(skimage.data, name)())).convert("RGB")
    if max(image.size) > LONGEST:
        image.thumbnail((LONGEST, LONGEST), Image.Resampling.LANCZOS)
    return np.asarray(image)
