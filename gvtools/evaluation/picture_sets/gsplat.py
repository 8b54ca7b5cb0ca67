"""gsplat's pictures: ``RESULT/renders/val_stepSTEP_NNNN.png`` of its example trainers.

A picture holds the truth on the left and the render on the right; colours are cut, not rounded, to
8 bits. NNNN counts the validation views in alphabetical order of their names (examples/
simple_trainer.py, Runner.eval; examples/datasets/colmap.py, Parser). Of several steps the last one
is taken.
"""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

from gvtools.evaluation.picture_sets.nerfstudio import canvas_picture
from gvtools.evaluation.picture_sets.pictures import PictureSet, in_natural_order

_RENDER = re.compile(r"(val|compress)_step(\d+)_(\d{4,})\.png")


def renders(path: Path) -> PictureSet | None:
    """The validation pictures of a run; None where the folder holds none.

    Args:
        path: the run's folder, or its folder ``renders``.
    """
    folder = path / "renders" if (path / "renders").is_dir() else path
    found: dict[tuple[str, int], list[Path]] = defaultdict(list)
    for file in folder.iterdir():
        if match := _RENDER.fullmatch(file.name):
            found[match[1], int(match[2])].append(file)
    if not found:
        return None
    # What the trainer's last evaluation gave; pictures of the compressed model only by themselves.
    stage, step = max(found, key=lambda key: (key[0] == "val", key[1]))
    notes = ["renders are the right halves of the pictures"]
    others = sorted(
        f"{name}_step{number}" for name, number in found if (name, number) != (stage, step)
    )
    if others:
        notes.append(f"{stage}_step{step} taken; also there: {', '.join(others)}")
    files = in_natural_order(found[stage, step], folder)
    return PictureSet(
        path,
        "gsplat",
        tuple(canvas_picture(file, folder) for file in files),
        alphabetical=True,
        notes=tuple(notes),
    )
