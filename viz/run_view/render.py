"""A run as the project's own splatter shows it: any camera, any round, any colour mode."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from viz.run_view.point_colors import point_colors
from viz.run_view.view import RunView

if TYPE_CHECKING:
    from gvtools.guidance import Guidance
    from gvtools.memory.spatial_memory import SpatialMemory

# Where the memory knows nothing.
UNKNOWN = 255


class RunRenderer:
    """Renders one run; keeps what the last picture needed, as the next is mostly like it.

    Args:
        run: as it is now.
    """

    def __init__(self, run: RunView) -> None:
        self.run = run
        self._shown: tuple[int, str, SpatialMemory] | None = None

    def render(self, camera: Cameras, *, round: int, mode: str = "color") -> Guidance:
        """The memory as it was after a round, in the colours of a mode, seen by a camera.

        Args:
            camera: a batch of one, world frame.
            round: 0 to the run's last.
            mode: of viz.run_view.point_colors.MODES.
        """
        if self._shown is None or self._shown[:2] != (round, mode):
            memory = self._after(round)
            colors = point_colors(memory, mode, true_depth=self.run.recorded_depth)
            self._shown = round, mode, memory.recolored(colors.rgb)
        return self._shown[2].project(camera)

    def _after(self, round: int) -> SpatialMemory:
        """The memory exactly as it was: later rounds are forgotten in a copy."""
        later = [number for number in self.run.memory.rounds if number > round]
        memory = copy.deepcopy(self.run.memory) if later else self.run.memory
        for number in reversed(later):
            memory.forget(round=number)
        return memory


def picture_of(guidance: Guidance) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 of a batch of one; white where the memory knows nothing."""
    rgb = np.rint(np.clip(guidance.rgb[0], 0, 1) * 255).astype(np.uint8)
    rgb[~guidance.valid[0]] = UNKNOWN
    return rgb
