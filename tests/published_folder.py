"""A weights folder as one downloads it, of a small model: the published layout, other sizes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from gvtools.completers.geoverse.config_json import to_json
from gvtools.completers.geoverse.model import GeoVerse

GEOMETRY = Path("pretrained_models/da3/model.safetensors")
LEVEL1 = Path("checkpoints/da3_level1.pt")
CASCADE = Path("checkpoints/da3_cascade.pt")
RGB_HEAD = Path("pretrained_models/mae_decoder.pt")
DPT_HEAD = Path("pretrained_models/da3/dpt_decoder.pt")
STATISTICS = tuple(Path(f"model_stats/da3/normalization_stats_level{i}.pt") for i in (0, 1))
FILES = (GEOMETRY, LEVEL1, CASCADE, RGB_HEAD, *STATISTICS)


def tie_ray_norms(model: GeoVerse) -> GeoVerse:
    """Depth Anything 3 has one LayerNorm in all four ray outputs."""
    outputs: Any = model.geometry.head.scratch.output_conv2_aux
    for output in list(outputs)[1:]:
        output[2].load_state_dict(outputs[0][2].state_dict())
    return model


def part_of(model: GeoVerse, start: str) -> dict[str, Tensor]:
    """A module's tensors by their own names, without what GeoVerse adds."""
    return {
        name.removeprefix(start): tensor
        for name, tensor in model.state_dict().items()
        if name.startswith(start) and ".depth_embedder." not in name
    }


def write_published(model: GeoVerse, folder: Path) -> Path:
    """Every file as its publisher has it, and a config.json with the sizes."""
    tie_ray_norms(model)
    for file in FILES:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
    geometry = {
        f"model.{name}": tensor
        for name, tensor in part_of(model, "geometry.").items()
        # safetensors keep one name of a shared tensor.
        if not any(f"output_conv2_aux.{level}.2." in name for level in (1, 2, 3))
    }
    save_file(geometry, folder / GEOMETRY)
    torch.save({"ema": part_of(model, "level1.")}, folder / LEVEL1)
    if model.cascade is not None:
        torch.save({"ema": part_of(model, "cascade.")}, folder / CASCADE)
    head = {f"decoder.{name}": tensor for name, tensor in part_of(model, "rgb_head.").items()}
    torch.save({"ema": {**head, "encoder.mask": torch.zeros(3)}}, folder / RGB_HEAD)
    for level, file in enumerate(STATISTICS):
        known = part_of(model, f"statistics.{level}.")
        mean, var = (known[name].view(1, -1, 1, 1) for name in ("mean", "var"))
        stored = {"mean": mean, "var": var, "std": var.sqrt(), "count": 179_568_640, "level": level}
        torch.save(stored, folder / file)
    (folder / "config.json").write_text(json.dumps(to_json(model.config)))
    return folder


def write_dpt_head(model: GeoVerse, folder: Path) -> dict[str, Tensor]:
    """GLD's own geometry head, with other numbers, and part of the backbone in the same file."""
    head = {
        name: tensor + 1 for name, tensor in part_of(tie_ray_norms(model), "geometry.head.").items()
    }
    stored = {
        f"{'pred' if name.startswith('scratch') else 'decoder'}.{name}": tensor
        for name, tensor in head.items()
    }
    torch.save({"model": {**stored, "encoder.cls_token": torch.zeros(3)}}, folder / DPT_HEAD)
    return head
