"""Which published files the ``base`` configuration is made of, and how their keys become ours.

Facts about the files (names, sizes, licences, key prefixes) are those of their publishers' pages
and code in November 2026; the shapes come from our own modules, not from the files.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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
        only: keys with none of these prefixes belong to other networks and are passed over; the
            prefix is taken off as well.
        tied: names that are one tensor in the publisher's network; a file may hold any of them.
        optional: the model can do without it; where the file is there it has to fit all the same.
        stated_bytes: the file's size as published, where it holds other networks, too.
        note: what else a user should know.
    """

    name: str
    module: str
    files: tuple[str, ...]
    source: str
    licence: str
    nested: tuple[str, ...] = ()
    strip: str = ""
    only: tuple[str, ...] = ()
    tied: tuple[tuple[str, ...], ...] = ()
    optional: bool = False
    stated_bytes: int | None = None
    note: str = ""

    def find(self, folder: Path) -> Path | None:
        """The part's file in a folder, if it is there."""
        return next((folder / file for file in self.files if (folder / file).is_file()), None)

    def own_name(self, key: str) -> str | None:
        """A stored key by the name of our module, without its prefix; None if it is another's."""
        key = key.removeprefix(self.strip)
        if not self.only:
            return key
        start = next((start for start in self.only if key.startswith(start)), None)
        return None if start is None else key.removeprefix(start)


GLD = "SeonghuJeon/GLD (Geometric Latent Diffusion)"
GLD_TERMS = "Apache-2.0 (model card); code MIT"

# Depth Anything 3 has one LayerNorm in its four ray outputs; safetensors store it under one name.
_RAY_NORMS = "scratch.output_conv2_aux.{}.2.{}"


def _tied(start: str) -> tuple[tuple[str, ...], ...]:
    return tuple(
        tuple(start + _RAY_NORMS.format(level, kind) for level in range(4))
        for kind in ("weight", "bias")
    )


PARTS = (
    Part(
        "geometry",
        "geometry.",
        ("pretrained_models/da3/model.safetensors", "da3/model.safetensors"),
        "depth-anything/DA3-BASE, model.safetensors; also in SeonghuJeon/GLD",
        "Apache-2.0",
        strip="model.",
        tied=_tied("head."),
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
        strip="module.",
        only=("decoder.",),
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

# Read where it is there, as GLD does. GLD takes of it what has a name of the geometry head and says
# nothing of the rest; here it has to be the whole head, and nothing else under its two prefixes.
GEOMETRY_HEAD = Part(
    "geometry_head",
    "geometry.head.",
    ("pretrained_models/da3/dpt_decoder.pt", "da3/dpt_decoder.pt"),
    GLD,
    GLD_TERMS,
    nested=("model",),
    strip="module.",
    only=("decoder.", "pred."),
    tied=_tied(""),
    optional=True,
    stated_bytes=400_000_000,
    note="GLD's geometry head, in place of Depth Anything 3's own",
)

VIDEO_SOURCE = "alibaba-pai/Wan2.2-VACE-Fun-A14B, low_noise_model (34.7 GB), cut to 14.8 GB"
VIDEO_TERMS = "Apache-2.0 (repository; check the model card)"
# Tensors, numbers and bytes of what is left of it: blocks 0 to 15, VACE blocks 0, 5, 10 and 15, in
# bfloat16 but for what diffusers keeps in float32; and of the VAE.
VIDEO_SIZES = {
    "transformer": (567, 7_393_674_304, 14_844_078_208),
    "vae": (194, 126_892_531, 507_570_124),
}


def parts_of(config: GeoVerseConfig) -> tuple[Part, ...]:
    """The published parts that a configuration has modules for, the optional one last."""
    parts = (*PARTS, GEOMETRY_HEAD)
    return tuple(part for part in parts if part.name != "cascade" or config.cascade is not None)
