"""Masks of photographs, as COLMAP wants them: one for each picture, of its size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from gvtools.capture.photographs import CapturedPhotograph
from gvtools.errors import ProjectError
from gvtools.scenes.images import read_mask
from gvtools.scenes.matching import named
from gvtools.scenes.scene import Finding


def complete_masks(
    photographs: Sequence[CapturedPhotograph], masks: Path, *, out: Path
) -> list[Finding]:
    """Write a mask for every picture: COLMAP finds nothing in a picture without one.

    Args:
        masks: folder of ``a.jpg.png`` for ``a.jpg``, black where nothing is to be matched.

    Returns:
        What was met: pictures without a mask are used whole.
    """
    absent = [item.name for item in photographs if not (masks / f"{item.name}.png").is_file()]
    if len(absent) == len(photographs):
        raise ProjectError(
            f"--masks {masks}: holds no mask of the {len(photographs)} pictures; expected "
            f"{absent[0]}.png for {absent[0]}"
        )
    for item in photographs:
        mask = Image.new("L", item.size, 255)
        file = masks / f"{item.name}.png"
        if file.is_file():
            mask = Image.fromarray(read_mask(file))
            if mask.size != item.size:
                raise ProjectError(
                    f"{file}: {mask.width}x{mask.height} pixels; expected those of the upright "
                    f"picture, {item.size[0]}x{item.size[1]}"
                )
        target = out / f"{item.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        mask.convert("L").save(target)
    if not absent:
        return []
    return [
        Finding(
            "warning",
            f"{len(absent)} of {len(photographs)} pictures have no mask ({named(absent)}): "
            "used whole",
        )
    ]
