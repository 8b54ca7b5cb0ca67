"""Which published files make ``gld`` and ``base``, and how their keys become ours.

Facts about the files (names, sizes, licences, key prefixes) are those of their publishers' pages
and code in November 2026; the shapes come from our own modules, not from the files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.errors import CheckpointError
from gvtools.networks.depth_anything import weights as da3
from gvtools.networks.tensor_files import (
    TensorFiles,
    plain_tensors,
    read_pickled,
    read_tensors,
)
from gvtools.networks.tensors import share_tied

# What GeoVerse adds to published networks.
EXTENSION = ("level1.depth_embedder.", "control.", "shared.")
WHOLE_FILE = da3.GEOVERSE_FILE
CONFIG_FILE = da3.GEOVERSE_CONFIG
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
        strip: prefix that is taken off every key that has it.
        only: keys with none of these prefixes belong to other networks and are ignored; the
            prefix is taken off as well.
        names: keys other than these are no tensors of the module and are ignored.
        tied: names that are one tensor in the publisher's network; a file may hold any of them.
        optional: the model can do without it.
        lenient: loaded as its publisher's code does: unknown names are ignored, and missing
            tensors keep the values of the part that was loaded before; a message lists them.
        stated_bytes: the file's size as published, where it holds other networks, too.
        note: what else a user should know.
    """

    name: str
    module: str
    files: tuple[str, ...]
    source: str
    licence: str
    strip: str = "module."
    only: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    tied: tuple[tuple[str, ...], ...] = ()
    optional: bool = False
    lenient: bool = False
    stated_bytes: int | None = None
    note: str = ""

    def find(self, folder: Path) -> Path | None:
        """The part's file in a folder, if it is there."""
        return next((folder / file for file in self.files if (folder / file).is_file()), None)

    def own_name(self, key: str) -> str | None:
        """A stored key by the name of our module, without its prefix; None if it is another's."""
        key = key.removeprefix(self.strip)
        if not self.only:
            return None if self.names and key not in self.names else key
        start = next((start for start in self.only if key.startswith(start)), None)
        return None if start is None else key.removeprefix(start)


GLD = "SeonghuJeon/GLD (Geometric Latent Diffusion)"
GLD_TERMS = "Apache-2.0 (model card); code MIT"

# Dictionaries in which the tensors of a PyTorch file may lie; the first that is there counts.
NESTED = ("ema", "model")

# A file of one's own, instead of all others.
WHOLE = Part("geoverse", "", (WHOLE_FILE,), "gvtools train or gvtools weights create", "", strip="")

PARTS = (
    Part(
        "geometry",
        da3.GEOVERSE_PREFIX,
        da3.PUBLISHED_PLACES,
        "depth-anything/DA3-BASE, model.safetensors; also in SeonghuJeon/GLD",
        "Apache-2.0",
        strip=da3.PUBLISHED_PREFIX,
        tied=da3.tied_norms("head."),
        note="the frozen encoder, geometry head, camera encoder and decoder",
    ),
    Part(
        "level1",
        "level1.",
        ("checkpoints/da3_level1.pt", "da3_level1.pt"),
        GLD,
        GLD_TERMS,
        note="the level-1 denoiser; GeoVerse's additions to it start at zero",
    ),
    Part(
        "cascade",
        "cascade.",
        ("checkpoints/da3_cascade.pt", "da3_cascade.pt"),
        GLD,
        GLD_TERMS,
        note="the level-0 cascade",
    ),
    Part(
        "rgb_head",
        "rgb_head.",
        ("pretrained_models/mae_decoder.pt", "mae_decoder.pt"),
        GLD,
        GLD_TERMS,
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
            names=("mean", "var"),
            note=f"mean and variance of the level-{level} channels",
        )
        for level in (0, 1)
    ),
)

# Read where it is there, as GLD does: what has a name of the geometry head counts, the rest is left
# aside, and tensors that it lacks stay Depth Anything 3's. Another shape is refused, as GLD does.
GEOMETRY_HEAD = Part(
    "geometry_head",
    "geometry.head.",
    ("pretrained_models/da3/dpt_decoder.pt", "da3/dpt_decoder.pt"),
    GLD,
    GLD_TERMS,
    only=("decoder.", "pred."),
    tied=da3.tied_norms(""),
    optional=True,
    lenient=True,
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


def expected_of(module: nn.Module, part: Part) -> dict[str, tuple[int, ...]]:
    """What a part's file has to hold for a (meta) ``GeoVerse``: its module without extensions."""
    return {
        name.removeprefix(part.module): tuple(tensor.shape)
        for name, tensor in module.state_dict().items()
        if name.startswith(part.module) and (part is WHOLE or not is_extension(name))
    }


def is_extension(name: str) -> bool:
    """Whether a key of ``GeoVerse`` is what GeoVerse adds to published networks."""
    return name.startswith(EXTENSION)


def read_part(
    path: Path, part: Part, *, numbers: bool = True
) -> tuple[dict[str, Tensor], tuple[str, ...]]:
    """A part's tensors by the names of our module, and the names of what else its file holds.

    Args:
        path: the file.
        part: what it is.
        numbers: False reads the headers of a safetensors file alone.
    """
    content: dict[str, Any] = {}
    if path.suffix == ".safetensors":
        stored = read_tensors(path) if numbers else TensorFiles.find(path).empty()
    else:
        content = read_pickled(path)
        inner = next((content[k] for k in NESTED if isinstance(content.get(k), dict)), content)
        stored = plain_tensors(inner, path)
    found: dict[str, Tensor] = {}
    ignored = []
    for key, tensor in stored.items():
        name = part.own_name(key)
        if name is None:
            ignored.append(key)
        elif name in found:
            raise CheckpointError(f"{path}: holds {name} twice, also as {key}; expected it once")
        else:
            found[name] = tensor
    if part.name.startswith("statistics"):
        _check_statistics(content, found, path, part=part)
        found = {name: tensor.reshape(-1) for name, tensor in found.items()}
    share_tied(found, part.tied, where=path)
    return found, tuple(ignored)


def _check_statistics(
    content: Mapping[str, Any], found: Mapping[str, Tensor], path: Path, *, part: Part
) -> None:
    """Refuse a file that names another level, or whose ``var`` has negative values."""
    expected = int(part.name.removeprefix("statistics"))
    level = content.get("level")
    # Of the four levels the last may be called -1.
    if isinstance(level, int) and -4 <= level < 4 and level % 4 != expected:
        raise CheckpointError(f"{path}: statistics of level {level}; expected level {expected}")
    if "var" in found and bool((found["var"] < 0).any()):
        raise CheckpointError(f"{path}: var is negative in places; expected variances")
