"""Options of ``gvtools bench complete``: the model, its views, and its device."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from gvtools.errors import OptionError
from gvtools.settings import Settings

if TYPE_CHECKING:
    import torch

    from gvtools.completers.geoverse.config import GeoVerseConfig

Count = Annotated[int, Field(ge=1)]


class CompleteOptions(Settings):
    """Model, views, device and steps of the measured passes, as they are written with figures."""

    section = "bench complete"

    config: Literal["tiny", "base", "gld"] | None = None
    """Of random weights; none for the weights' own, tiny without weights."""
    weights: Path | None = None
    """Folder of a model; none for random numbers."""
    size: tuple[int, int] | None = None
    """HxW or N of the pictures; none for the configuration's square. [px]"""
    context: Count = 2
    """Photographs in a pass."""
    targets: Count = 6
    """Views to complete."""
    steps: Count | None = None
    """Of level 1; none for the configuration's own: 3, of gld 49."""
    cascade_steps: Count | None = None
    """Of level 0; none for the configuration's own: 1, of gld 49."""
    encoder_interval: float = Field(0.0, ge=0, le=1)
    """As ``completer.encoder_interval``."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Auto takes a GPU where there is one."""
    precision: Literal["float32", "bfloat16", "float16"] | None = None
    """Of products; none for what the device computes in: float32 on a CPU, bfloat16 on a GPU,
    float16 on one before compute capability 8.0; for a prediction bfloat16."""
    video: bool | None = None
    """Run the video prior, 15 GB of weights; none: on a GPU, where the configuration has one."""
    repeat: Count = 9
    """Timed passes."""
    compile: bool = False
    """Compile the denoisers and the RGB head first: needs a C++ compiler and most of a minute."""
    memory: bool = False
    """Predict the peak memory of a pass and of a training step, by stage; runs nothing."""
    predict: bool = False
    """Predict the time of a pass on six kinds of GPU, by stage; runs nothing."""
    card: float | None = Field(None, gt=0)
    """Memory of a card: say what of the predicted memory fits it. [GB]"""

    @field_validator("size", mode="before")
    @classmethod
    def _parsed_size(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        parts = value.lower().split("x")
        try:
            height, width = (int(part) for part in (parts * 2 if len(parts) == 1 else parts))
        except ValueError:
            raise OptionError(
                f"--size {value}: expected HxW or N, in pixels, such as 504"
            ) from None
        return height, width

    @model_validator(mode="after")
    def _check(self) -> CompleteOptions:
        if self.config is not None and self.weights is not None:
            raise OptionError(
                "bench complete: both --config and --weights; a weights folder has its own config"
            )
        if self.card is not None and not self.memory:
            raise OptionError("bench complete: --card is of --memory; give both")
        if self.memory + self.predict + self.compile > 1:
            raise OptionError("bench complete: expected one of --memory, --predict and --compile")
        if self.device == "cuda" and self.place.type != "cuda":
            raise OptionError("bench complete: --device cuda, and torch sees no CUDA device here")
        config = self.network()
        if self.video and config.video is None:
            raise OptionError(f"bench complete: --video, and {config.name} has no video prior")
        if any(side <= 0 or side % config.patch for side in self.picture(config)):
            height, width = self.picture(config)
            raise OptionError(
                f"--size {height}x{width}: expected multiples of {config.patch}, a token's edge "
                f"in {config.name}"
            )
        return self

    def network(self) -> GeoVerseConfig:
        """Of the model."""
        from gvtools.completers.geoverse.config import named
        from gvtools.completers.geoverse.weights import config_of

        return named(self.config or "tiny") if self.weights is None else config_of(self.weights)

    def conditions(self, config: GeoVerseConfig) -> dict[str, Any]:
        """What every kind of figures says of the passes."""
        from gvtools.networks.compute import name_of

        sampling = self.sampling(config)
        return {
            "config": config.name,
            "size": list(self.picture(config)),
            "precision": name_of(self.compute_type),
            "context": self.context,
            "targets": self.targets,
            "steps": len(sampling["bounds"]) - 1,
            "cascade_steps": len(sampling["cascade_bounds"]) - 1,
            "encoder_interval": self.encoder_interval,
        }

    def sampling(self, config: GeoVerseConfig) -> dict[str, Any]:
        """How a pass samples, for ``generate``."""
        return {
            "bounds": config.flow.times("level1", self.steps),
            "cascade_bounds": config.flow.times("cascade", self.cascade_steps),
            "encoder_interval": self.encoder_interval,
        }

    def picture(self, config: GeoVerseConfig) -> tuple[int, int]:
        """(H, W), px."""
        return self.size or (config.image_size, config.image_size)

    @property
    def place(self) -> torch.device:
        """The device."""
        import torch

        cuda = self.device != "cpu" and torch.cuda.is_available()
        return torch.device("cuda" if cuda else "cpu")

    @property
    def compute_type(self) -> torch.dtype:
        """Of products."""
        from gvtools.networks.compute import inference_type, named_type

        if self.memory or self.predict:
            return named_type(self.precision or "bfloat16")
        return inference_type(self.precision or "auto", self.place)

    def runs_video(self, config: GeoVerseConfig) -> bool:
        """The video prior is part of the pass."""
        if self.video is None:
            return config.video is not None and self.place.type == "cuda"
        return self.video
