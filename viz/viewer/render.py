"""Pictures of a run by the project's own splatter: any camera, any round, any colour mode."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.files import replaced_when_written
from viz.viewer.colors import CONTEXT, point_colors
from viz.viewer.run_view import RunView, ShownCamera
from viz.viewer.standpoint import camera_outside

if TYPE_CHECKING:
    from gvtools.guidance import Guidance
    from gvtools.memory.spatial_memory import SpatialMemory

# Where the memory knows nothing.
UNKNOWN = 255


class RunRenderer:
    """Renders one run; keeps what the last picture needed, as the next is mostly like it."""

    def __init__(self, run: RunView) -> None:
        self.run = run
        self._shown: tuple[int, str, SpatialMemory] | None = None

    def render(self, camera: Cameras, *, round: int, mode: str = "color") -> Guidance:
        """The memory as it was after a round, in the colours of a mode, seen by a camera."""
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


def write_screenshot(
    path: Path, run: RunView, shown: ShownCamera, *, round: int, mode: str
) -> None:
    """Write a run seen by one of its cameras as PNG, white where nothing is known."""
    from PIL import Image

    guidance = RunRenderer(run).render(shown.camera, round=round, mode=mode)
    with replaced_when_written(path) as temporary:
        Image.fromarray(picture_of(guidance)).save(temporary, format="PNG")


def chosen_camera(run: RunView, name: str | None) -> ShownCamera:
    """The camera of a view, or the first of the context; outside of a cloud without cameras."""
    if not run.cameras and name is None:
        return ShownCamera("outside", CONTEXT, 0, camera_outside(run))
    if name is None:
        return next((c for c in run.cameras if c.kind == CONTEXT), run.cameras[0])
    for shown in run.cameras:
        if shown.name == name:
            return shown
    known = f"{run.path} holds no cameras; leave the option out"
    if run.cameras:
        first, last = run.cameras[0].name, run.cameras[-1].name
        known = f"no such view; expected one of {len(run.cameras)}, such as {first!r} or {last!r}"
    raise OptionError(f"--camera {name!r}: {known}")
