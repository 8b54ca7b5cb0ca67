"""What a frame of a film shows: one panel, or several side by side."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance, applied
from gvtools.cameras import Cameras
from gvtools.completers.base import create, run_completer
from gvtools.errors import OptionError
from gvtools.guidance import Guidance
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.runs.memory_file import load_appearance, load_memory
from pipelines.reconstruction.rounds import CachedProjection
from viz.run_view.render import picture_of

Picture = NDArray[np.uint8]

# memory: the whole memory. observed: without completers' points. completed: the memory, holes
# filled by ``inpaint``. depth: of the memory, near is red, far is blue.
PANELS = ("memory", "observed", "completed", "depth")
# For "completed", so many frames of the path are completed and fused before the film is drawn, so
# that filled regions look the same from all frames.
KEY_FRAMES = 12
# The colours of depth span these percentiles of the depth of so many frames.
RANGE_FRAMES, RANGE = 9, (2.0, 98.0)


class FilmRenderer:
    """Draws the frames of one film.

    Args:
        path: a run's folder or a memory file.
        cameras: of all frames, of one size.
        up_to: draw the memory as it was after this round; None: after the last one.
    """

    def __init__(self, path: Path, cameras: Cameras, *, up_to: int | None = None) -> None:
        self.path, self.cameras, self.up_to = path, cameras, up_to
        self.memory = load_memory(path, up_to=up_to)
        self.appearance: Appearance | None = load_appearance(path)
        self.projecting = 0.0
        """Seconds spent on projecting the memory and drawing the Gaussians."""

    def frame(self, index: int, panels: Sequence[str]) -> Picture:
        """(H, W, 3) one frame, its panels side by side."""
        pictures = [self._panel(index, panel) for panel in panels]
        return pictures[0] if len(pictures) == 1 else np.concatenate(pictures, axis=1)

    def _panel(self, index: int, panel: str) -> Picture:
        camera = self.cameras[index]
        if panel == "observed":
            return picture_of(self._projected(self._observed, camera))
        if panel == "completed":
            return self._filled(self._projected(self._completed, camera))
        guidance = self._projected(self.memory, camera)
        return self._depth(guidance) if panel == "depth" else picture_of(guidance)

    def _projected(self, memory: SpatialMemory, camera: Cameras) -> Guidance:
        start = time.perf_counter()
        guidance = memory.project(camera)
        if self.appearance is not None:
            picture = self.appearance.picture(camera)
            guidance = applied(picture, guidance, blend=self.appearance.blend)
        self.projecting += time.perf_counter() - start
        return guidance

    def _filled(self, guidance: Guidance) -> Picture:
        if guidance.valid.all() or not guidance.valid.any():
            return picture_of(guidance)
        completion = run_completer(self._inpaint, (), guidance)
        whole = replace(guidance, rgb=completion.rgb, valid=completion.depth > 0)
        return picture_of(whole)

    def _depth(self, guidance: Guidance) -> Picture:
        from matplotlib import colormaps

        near, far = self._range
        with np.errstate(divide="ignore"):
            share = (1 / guidance.depth[0] - 1 / far) / (1 / near - 1 / far)
        colors = colormaps["turbo"](np.clip(np.nan_to_num(share), 0, 1))[..., :3]
        picture = np.rint(255 * colors).astype(np.uint8)
        picture[~guidance.valid[0]] = 255
        return picture

    @cached_property
    def _inpaint(self):
        return create("inpaint")

    @cached_property
    def _observed(self) -> SpatialMemory:
        """The memory after its first round, which holds observations only."""
        return load_memory(self.path, up_to=self.memory.rounds[0])

    @cached_property
    def _completed(self) -> SpatialMemory:
        """The memory with key frames of the path completed and fused."""
        from pipelines.reconstruction.rounds import Clock, complete_targets
        from pipelines.reconstruction.settings import RunSettings

        memory = load_memory(self.path, up_to=self.up_to)
        count = len(self.cameras)
        rows = np.unique(np.linspace(0, count - 1, min(KEY_FRAMES, count)).round().astype(int))
        targets = [
            CachedProjection(memory, self.cameras[int(row)], appearance=self.appearance)
            for row in rows
        ]
        for _ in complete_targets(
            targets, memory.rounds[-1] + 1, memory=memory, completer=self._inpaint, context=(),
            config=RunSettings(), clock=Clock(),
        ):  # fmt: skip
            pass
        return memory

    @cached_property
    def _range(self) -> tuple[float, float]:
        """Depths at the ends of the colour map, scene units."""
        count = len(self.cameras)
        rows = np.unique(np.linspace(0, count - 1, min(RANGE_FRAMES, count)).round().astype(int))
        seen = [self.memory.project(self.cameras[int(row)]) for row in rows]
        known = np.concatenate([guidance.depth[guidance.valid] for guidance in seen])
        if not len(known):
            raise OptionError("depth: the memory is in view of no frame; give another --path")
        near, far = np.percentile(known, RANGE)
        return float(near), float(max(far, near * 1.001))


def captioned(picture: Picture, text: str) -> Picture:
    """The picture with a line of text in its upper left corner."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    size = max(10, picture.shape[0] // 24)
    font = ImageFont.load_default(size)
    draw = ImageDraw.Draw(image)
    edge = size // 2
    draw.text((edge, edge), text, fill="white", font=font, stroke_width=2, stroke_fill="black")
    return np.asarray(image)
