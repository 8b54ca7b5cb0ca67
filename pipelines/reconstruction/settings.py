"""The settings of a run, its profiles and protocols."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from gvtools.appearance.fit_options import FitOptions
from gvtools.completers.effort import EffortPolicy
from gvtools.depth.options import FoundationOptions, StereoOptions
from gvtools.memory.back_projection import BackProjectionOptions
from gvtools.memory.panoramas import LensOptions
from gvtools.memory.spatial_memory import MemoryOptions
from gvtools.memory.splat.api import SplatOptions
from gvtools.scenes.resized import SMALLEST
from gvtools.settings import Settings
from pipelines.tuning.options import TuneOptions


class ScanOptions(Settings):
    """An existing scan that memory starts from."""

    section = "scan"

    file: str | None = None
    """A PLY, LAS, LAZ, E57 or PCD; none starts from the photographs alone."""
    placement: str = "estimate"
    """The similarity from the frame of the scan, else of what the fit begins with, to the
    photographs' world: estimate, identity, a text file with a 3x4 or 4x4 matrix, or its numbers
    row by row with commas between."""
    min_fitness: float = Field(0.5, gt=0, le=1)
    """An estimated placement is refused if smaller shares of both the photographs' points and the
    scan's points have a point of the other beside them."""

    def files(self) -> tuple[Path, ...]:
        """What decides a run's result, for its fingerprint."""
        named = (self.file, self.placement)
        return tuple(Path(name) for name in named if name is not None and Path(name).is_file())


class FusionOptions(Settings):
    """What is taken of depth and of completions."""

    section = "fusion"

    min_confidence: float = Field(0.0, ge=0, le=1)
    """Generated pixels below this are not fused; 0 keeps all that nothing observed contradicts, so
    that later views agree with them."""
    pixels: Literal["holes", "all"] = "holes"
    """Which pixels of a whole generated view are fused: those that the memory did not know, or all
    with depth (the paper)."""
    generated_as_observed: bool = False
    """Whether generated points count as observed ones do (the paper): they then enter voxels that
    hold observed ones and places that observed rays crossed, and figures of what was observed
    include them."""
    max_scale_residual: float = Field(0.1, gt=0)
    """A completion whose depth fits the memory's worse than this relative residual is refused."""
    voxel_percentile: float = Field(10.0, ge=0, le=100)
    """The automatic edge of the finest voxels follows this percentile of the context's pixel
    footprints; what is farther gets wider ones (``memory.voxels_per_footprint``). [%]"""
    voxel_scale: float = Field(1.0, gt=0)
    """How many such footprints the edge is."""
    max_psnr_drop_db: float | None = Field(0.05, ge=0)
    """Voxel edges of half to four times the footprint are tried: context views with recorded depth
    are predicted from their neighbours. The coarsest edge whose PSNR is within this of the best is
    taken; ``none`` tries nothing and takes the footprint's edge. [dB]"""


class SavingsOptions(Settings):
    """What a run does not compute because the scene does not require it.

    The voxel edge (``fusion.max_psnr_drop_db``), wider voxels for what is far
    (``memory.voxels_per_footprint``) and what a voxel keeps (``memory.merge_angle_deg``,
    ``memory.observations_per_voxel``) are savings, too.
    """

    section = "savings"

    reuse: bool = True
    """The projection of observed points into a target is kept after completions were fused; the
    pictures are the same."""
    pixel_binning: float = Field(1.0, ge=0)
    """2 x 2 pixels become one point, their mean, where they are together at most this many voxel
    edges wide, unless the surface is steep; 0 lifts each by itself. [voxel edges]"""
    depth_from_memory: float | None = Field(0.9, gt=0, le=1)
    """A context view whose depth would have to be computed takes memory's instead where the views
    before it explain this share of its pixels; none computes all."""


# What the profiles that take their time do not save.
ACCURATE: Mapping[str, Any] = {
    "fusion.max_psnr_drop_db": 0.0,
    "effort.inpaint_below": 0.0,
    "savings.depth_from_memory": None,
    "memory.merge_angle_deg": 0.0,
    "memory.observations_per_voxel": 64,
}


# The paper's: GeoVerse alone, whole decoded views, all of their pixels fused at the scale that maps
# generated camera centres onto the given ones, no shortcuts. How a model samples is its own. The
# table of docs/concepts/protocol.md has a row for each, with its place in the paper.
PAPER: Mapping[str, Any] = {
    "completer": "geoverse",
    "depth": "sensor-or-da3",
    "da3.min_centres": 2,
    "completer.output": "views",
    "completer.composition": "decoded",
    "completer.alignment": "centres-alone",
    "completer.color_alignment": "unchanged",
    "completer.temperature": 1.0,
    "splat.nearest_views": None,
    "splat.view_weight": 0.0,
    "splat.occluders": False,
    "effort.inpaint_below": 0.0,
    "fusion.pixels": "all",
    "fusion.generated_as_observed": True,
    "fusion.max_psnr_drop_db": None,
    "savings.reuse": False,
    "savings.pixel_binning": 0.0,
    "savings.depth_from_memory": None,
    "memory.voxels_per_footprint": 0.0,
    "memory.merge_angle_deg": 0.0,
    "memory.observations_per_voxel": 64,
    "refine.seconds": None,
    "refine.steps": 0,
    "refine.poses": False,
}


class RunSettings(Settings):
    """Everything that decides what a run computes."""

    presets: ClassVar[Mapping[str, Mapping[str, Mapping[str, Any]]]] = {
        "profile": {
            "fast": {
                "max_side": 480,
                "views_per_round": 12,
                "effort.inpaint_below": 0.05,
                "refine.steps": 0,
            },
            # The defaults.
            "balanced": {},
            "accurate": {**ACCURATE, "refine.seconds": 300.0},
            # Fitting ends long before that: when a further fit no longer improves the pictures, or
            # all Gaussians that may be are used up.
            "finest": {**ACCURATE, "refine.seconds": 3600.0},
        },
        "protocol": {"gvtools": {}, "paper": PAPER},
    }
    options_of: ClassVar[Mapping[str, str]] = {"completer": "completer_options"}

    context: str = "all"
    """Which views are given (a selection)."""
    targets: str = "interpolate:12"
    """Which cameras to complete: a selection, a path such as ``orbit:24``, a trajectory file, or
    another project."""
    views_per_round: int = Field(6, ge=1)
    """Targets that a round takes at most; of another lens at least one, with all of its faces."""
    rounds: int | None = Field(None, ge=0)
    """How many rounds; none takes as many as the targets need."""
    max_side: int | None = Field(1600, ge=SMALLEST)
    """Longer side that larger pictures are reduced to; none keeps all. [px]"""
    depth: str = "auto"
    """Where the context's depth comes from: auto, sensor, colmap, plane-sweep, da3, or (the paper)
    sensor-or-da3, whose weights are the completer's unless ``da3.weights`` says otherwise."""
    completer: str = "inpaint"
    """What fills the holes, by registered name; ``completer.KEY`` is an option of its own."""
    profile: str = "balanced"
    """Fast, balanced, accurate or finest: sets several of the others."""
    protocol: str = "gvtools"
    """What the completer's pixels are used for: gvtools keeps what was observed and fuses holes,
    paper runs GeoVerse as published; sets several of the others."""
    points: Literal["all", "context"] = "all"
    """Sparse points of the project that may be used: all, or those alone that two context views
    detected. The others tell what held-out views see."""
    voxel: float | None = Field(None, gt=0)
    """Voxel edge; none derives it from the pixel footprints. [scene units]"""
    seed: int = Field(0, ge=0)
    """Of everything random."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where memory is projected and Gaussians are fitted: "cuda" takes torch and gsplat there,
    "auto" leaves it to ``splat.backend`` and ``splat.device``."""
    allow_overlap: bool = False
    """Whether a view may be context and target."""
    completer_options: dict[str, Any] = Field(default_factory=dict)
    """Options of the completer."""
    back_projection: BackProjectionOptions = BackProjectionOptions()
    memory: MemoryOptions = MemoryOptions()
    stereo: StereoOptions = StereoOptions()
    da3: FoundationOptions = FoundationOptions()
    splat: SplatOptions = SplatOptions()
    fusion: FusionOptions = FusionOptions()
    savings: SavingsOptions = SavingsOptions()
    effort: EffortPolicy = EffortPolicy()
    refine: FitOptions = FitOptions()
    tune: TuneOptions = TuneOptions()
    scan: ScanOptions = ScanOptions()
    lens: LensOptions = LensOptions()
