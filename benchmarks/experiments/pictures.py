"""Context, hint, completion and truth side by side, one PNG a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.experiments.cases import Case
from gvtools.completers.base import Completer
from gvtools.training.sheets import write_png

# Scenes that pictures are written of.
SHOWN = 12
GAP = 4


def write_pictures(
    folder: Path, cases: Sequence[Case], completer: Completer, *, seed: int = 0
) -> None:
    """Four bands a scene, a column a view: context, projection, completion, truth.

    Args:
        folder: made if absent.
        cases: the first ``SHOWN`` are shown.
        completer: makes the completion.
        seed: of the completer.
    """
    for number, case in enumerate(cases[:SHOWN]):
        made = completer.complete(case.context, case.guidance, seed=seed)
        size = case.rgb.shape[1:3]
        context = [view.rgb for view in case.context if view.rgb.shape[:2] == size]
        bands = [
            _band(list(pictures), len(case.rgb))
            for pictures in (context[: len(case.rgb)], case.guidance.rgb, made.rgb, case.rgb)
        ]
        write_png(folder / f"scene_{number:03d}.png", np.concatenate(bands))


def _band(pictures: list[np.ndarray], columns: int) -> np.ndarray:
    """Pictures in [0, 1] side by side, white where there are fewer."""
    height, width = pictures[0].shape[:2] if pictures else (1, 1)
    white = np.ones((height, width, 3))
    tiles = [*pictures, *[white] * (columns - len(pictures))]
    padded = np.pad(np.stack(tiles), ((0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=1)
    joined = np.concatenate(list(padded), axis=1)
    return np.rint(np.clip(joined, 0, 1) * 255).astype(np.uint8)
