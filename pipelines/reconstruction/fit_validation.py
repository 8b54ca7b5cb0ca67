"""Validation of a fit: its Gaussians and the memory alone predict photographs that it left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.memory.projection import project
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.reconstruction.voxel_edge import grid_frame

if TYPE_CHECKING:
    from gvtools.appearance.picture import Picture
    from pipelines.reconstruction.fit_inputs import Sweep
    from pipelines.reconstruction.plan import Plan

# The memory's colours must be better by so much, divided by the number of photographs that judge:
# pictures of one that is at the border of the others differ by 2 dB from fit to fit [dB].
MARGIN = 3.0


@dataclass(frozen=True)
class FitValidation:
    """PSNR of a fit's validation photographs, at the size of its sweep.

    Attributes:
        gaussians: PSNR of the Gaussians' pictures [dB].
        memory: of the memory's own colours, and the Gaussians' where it knows nothing [dB].
        photographs: how many they are.

    >>> FitValidation(20.0, 20.1, 5).fit_is_used, str(FitValidation(18.0, 20.0, 5))
    (True, "the memory's own (validation photographs: 20.00 dB, Gaussians 18.00 dB)")
    """

    gaussians: float
    memory: float
    photographs: int

    @property
    def fit_is_used(self) -> bool:
        """Whether the Gaussians are not clearly worse."""
        return self.memory <= self.gaussians + MARGIN / self.photographs

    def __str__(self) -> str:
        if self.fit_is_used:
            return (
                f"Gaussians (validation photographs: {self.gaussians:.2f} dB, the memory's own "
                f"colours {self.memory:.2f} dB)"
            )
        return (
            f"the memory's own (validation photographs: {self.memory:.2f} dB, Gaussians "
            f"{self.gaussians:.2f} dB)"
        )


def validate_fit(
    predicted: Mapping[str, Picture], plan: Plan, sweep: Sweep
) -> FitValidation | None:
    """Predict the validation photographs both ways; None where the memory shows nothing of them.

    Args:
        predicted: pictures of them before they joined the fit, by view.
        plan: of the run, before the fit's depth is taken.
        sweep: depth of its context.
    """
    assert plan.config.voxel is not None
    scene, place = sweep.scene, grid_frame(plan.scene, plan.context)
    size = float(np.mean([plan.scene[n].camera.K[0, 0, 0] for n in predicted]))
    factor = size / float(np.mean([scene[n].camera.K[0, 0, 0] for n in predicted]))
    memory = SpatialMemory(
        plan.config.voxel * factor, origin=place.origin, axes=place.axes, options=plan.config.memory
    )
    for name in plan.context:
        view = scene[name]
        if name in predicted or not sweep.covers(view):
            continue
        found = sweep.map_of(view)
        if found is None:
            continue
        frame = view.load()
        memory.observe(
            frame.rgb, found.depth, view.camera, round=0, mask=frame.mask,
            confidence=found.confidence, options=plan.config.back_projection,
        )  # fmt: skip
    squares, pixels, known = np.zeros(2), 0, 0
    for name, picture in predicted.items():
        view = scene[name]
        frame = view.load()
        guidance = project(memory, view.camera, options=plan.config.splat)
        where = guidance.valid[0] if frame.mask is None else guidance.valid[0] & frame.mask
        height, width = where.shape
        shown = _averaged(picture.rgb, width, height)
        own = np.where(where[..., None], guidance.rgb[0], shown)
        used = np.ones((height, width), np.bool_) if frame.mask is None else frame.mask
        squares += [_square(rgb, frame.rgb, used) for rgb in (shown, own)]
        pixels, known = pixels + int(used.sum()), known + int(where.sum())
    memory.close()
    if not known:
        return None
    gaussians, own_colors = -10 * np.log10(np.maximum(squares / pixels, 1e-10))
    return FitValidation(float(gaussians), float(own_colors), len(predicted))


def _averaged(rgb: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """(height, width, 3) of a larger picture (H, W, 3)."""
    whole = torch.from_numpy(rgb).permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(whole, (height, width), mode="area")
    return small[0].permute(1, 2, 0).numpy()


def _square(
    shown: NDArray[np.float32], photograph: NDArray[np.uint8], where: NDArray[np.bool_]
) -> float:
    """Sum of squared differences over the pixels ``where``, of the mean of the colours."""
    off = shown[where] - photograph[where] / np.float32(255)
    return float(np.square(off).mean(axis=1).sum())
