"""Arguments that commands share: of projects, RGB-D recordings, measures, LPIPS."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from gvtools.errors import CheckpointError, OptionError
from pipelines.options import Arguments, JsonArguments

if TYPE_CHECKING:
    from gvtools.cameras import Cameras
    from gvtools.evaluation.images import Lpips
    from gvtools.memory.panoramas import Rig
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.scenes.scene import Scene
    from pipelines.scoring.measurement import MeasureOptions


# What commands say of a memory that they can do nothing with.
EMPTY = "an empty memory; expected one that views were fused in"


def _intrinsics(text: Any) -> Any:
    """K of ``FX,FY,CX,CY``."""
    if not isinstance(text, str):
        return text
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
        if not (min(fx, fy) > 0 and all(math.isfinite(value) for value in (fx, fy, cx, cy))):
            raise ValueError
    except ValueError:
        raise ValueError("four finite numbers FX,FY,CX,CY in pixels, FX and FY above 0") from None
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


Intrinsics = Annotated[list[list[float]] | None, BeforeValidator(_intrinsics)]


class RecordingArguments(Arguments):
    """What RGB-D folders leave open."""

    title = "RGB-D recording"

    depth_unit: float | None = Field(None, gt=0)
    """Of one stored unit of RGB-D depth. [metres]"""
    depth_max: float | None = Field(None, gt=0)
    """Ignore greater RGB-D readings. [metres]"""
    color_intrinsics: Intrinsics = None
    """Of RGB-D pictures, pixels, the first pixel's centre being (0, 0). [FX,FY,CX,CY]"""
    depth_intrinsics: Intrinsics = None
    """Of a depth camera that is not the colour camera; depth is then registered. [FX,FY,CX,CY]"""
    color_from_depth: Path | None = None
    """4x4 matrix (text, metres) from the depth camera's frame to the colour camera's. [FILE]"""
    max_time_difference: float | None = Field(None, gt=0)
    """Between picture, depth and pose of one TUM frame (0.02). [seconds]"""

    def reading(self, *, rgbd: bool = False) -> dict[str, Any]:
        """What was given of how a project is read, JSON-ready; of RGB-D alone with ``rgbd``."""
        from gvtools.scenes.project import READING

        # A command's own arguments may have these names and mean something else.
        whole = isinstance(self, SceneArguments) and not rgbd
        known = (SceneArguments if whole else RecordingArguments).model_fields
        values = {name: getattr(self, name) for name in READING if name in known}
        return {
            name: str(value.resolve()) if isinstance(value, Path) else value
            for name, value in values.items()
            if value is not None
        }


class RootArguments(Arguments):
    """Where a data set lies."""

    root: Path | None = None
    """The data set's download, for a project given as spec:NAME:SCENE (gvtools data list). [DIR]"""


class SceneArguments(RecordingArguments, RootArguments):
    """Where a project's pictures and masks are, and what RGB-D folders leave open."""

    title = "project"

    images: Path | None = None
    """The pictures, where they are not beside a model. [DIR]"""
    masks: Path | None = None
    """Masks NAME.png (black = ignore) of the pictures. [DIR]"""
    model: int | None = None
    """COLMAP's sparse/N, where it holds several (largest). [N]"""
    alpha: Literal["mask", "ignore", "white", "black"] | None = None
    """Of pictures: leave transparent pixels out (mask), or use them, as stored or on a colour."""

    def open_scene(self, path: Path) -> Scene:
        """The project at ``path``."""
        from gvtools.scenes.project import open_as

        return open_as(path, self.reading())


class LensArguments(Arguments):
    """The lens of pictures and films."""

    lens: Literal["perspective", "equirectangular", "fisheye"] = "perspective"
    """Equirectangular is a level panorama of all directions, fisheye an equidistant circle."""
    field_of_view: float | None = Field(None, ge=10, le=360)
    """Across a fisheye's circle (180). [degrees]"""
    width: int | None = Field(None, ge=16, le=16384)
    """Of a picture; the height follows (the cameras'; of another lens as fine as they are, at most
    4096, in a film 2048). [pixels]"""

    def rig(
        self, cameras: Cameras, memory: SpatialMemory, *, widest: int
    ) -> tuple[Rig | None, Cameras]:
        """What takes pictures in the place of some cameras, None where these do; and from where."""
        from gvtools.cameras import concatenate
        from gvtools.memory.panoramas import LensOptions, Rig, picture_cameras

        width = None if self.lens == "perspective" else self.width
        options = LensOptions(
            kind=self.lens, width=width, field_of_view=self.field_of_view or 180.0
        )
        rig = Rig.of(options, cameras, widest=widest)
        if rig is None:
            return None, cameras
        views = [view.camera for view in memory.views.photographed]
        captured = concatenate(views) if views else cameras
        return rig, picture_cameras(cameras, options, captured=captured)


class LpipsArguments(Arguments):
    """The network below LPIPS."""

    lpips_net: Literal["vgg", "alex"] = "vgg"
    """Below LPIPS."""
    lpips_weights: Path | None = None
    """The folder with the network's published weights (default: torch's cache). [DIR]"""

    def open_lpips(self) -> tuple[Lpips | None, str | None]:
        """The network, or None with the reason."""
        from gvtools.evaluation.images import Lpips

        try:
            return Lpips(self.lpips_net, folder=self.lpips_weights), None
        except CheckpointError as error:
            if self.lpips_weights is not None:
                raise
            return None, str(error)


class MeasurementArguments(LpipsArguments, JsonArguments):
    """What is measured of pictures, and how."""

    parts: str = "images,consistency,poses"
    """What to measure. [NAMES]"""
    no_control: bool = False
    """Leave out the same measures on the true pictures, which tell how to read the figures."""
    matcher: Literal["sift", "lightglue"] = "sift"
    """Of the pose probe."""
    seed: int = Field(0, ge=0)
    """Of everything random."""

    def measures(self) -> MeasureOptions:
        """The parts, networks and seed of a measurement."""
        from pipelines.scoring.measurement import PARTS, MeasureOptions

        parts = tuple(part.strip() for part in self.parts.split(",") if part.strip())
        if not parts or set(parts) - set(PARTS):
            raise OptionError(f"--parts {self.parts!r}; expected some of {', '.join(PARTS)}")
        lpips, no_lpips = self.open_lpips()
        return MeasureOptions(
            parts=parts,
            lpips=lpips,
            no_lpips=no_lpips,
            lpips_net=self.lpips_net,
            matcher=self.matcher,
            control=not self.no_control,
            seed=self.seed,
        )
