"""A completer of your own: fill every unknown pixel from the nearest known one.

python examples/03_own_completer.py [PROJECT [OUT]]
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence

import numpy as np
from sample import output_folder, sample_project
from scipy.ndimage import distance_transform_edt

import gvtools
from gvtools import Completion, ContextView, Guidance

HALF_TRUST_PX = 20.0


class NearestCompleter(gvtools.Completer):
    """Copies colour and depth of the nearest known pixel; trusts them less with the distance."""

    name = "nearest"

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Complete all target views of ``guidance``."""
        rgb, depth = guidance.rgb.copy(), guidance.depth.copy()
        confidence = np.minimum(guidance.confidence, 1).astype(np.float32)
        for i, hole in enumerate(~guidance.valid):
            distance, (y, x) = distance_transform_edt(hole, return_indices=True)
            rgb[i], depth[i] = rgb[i][y, x], depth[i][y, x]
            confidence[i][hole] = 0.5 ** (1 + distance[hole] / HALF_TRUST_PX)
        return Completion(rgb, depth, confidence)


gvtools.register_completer("nearest", NearestCompleter)
for name in ("none", "inpaint", "nearest"):
    out = output_folder() / f"completer_{name}"
    shutil.rmtree(out, ignore_errors=True)
    run = gvtools.reconstruct(
        sample_project(), out, context="not:every:3", targets="every:3", completer=name
    )
    print(f"{name}: PSNR {gvtools.evaluate(run).psnr:.2f} dB")
