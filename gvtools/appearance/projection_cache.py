"""Projections of a growing memory that are kept: what has not changed is not splatted again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance, Picture, applied
from gvtools.cameras import Cameras
from gvtools.guidance import Guidance
from gvtools.memory.projection import Observed, observed_of, project_again
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import ONE_PIXEL, SplatOptions


class CachedProjection:
    """One camera, and the memory as it is projected into it, now and after every change.

    Generated observations only fill what observed ones leave open, and never change these. So what
    the observed ones show is kept, and a projection after a completion was fused splats the
    generated ones alone. The result is that of ``SpatialMemory.project`` to the bit.

    Args:
        memory: is looked at whenever a guidance is asked for.
        camera: a batch of one.
        options: of the projection.
        reuse: False splats everything each time that the memory has changed.
        appearance: gives colours of what was observed; None leaves them the memory's.
    """

    def __init__(
        self,
        memory: SpatialMemory,
        camera: Cameras,
        *,
        options: SplatOptions | None = None,
        reuse: bool = True,
        appearance: Appearance | None = None,
    ) -> None:
        self.memory, self.camera = memory, camera
        self.options = options or SplatOptions()
        self.reuse = reuse and self.options.backend not in ONE_PIXEL
        self._at = (-1, -1)
        self._observed: Observed | None = None
        self._guidance: Guidance | None = None
        self.appearance = appearance
        self._picture: Picture | None = None

    def prefetch(self, snapshot: SpatialMemory) -> None:
        """Project what observed views show ahead of ``guidance``, where that is reused.

        Args:
            snapshot: of the memory; so this may run beside fusions of generated content.
        """
        if self.reuse and self.options.backend == "cpu":
            self._observed = observed_of(snapshot, self.camera, options=self.options)
            self._at = (-1, snapshot.observed_changes)

    def guidance(self) -> Guidance:
        """The projection of the memory as it is now, a batch of one; the last one if unchanged."""
        memory = self.memory
        at = (memory.changes, memory.observed_changes)
        if self._guidance is None or at != self._at:
            if not self.reuse:
                self._guidance = memory.project(self.camera, options=self.options)
            else:
                observed = self._observed if at[1] == self._at[1] else None
                self._guidance, self._observed = project_again(
                    memory, self.camera, observed, options=self.options
                )
            if self.appearance is not None:
                if self._picture is None:
                    self._picture = self.appearance.picture(self.camera)
                self._guidance = applied(self._picture, self._guidance, blend=self.appearance.blend)
            self._at = at
        return self._guidance

    def colored(self, guidance: Guidance, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """A completion's colours (1, H, W, 3), with the Gaussians' where these show a surface.

        Some photograph did see most of it, though not well enough to tell its depth. It remains
        generated: nothing observed supports it. Its depth remains the completer's.

        Args:
            guidance: that was completed; the Gaussians' colours come where it is not valid.
            rgb: of the completion, 0 to 1.
        """
        if self._picture is None:
            return rgb
        where = ~guidance.valid[0] & self._picture.solid
        return np.where(where[..., None], self._picture.rgb, rgb[0])[None]
