"""How features are taken from the video model, as far as the paper leaves it open."""

from __future__ import annotations

from dataclasses import dataclass

from gvtools.completers.geoverse.video_prior.layouts import LAYOUTS
from gvtools.errors import OptionError
from gvtools.networks.config_json import check_choice, check_range

_DTYPES = ("float32", "bfloat16", "float16")


@dataclass(frozen=True)
class VideoPriorConfig:
    """How features are taken from the video model.

    Attributes:
        layout: how views become video, see ``video_layouts.view_layout``. The paper does not say;
            "per_view" has each view's own latent and mask.
        taps: backbone blocks whose outputs, VACE hint included, are the features.
        channels: of a feature, the backbone's width; checked against the weights.
        timestep: of the single forward, 0 to 1000.
        sigma: share of noise in x_t; None: timestep / 1000, as in Wan's schedulers whatever their
            shift.
        proxy_noise: standard deviation of the noise on valid target pixels, range [-1, 1].
        resolution: (rows, columns) in px that views are resized to, each rounded to the nearest
            multiple; None: their own size, rounded. 576 gives 504-px views the tokens of a 14-px
            patch, 36 x 36.
        multiple: of both sides, px; itself a multiple of a token's 16.
        dtype: of the transformer; None as stored. What diffusers keeps in float32 stays so.
        prompt: "empty", Wan's embedding of the empty prompt; or "zeros", for tests and tiny
            configurations: Wan was not trained on it.
        prompt_rows: rows that the prompt's embedding is padded to with zeros.
    """

    layout: str = "per_view"
    taps: tuple[int, ...] = (0, 5, 10, 15)
    channels: int = 5120
    timestep: float = 500.0
    sigma: float | None = None
    proxy_noise: float = 0.1
    resolution: tuple[int, int] | None = None
    multiple: int = 16
    dtype: str | None = None
    prompt: str = "empty"
    prompt_rows: int = 512

    def __post_init__(self) -> None:
        check_choice("video.layout", self.layout, LAYOUTS)
        check_choice("video.prompt", self.prompt, ("empty", "zeros"))
        check_choice("video.dtype", self.dtype, (None, *_DTYPES))
        if not self.taps or list(self.taps) != sorted({*self.taps}) or self.taps[0] < 0:
            raise OptionError(f"video.taps = {self.taps}; expected ascending block numbers")
        if self.multiple < 1 or self.multiple % 16:
            raise OptionError(f"video.multiple = {self.multiple}; expected a multiple of 16")
        check_range("video.timestep", self.timestep, ge=0, le=1000)
        check_range("video.sigma", self.sigma, ge=0, le=1)
        check_range("video.proxy_noise", self.proxy_noise, ge=0)
        check_range("video.prompt_rows", self.prompt_rows, ge=1)

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns in px that views of a size are resized to."""
        rows, columns = self.resolution or (height, width)
        unit = self.multiple
        return max(1, round(rows / unit)) * unit, max(1, round(columns / unit)) * unit
