"""What ``gvtools bench complete`` measures: the model, its views, and where it runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from gvtools.completers.geoverse.config import GeoVerseConfig, named
from gvtools.completers.geoverse.weights.folder import config_of
from gvtools.errors import OptionError
from gvtools.options import check_range


@dataclass(frozen=True, kw_only=True)
class CompleteOptions:
    """See the module; ``None`` is derived, and written with the figures.

    Attributes:
        config: "tiny" or "base"; None for the weights' own, "tiny" without weights.
        weights: folder of a model; None for random numbers.
        size: (H, W), px; None for the configuration's square.
        context: photographs in a pass.
        targets: views to complete.
        steps: of level 1.
        cascade_steps: of level 0.
        device: "auto" takes a GPU where there is one.
        precision: "float32" or "bfloat16"; None for bfloat16 on a GPU and float32 on a CPU.
        video: run the video prior; None: where the configuration has one, but not on a CPU.
        repeat: timed passes.
        flops_only: run nothing.
        compile: compile the denoisers and the RGB head first.
    """

    config: str | None = None
    weights: Path | None = None
    size: tuple[int, int] | None = None
    context: int = 2
    targets: int = 6
    steps: int = 3
    cascade_steps: int = 1
    device: str = "auto"
    precision: str | None = None
    video: bool | None = None
    repeat: int = 9
    flops_only: bool = False
    compile: bool = False

    def __post_init__(self) -> None:
        for name in ("context", "targets", "steps", "cascade_steps", "repeat"):
            check_range(f"bench complete: {name}", getattr(self, name), least=1)
        if self.config is not None and self.weights is not None:
            raise OptionError(
                "bench complete: both --config and --weights; a weights folder has its own config"
            )
        if self.device == "cuda" and not torch.cuda.is_available():
            raise OptionError("bench complete: --device cuda, and torch sees no CUDA device here")
        config = self.model_config()
        if self.video and config.video is None:
            raise OptionError(f"bench complete: --video, and {config.name} has no video prior")
        if any(side <= 0 or side % config.patch for side in self.picture(config)):
            height, width = self.picture(config)
            raise OptionError(
                f"--size {height}x{width}: expected multiples of {config.patch}, a token's edge "
                f"in {config.name}"
            )

    def model_config(self) -> GeoVerseConfig:
        """Of the model."""
        return named(self.config or "tiny") if self.weights is None else config_of(self.weights)

    def picture(self, config: GeoVerseConfig) -> tuple[int, int]:
        """(H, W), px."""
        return self.size or (config.image_size, config.image_size)

    @property
    def place(self) -> torch.device:
        """The device."""
        auto = "cuda" if torch.cuda.is_available() else "cpu"
        return torch.device(auto if self.device == "auto" else self.device)

    @property
    def rounded(self) -> bool:
        """Products in bfloat16."""
        if self.precision is None:
            return self.place.type == "cuda"
        return self.precision == "bfloat16"

    def runs_video(self, config: GeoVerseConfig) -> bool:
        """The video prior is part of the pass; counting alone needs no memory for it."""
        if self.video is None:
            return config.video is not None and (self.flops_only or self.place.type == "cuda")
        return self.video


def parsed_size(text: str) -> tuple[int, int]:
    """HxW, or N for N x N.

    Raises:
        OptionError: neither.
    """
    parts = text.lower().split("x")
    try:
        height, width = (int(part) for part in (parts * 2 if len(parts) == 1 else parts))
    except ValueError:
        raise OptionError(f"--size {text}: expected HxW or N, in pixels, such as 504") from None
    return height, width
