"""Published Wan VACE weights as they lie on disk: diffusers' folders, or Wan's own files."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from gvtools.completers.geoverse.video_prior.wan_files import TensorFiles
from gvtools.completers.geoverse.video_prior.wan_library import COMPONENTS, read_config
from gvtools.completers.geoverse.video_prior.wan_names import by_diffusers_name, config_of_tensors
from gvtools.errors import CheckpointError


@dataclass(frozen=True)
class Source:
    """A transformer's tensors by their diffusers names, whatever they are called on disk.

    Attributes:
        place: folder or file.
        config: the transformer's diffusers config.
        vae: folder of the VAE in diffusers' form.
        files: where the tensors are.
        stored: the name on disk of each diffusers name.
    """

    place: Path
    config: dict[str, Any]
    vae: Path
    files: TensorFiles
    stored: dict[str, str]

    @property
    def names(self) -> Collection[str]:
        """Diffusers names of all tensors."""
        return self.stored.keys()

    def shape(self, name: str) -> tuple[int, ...]:
        """Of one tensor."""
        return self.files.shape(self.stored[name])

    def numbers(self, name: str) -> int:
        """How many numbers a tensor holds; see ``TensorFiles.numbers``."""
        return self.files.numbers(self.stored[name])

    def read(self, name: str) -> Tensor:
        """One tensor, as stored."""
        return self.files.read(self.stored[name])


def find_source(place: Path, vae: Path | None) -> Source:
    """The low-noise transformer in ``place``, and its VAE.

    Args:
        place: folder or file, see ``wan_checkpoint.truncate``.
        vae: folder of the VAE; None looks beside the transformer.

    Raises:
        CheckpointError: neither form is found, or the transformer is not a Wan VACE one.
    """
    folder = _transformer(place)
    files = TensorFiles.find(folder)
    stored = by_diffusers_name(files.files)
    beside = folder if folder.is_dir() else folder.parent
    config = read_config(beside) if (beside / "config.json").is_file() else {}
    if "num_attention_heads" not in config:
        config = config_of_tensors(stored, lambda n: files.shape(stored[n]), stated=config)
    name = config.get("_class_name", COMPONENTS["transformer"])
    if name != COMPONENTS["transformer"]:
        raise CheckpointError(
            f"{folder}: a {name}; expected a {COMPONENTS['transformer']}, such as "
            "Wan2.2-VACE-Fun-A14B's low-noise expert"
        )
    return Source(folder, config, _vae(folder, vae), files, stored)


def _transformer(place: Path) -> Path:
    if place.is_file():
        return place
    for name in ("transformer_2", "low_noise_model"):
        if (place / name).is_dir():
            return place / name
    if (place / "transformer").is_dir():
        if _has_two_experts(place):
            raise CheckpointError(
                f"{place}: no transformer_2, the low-noise expert; transformer is the high-noise "
                "one; download transformer_2 as well"
            )
        return place / "transformer"
    if any(place.glob("*.safetensors*")):
        return place
    raise CheckpointError(
        f"{place}: no Wan VACE weights; expected transformer_2/ (diffusers' form), "
        "low_noise_model/ (Wan's own) or a safetensors file"
    )


def _has_two_experts(place: Path) -> bool:
    index = place / "model_index.json"
    try:
        return json.loads(index.read_text(encoding="utf-8")).get("boundary_ratio") is not None
    except FileNotFoundError:
        return False
    except (OSError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{index}: cannot be read ({error}); download it again") from error


def _vae(transformer: Path, named: Path | None) -> Path:
    places = [transformer / "vae", transformer.parent / "vae", transformer.parent.parent / "vae"]
    places = [named] if named is not None else places
    for place in places:
        if (place / "config.json").is_file():
            return place
    raise CheckpointError(
        f"{places[-1]}: no VAE (config.json and safetensors in diffusers' form); name the folder "
        "vae of any Wan2.1 or Wan2.2-A14B model in that form; Wan2.1_VAE.pth is the same network "
        "in a form that is not read"
    )
