"""A completer of your own: fill every unknown pixel from the nearest known one.

python examples/03_own_completer.py [PROJECT [OUT]]
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sample import output_folder, sample_project
from scipy.ndimage import distance_transform_edt

from gvtools import Completion, ContextView, Guidance, evaluate, reconstruct, register_completer


@dataclass(frozen=True)
class NearestCompleter:
    """Copies colour and depth of the nearest known pixel; trusts them less with the distance."""

    name: ClassVar[str] = "nearest"
    half_trust_px: float = 20.0

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Complete all target views of ``guidance``."""
        rgb, depth = guidance.rgb.copy(), guidance.depth.copy()
        confidence = np.minimum(guidance.confidence, 1).astype(np.float32)
        for i, hole in enumerate(~guidance.valid):
            distance, (y, x) = distance_transform_edt(hole, return_indices=True)
            rgb[i], depth[i] = rgb[i][y, x], depth[i][y, x]
            confidence[i][hole] = 0.5 ** (1 + distance[hole] / self.half_trust_px)
        return Completion(rgb, depth, confidence)


register_completer("nearest", NearestCompleter)
for name in ("none", "inpaint", "nearest"):
    out = output_folder() / f"completer_{name}"
    shutil.rmtree(out, ignore_errors=True)
    figures = evaluate(reconstruct(sample_project(), out, targets="every:3",
                                   context="not:every:3", completer=name))  # fmt: skip
    print(f"{name}: PSNR {figures.psnr:.2f} dB")
