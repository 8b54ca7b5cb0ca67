"""Configuration of the whole model.

``base`` is the paper's, ``gld`` that of the networks which it begins with and which are public,
``tiny`` can be trained on a CPU.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Literal

from gvtools.completers.geoverse.conditioning import HintConfig
from gvtools.completers.geoverse.denoiser import DenoiserConfig
from gvtools.completers.geoverse.flow import MOST_SHIFT, check_bounds, time_grid
from gvtools.completers.geoverse.refiner import RefinerConfig
from gvtools.completers.geoverse.rgb_head import RGBHeadConfig
from gvtools.completers.geoverse.video_injection import ControlConfig, SharedAttentionConfig
from gvtools.completers.geoverse.video_prior import VideoPriorConfig
from gvtools.completers.geoverse.wan import MOST_BLOCKS
from gvtools.errors import OptionError
from gvtools.networks.config_json import check_range, from_json, read_model_config, to_json
from gvtools.networks.depth_anything.network import DepthAnythingConfig

NAMES = ("base", "gld", "tiny")
MOST_PIXELS = 4096  # see ``MOST_BLOCKS``


@dataclass(frozen=True)
class FlowConfig:
    """How latents are sampled."""

    # What the level-1 denoiser is trained to return: "velocity" (the paper) or "clean" latents,
    # from which the velocity follows.
    prediction: Literal["velocity", "clean"] = "velocity"
    skip: bool = False  # with "clean": the denoiser returns the difference from the hints' features
    least_time: float = 0.05  # t below which a clean prediction's velocity is not divided further
    # Interval bounds of level 1, from 1 to 0 (Geometric Latent Diffusion ends a little above); one
    # denoiser evaluation an interval.
    level1: tuple[float, ...] = (1.0, 2 / 3, 1 / 3, 0.0)
    cascade: tuple[float, ...] = (1.0, 0.0)  # interval bounds of level 0
    sampling_shift: float = 1.0  # of steps whose number the user chooses instead, as ``shift``
    shift: float = 1.0  # of the training times, t' = s t / (1 + (s - 1) t); 1 for none (the paper)
    # Training times are drawn below it, before the shift; 1 for the paper's U(0, 1), 0.999 is
    # Geometric Latent Diffusion's.
    most_time: float = 0.999
    # Classifier-free guidance scale over the cameras; 1 for none (the paper).
    cfg_scale: float = 1.0
    cascade_cfg_scale: float = 1.0  # likewise, of level 0
    # Of the noise that level 1 starts from, its standard deviation; 1 draws from what the model has
    # learned (the paper), less stays nearer to its mean.
    temperature: float = 1.0

    def __post_init__(self) -> None:
        if self.skip and self.prediction != "clean":
            raise OptionError("flow.skip needs flow.prediction = 'clean'")
        check_range("flow.least_time", self.least_time, gt=0, le=1)
        for name in ("shift", "sampling_shift"):
            check_range(f"flow.{name}", getattr(self, name), ge=1 / MOST_SHIFT, le=MOST_SHIFT)
        check_range("flow.cfg_scale", self.cfg_scale, ge=0)
        check_range("flow.cascade_cfg_scale", self.cascade_cfg_scale, ge=0)
        check_range("flow.temperature", self.temperature, ge=0)
        check_range("flow.most_time", self.most_time, gt=0, le=1)
        check_bounds(self.level1)
        check_bounds(self.cascade)

    def times(self, level: Literal["level1", "cascade"], steps: int | None) -> tuple[float, ...]:
        """Of ``steps`` Euler steps; its own where None or as many, none where nothing is denoised.

        1 = tau_0 > ... > tau_K = 0.
        """
        own: tuple[float, ...] = getattr(self, level)
        if steps is None or steps == len(own) - 1:
            return own
        return time_grid(steps, shift=self.sampling_shift) if steps else ()


@dataclass(frozen=True)
class CameraConfig:
    """Camera conventions of the denoisers."""

    # What is added to a pixel's column and row before it becomes a ray. GLD's checkpoints were
    # trained with (-0.5, 0.5); (0.5, 0.5) is the centre of the pixel.
    pixel_offset: tuple[float, float] = (-0.5, 0.5)
    # Index, of the views of a pass, of the one whose frame the Plücker rays are given in; GLD's is
    # the last, -1.
    reference: int = -1


@dataclass(frozen=True)
class GeoVerseConfig:
    """Everything that is needed to build the model; the defaults are ``base``."""

    name: str = "base"  # of the configuration
    image_size: int = 504  # longest side of the model's pictures, px, a multiple of the patch
    views: int = 8  # views of a pass, context and targets
    context: int = 4  # most context views of a pass
    # Views that the geometry head and the RGB head decode together; bounds the memory, not the
    # result.
    decode_views: int = 8
    # The frozen encoder and geometry head.
    geometry: DepthAnythingConfig = field(default_factory=DepthAnythingConfig)
    rgb: RGBHeadConfig = field(default_factory=RGBHeadConfig)  # the RGB head
    # The level-1 denoiser.
    level1: DenoiserConfig = field(default_factory=lambda: DenoiserConfig(depth_condition=True))
    # The level-0 denoiser; None: level 0 is left at its mean.
    cascade: DenoiserConfig | None = field(
        default_factory=lambda: DenoiserConfig(
            head_depth=2, source=True, separate_embedders=False, projective_size=504
        )
    )
    hints: HintConfig = field(default_factory=HintConfig)  # how projections become features
    flow: FlowConfig = field(default_factory=FlowConfig)  # how latents are sampled
    camera: CameraConfig = field(default_factory=CameraConfig)  # camera conventions
    # How generated depth gets the memory's scale, see ``depth_scale``: "centres" (the paper),
    # "hint" or "field".
    alignment: Literal["centres", "hint", "field"] = "centres"
    # Whether generated colours stay "unchanged" (the paper) or follow the memory's by a "field",
    # see ``composition.align_color``.
    color_alignment: Literal["unchanged", "field"] = "unchanged"
    # The completion is the model's "decoded" pictures and depth (the paper), or a "correction" of
    # the filled projection, see ``composition``; it needs ``hints.fill``.
    composition: Literal["decoded", "correction"] = "decoded"
    # What is asked how far completions are to be trusted, see ``refiner``; None for a model without
    # one. It needs ``composition = "correction"``.
    refiner: RefinerConfig | None = None
    # The video prior; None for a model without one.
    video: VideoPriorConfig | None = field(default_factory=VideoPriorConfig)
    # How video features enter; "shared" is the MoT variant.
    injection: Literal["control", "shared", "none"] = "control"
    control: ControlConfig = field(default_factory=ControlConfig)  # of the control branch
    # Of the MoT variant.
    shared: SharedAttentionConfig = field(default_factory=SharedAttentionConfig)
    trained: bool = True  # False beside weights that no training has made useful yet

    def __post_init__(self) -> None:
        encoder = self.geometry.encoder
        channels = encoder.channels
        if self.composition == "correction" and self.hints.fill == "none":
            raise OptionError("composition = 'correction' needs filled hints; set hints.fill")
        if self.refiner is not None and self.composition != "correction":
            raise OptionError("a refiner refines corrections; set composition = 'correction'")
        if (self.injection == "none") != (self.video is None):
            raise OptionError(
                "a video prior needs injection = 'control' or 'shared', and 'none' goes without one"
            )
        if self.video is not None:
            self._check_layers(len(self.video.taps))
        check_range("geometry.encoder.patch", encoder.patch, ge=1)
        check_range("image_size", self.image_size, ge=encoder.patch, le=MOST_PIXELS)
        networks = {"geometry.encoder": encoder, "rgb": self.rgb, "level1": self.level1}
        for name, network in (networks | {"cascade": self.cascade}).items():
            blocks = getattr(network, "depth", 0) + getattr(network, "head_depth", 0)
            check_range(f"blocks of {name}", blocks, le=MOST_BLOCKS)
        check_range("geometry.camera_depth", self.geometry.camera_depth, le=MOST_BLOCKS)
        check_range("views", self.views, ge=2)
        check_range("context", self.context, ge=1)
        check_range("decode_views", self.decode_views, ge=1)
        check_range("camera.reference", self.camera.reference, ge=-self.views, le=self.views - 1)
        if self.image_size % encoder.patch:
            raise OptionError(
                f"image_size = {self.image_size}; expected a multiple of the patch {encoder.patch}"
            )
        expected = {
            "geometry.head.channels": (self.geometry.head.channels, channels),
            "geometry.head.patch": (self.geometry.head.patch, encoder.patch),
            "level1.channels": (self.level1.channels, channels),
            "level1.camera_patch": (self.level1.camera_patch, encoder.patch),
            "rgb.in_channels": (self.rgb.in_channels, len(encoder.taps) * channels),
            "rgb.patch": (self.rgb.patch, encoder.patch),
        }
        if self.cascade is not None:
            expected["cascade.channels"] = (self.cascade.channels, channels)
            expected["cascade.camera_patch"] = (self.cascade.camera_patch, encoder.patch)
        for name, (found, wanted) in expected.items():
            if found != wanted:
                raise OptionError(f"{name} = {found}; the encoder's dimensions ask for {wanted}")

    def _check_layers(self, count: int) -> None:
        """Refuse blocks that the denoiser does not have: they would do nothing, unsaid."""
        layers = self.control.layers if self.injection == "control" else self.shared.layers
        ascending = list(layers) == sorted({*layers})
        inside = all(0 <= layer < self.level1.depth for layer in layers)
        if len(layers) != count or not ascending or not inside:
            raise OptionError(
                f"{self.injection}.layers = {layers}; expected {count} ascending blocks of the "
                f"level-1 denoiser, 0 to {self.level1.depth - 1}, one for each of video.taps"
            )

    @property
    def patch(self) -> int:
        """Pixels of a token's edge."""
        return self.geometry.encoder.patch


def named(name: str) -> GeoVerseConfig:
    """One of the configurations that ship with the package."""
    if name not in NAMES:
        raise OptionError(f"no configuration {name!r}; known: {', '.join(NAMES)}")
    text = resources.files(__package__).joinpath("configs", f"{name}.json").read_text("utf-8")
    return from_json(GeoVerseConfig, json.loads(text))


def read(path: Path) -> GeoVerseConfig:
    """A configuration from its JSON file."""
    return read_model_config(GeoVerseConfig, path)


def write(config: GeoVerseConfig, path: Path) -> None:
    """The configuration as JSON, every field written out."""
    path.write_text(json.dumps(to_json(config), indent=2) + "\n", encoding="utf-8")
