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
        self._memory: SpatialMemory | None = None
        self._round = -1
        self._colored: SpatialMemory | None = None
        self._mode = ""

    def render(self, camera: Cameras, *, round: int, mode: str = "color") -> Guidance:
        """The memory as it was after a round, in the colours of a mode, seen by a camera.

        Args:
            camera: a batch of one, world frame.
            round: 0 to the run's last.
            mode: of viz.run_view.point_colors.MODES.
        """
        return self._shown(round, mode).project(camera)

    def _shown(self, round: int, mode: str) -> SpatialMemory:
        memory = self._after(round)
        if self._colored is None or mode != self._mode:
            colors = point_colors(memory, mode, true_depth=self.run.recorded_depth)
            self._colored = memory.recolored(colors.rgb)
            self._mode = mode
        return self._colored

    def _after(self, round: int) -> SpatialMemory:
        """The memory exactly as it was: later rounds are forgotten in a copy."""
        if self._memory is None or round > self._round:
            later = any(number > round for number in self.run.memory.rounds)
            self._memory = copy.deepcopy(self.run.memory) if later else self.run.memory
            self._colored = None
        elif round < self._round:
            if self._memory is self.run.memory:
                self._memory = copy.deepcopy(self._memory)
            self._colored = None
        for number in reversed(self._memory.rounds):
            if number > round:
                self._memory.forget(round=number)
        self._round = round
        return self._memory


def picture_of(guidance: Guidance) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 of a batch of one; white where the memory knows nothing."""
    rgb = np.rint(np.clip(guidance.rgb[0], 0, 1) * 255).astype(np.uint8)
    rgb[~guidance.valid[0]] = UNKNOWN
    return rgb
