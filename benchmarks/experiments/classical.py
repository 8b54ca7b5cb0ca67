"""Fillers that a user would otherwise call, as completers: each view by itself, no photographs.

Depth is filled in its logarithm. A view that nothing is known of becomes mid-grey without depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.completers.base import Completer, Completion, ContextView
from gvtools.completers.push_pull import push_pull
from gvtools.guidance import Guidance

Float32 = NDArray[np.float32]
# (H, W, C) with holes, (H, W) bool of what is known -> (H, W, C).
Filler = Callable[[Float32, NDArray[np.bool_]], Float32]
# Radius of OpenCV's fillers, px, as its tutorial has it.
RADIUS = 3


class ClassicalCompleter(Completer):
    """One filler for colour and for log depth.

    Attributes:
        name: shown in tables.
        fill: see Filler.
    """

    def __init__(self, name: str, fill: Filler) -> None:
        super().__init__()
        self.name, self.fill = name, fill

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Fill all views; see ``Completer.complete``. Nothing here is random."""
        rgb, depth = guidance.rgb.copy(), guidance.depth.copy()
        for index, valid in enumerate(guidance.valid):
            if not valid.any():
                rgb[index] = 0.5
                continue
            if valid.all():
                continue
            log = np.log(np.where(valid, guidance.depth[index], 1)).astype(np.float32)
            filled = self.fill(np.where(valid[..., None], guidance.rgb[index], 0), valid)
            rgb[index][~valid] = np.clip(filled[~valid], 0, 1)
            depth[index][~valid] = np.exp(self.fill(log[..., None], valid)[~valid][:, 0])
        confidence = guidance.valid.astype(np.float32)
        confidence[~guidance.valid & (depth > 0)] = 0.5
        return Completion(rgb, depth, confidence)


def mean_of_known(values: Float32, valid: NDArray[np.bool_]) -> Float32:
    """The mean of what is known everywhere."""
    return np.broadcast_to(values[valid].mean(0), values.shape).astype(np.float32)


def nearest(values: Float32, valid: NDArray[np.bool_]) -> Float32:
    """The nearest known pixel."""
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return values[rows, columns]


def push_pulled(values: Float32, valid: NDArray[np.bool_]) -> Float32:
    """Averages, coarse to fine."""
    channels = torch.from_numpy(np.ascontiguousarray(values)).permute(2, 0, 1)[None]
    filled = push_pull(channels, torch.from_numpy(valid)[None, None])
    return filled[0].permute(1, 2, 0).numpy()


def biharmonic(values: Float32, valid: NDArray[np.bool_]) -> Float32:
    """scikit-image's biharmonic equation."""
    from skimage.restoration import inpaint_biharmonic

    return inpaint_biharmonic(values, ~valid, channel_axis=-1).astype(np.float32)


def telea(values: Float32, valid: NDArray[np.bool_]) -> Float32:
    """OpenCV's fast marching filler."""
    import cv2

    return _opencv(values, valid, cv2.INPAINT_TELEA)


def navier_stokes(values: Float32, valid: NDArray[np.bool_]) -> Float32:
    """OpenCV's isophote filler."""
    import cv2

    return _opencv(values, valid, cv2.INPAINT_NS)


def _opencv(values: Float32, valid: NDArray[np.bool_], method: int) -> Float32:
    """In integers over the known range: OpenCV's result for floating-point pictures is wrong.

    One channel in 16 bits, three in 8: it takes no others.
    """
    import cv2

    kind = np.uint16 if values.shape[-1] == 1 else np.uint8
    most = np.iinfo(kind).max

    low, high = float(values[valid].min()), float(values[valid].max())
    span = max(high - low, 1e-6)
    levels = np.rint((values - low) / span * most).clip(0, most).astype(kind)
    filled = cv2.inpaint(levels.squeeze(), (~valid).astype(np.uint8), RADIUS, method)
    return (filled.reshape(values.shape) / np.float32(most) * span + low).astype(np.float32)


CLASSICAL = {
    "mean": mean_of_known,
    "nearest": nearest,
    "push-pull": push_pulled,
    "Telea": telea,
    "Navier-Stokes": navier_stokes,
    "biharmonic": biharmonic,
}


def classical(name: str) -> ClassicalCompleter:
    """A filler by its name in CLASSICAL."""
    return ClassicalCompleter(name, CLASSICAL[name])
