"""Contact sheets of a judgement: truth, each method, and how far each is off."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.files import replaced_when_written
from viz.report.judge_sheet import JudgedView, sheet

if TYPE_CHECKING:
    from pipelines.evaluation.measured_target import MeasuredTarget
    from pipelines.judging.methods import Method

VIEWS_A_SHEET = 4


class SheetPictures:
    """The pictures that sheets show, kept while the methods come one by one.

    Args:
        targets: all of them.
        most: views to show, spread evenly over them.
    """

    def __init__(self, targets: Sequence[MeasuredTarget], most: int) -> None:
        rows = np.linspace(0, len(targets) - 1, min(most, len(targets))).round().astype(int)
        self._targets = [targets[row] for row in np.unique(rows)]
        self._methods: dict[str, dict[tuple[str, int], NDArray[np.uint8]]] = {}

    def add(self, method: Method) -> None:
        """Keep a method's pictures of the shown views."""
        shown = {(target.picture.name, target.number) for target in self._targets}
        self._methods[method.name] = {
            (target.picture.name, target.number): target.picture.rgb
            for target in method.targets
            if (target.picture.name, target.number) in shown
        }

    def views(self) -> list[JudgedView]:
        """The shown views, each with the methods' pictures."""
        return [
            JudgedView(
                name=target.picture.name,
                truth=None if target.truth is None else target.truth.rgb,
                mask=None if target.truth is None else target.truth.mask,
                never_observed=~target.observed,
                pictures={
                    name: kept.get((target.picture.name, target.number))
                    for name, kept in self._methods.items()
                },
            )
            for target in self._targets
        ]


def write_sheets(pictures: SheetPictures, out: Path) -> list[Path]:
    """Write ``sheet_NNN.png``, some views on each; returns the files."""
    from PIL import Image

    views, files = pictures.views(), []
    for number, first in enumerate(range(0, len(views), VIEWS_A_SHEET)):
        path = out / f"sheet_{number:03d}.png"
        with replaced_when_written(path) as temporary:
            Image.fromarray(sheet(views[first : first + VIEWS_A_SHEET])).save(
                temporary, format="PNG"
            )
        files.append(path)
    return files
