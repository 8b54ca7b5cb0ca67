"""Pictures of fitted Gaussians, for the pixels that the memory knows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gvtools.appearance.blending import Blend, blended
from gvtools.appearance.gaussians import UNREADABLE, Gaussians
from gvtools.appearance.picture import Picture
from gvtools.appearance.splat.splat import Lens, Splat
from gvtools.cameras import Cameras
from gvtools.errors import MemoryFileError
from gvtools.guidance import Guidance


@dataclass(frozen=True, eq=False)
class Appearance:
    """What a scene looks like, beside the memory that knows what was observed.

    Attributes:
        gaussians: in their frame.
        near: nothing nearer is drawn, scene units.
        blend: how much of the memory's colours is taken.
        splatter: draws the Gaussians.
    """

    gaussians: Gaussians
    near: float
    blend: Blend = field(default_factory=Blend)
    splatter: type[Splat] = Splat

    @classmethod
    def load(cls, path: Path) -> Appearance:
        """Read the appearance that a run keeps.

        Raises:
            MemoryFileError: missing or damaged.
        """
        gaussians = Gaussians.load(path)
        try:
            with np.load(path) as data:
                return cls(gaussians, float(data["near"]), Blend(*data["blend"].tolist()))
        except UNREADABLE as error:
            raise MemoryFileError(f"{path}: no readable appearance ({error})") from None

    def picture(self, camera: Cameras) -> Picture:
        """What a camera sees, a batch of one."""
        pose = self.gaussians.frame.cam_from_local(camera.cam_from_world)[0]
        size = (int(camera.width[0]), int(camera.height[0]))
        lens = Lens.of(pose, camera.K[0], size=size, near=self.near)
        return Picture.of(self.splatter(self.gaussians.values, lens))


def applied(picture: Picture, guidance: Guidance, *, blend: Blend) -> Guidance:
    """A guidance of one view with the Gaussians' colours where the memory observed.

    Depth, and what is valid, generated and how confident, stays the memory's.
    """
    where = guidance.valid[0] & ~guidance.generated[0] & picture.solid
    rgb = blended(picture.rgb, guidance.rgb[0], where, blend=blend)
    return replace(guidance, rgb=rgb[None])
