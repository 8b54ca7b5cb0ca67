"""Which published files the ``base`` configuration is made of, and how their keys become ours.

Facts about the files (names, sizes, licences, key prefixes) are those of their publishers' pages
and code in November 2026; the shapes come from our own modules, not from the files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from gvtools.completers.geoverse.config import GeoVerseConfig

# What GeoVerse adds to published networks; fresh where a folder has no trained extension.
EXTENSION = ("level1.depth_embedder.", "control.", "shared.")
EXTENSION_FILE = "geoverse_extension.safetensors"
WHOLE_FILE = "geoverse.safetensors"
CONFIG_FILE = "config.json"
VIDEO_FOLDER = "video"


@dataclass(frozen=True)
class Part:
    """One file and the module that it fills.

    Attributes:
        name: of the part.
        module: prefix of its keys in the state dict of ``GeoVerse``.
        files: where it may lie in a weights folder, the publisher's own place first.
        source: who publishes it.
        licence: its terms.
        nested: dictionaries in which the tensors may lie, the first that is there.
        strip: prefix that is taken off every key that has it.
        only: keys without this prefix belong to other networks and are passed over; it is taken
            off as well.
        note: what else a user should know.
    """

    name: str
    module: str
    files: tuple[str, ...]
    source: str
    licence: str
    nested: tuple[str, ...] = ()
    strip: str = ""
    only: str = ""
    note: str = ""

    def find(self, folder: Path) -> Path | None:
        """The part's file in a folder, if it is there."""
        return next((folder / file for file in self.files if (folder / file).is_file()), None)

    def renamed(self, stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Stored tensors by the names of our module, without its prefix."""
        found = {}
        for key, tensor in stored.items():
            if self.only and not key.startswith(self.only):
                continue
            found[key.removeprefix(self.only).removeprefix(self.strip)] = tensor
        return found


GLD = "SeonghuJeon/GLD (Geometric Latent Diffusion)"
GLD_TERMS = "Apache-2.0 (model card); code MIT"

PARTS = (
    Part(
        "geometry",
        "geometry.",
        ("pretrained_models/da3/model.safetensors", "da3/model.safetensors"),
        "depth-anything/DA3-BASE, model.safetensors; also in SeonghuJeon/GLD",
        "Apache-2.0",
        strip="model.",
        note="the frozen encoder, geometry head, camera encoder and decoder",
    ),
    Part(
        "level1",
        "level1.",
        ("checkpoints/da3_level1.pt", "da3_level1.pt"),
        GLD,
        GLD_TERMS,
        nested=("ema", "model"),
        strip="module.",
        note="the level-1 denoiser; GeoVerse's additions to it start at zero",
    ),
    Part(
        "cascade",
        "cascade.",
        ("checkpoints/da3_cascade.pt", "da3_cascade.pt"),
        GLD,
        GLD_TERMS,
        nested=("ema", "model"),
        strip="module.",
        note="the level-0 cascade",
    ),
    Part(
        "rgb_head",
        "rgb_head.",
        ("pretrained_models/mae_decoder.pt", "mae_decoder.pt"),
        GLD,
        GLD_TERMS,
        nested=("ema", "model"),
        only="decoder.",
        note="the RGB head",
    ),
    *(
        Part(
            f"statistics{level}",
            f"statistics.{level}.",
            (
                f"model_stats/da3/normalization_stats_level{level}.pt",
                f"normalization_stats_level{level}.pt",
            ),
            "cvlab-kaist/Geometric-Latent-Diffusion, in the code repository",
            "MIT",
            note=f"mean and variance of the level-{level} channels",
        )
        for level in (0, 1)
    ),
)

VIDEO_SOURCE = "alibaba-pai/Wan2.2-VACE-Fun-A14B, low_noise_model (34.7 GB), cut to 14.8 GB"
VIDEO_TERMS = "Apache-2.0 (repository; check the model card)"


def parts_of(config: GeoVerseConfig) -> tuple[Part, ...]:
    """The published parts that a configuration has modules for."""
    return tuple(p for p in PARTS if p.name != "cascade" or config.cascade is not None)
