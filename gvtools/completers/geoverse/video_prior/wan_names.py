"""Wan's original tensor names in diffusers' terms, and what the tensors tell of the network."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from gvtools.errors import CheckpointError

# Whole parts between dots. diffusers numbers the norms in another order; only this one has weights.
_PARTS = {
    "self_attn": "attn1",
    "cross_attn": "attn2",
    "q": "to_q",
    "k": "to_k",
    "v": "to_v",
    "o": "to_out.0",
    "norm3": "norm2",
    "modulation": "scale_shift_table",
    "before_proj": "proj_in",
    "after_proj": "proj_out",
}
_STARTS = {
    "text_embedding.0.": "condition_embedder.text_embedder.linear_1.",
    "text_embedding.2.": "condition_embedder.text_embedder.linear_2.",
    "time_embedding.0.": "condition_embedder.time_embedder.linear_1.",
    "time_embedding.2.": "condition_embedder.time_embedder.linear_2.",
    "time_projection.1.": "condition_embedder.time_proj.",
    "head.head.": "proj_out.",
    "head.": "",
}
_FEED_FORWARD = {"ffn.0": "ffn.net.0.proj", "ffn.2": "ffn.net.2"}
# Files for ComfyUI put this before every name.
_WRAPPER = "model.diffusion_model."
_FLOAT32 = frozenset({"time_embedder", "scale_shift_table", "norm1", "norm2", "norm3"})
# Every published Wan has heads of this width; the tensors do not show it.
_HEAD_WIDTH = 128


def kept_in_float32(name: str) -> bool:
    """Whether diffusers keeps a tensor (by its diffusers name) in float32 beside bfloat16."""
    return not _FLOAT32.isdisjoint(name.split("."))


def diffusers_name(original: str) -> str:
    """A tensor's name in diffusers, of its name in Wan's own code."""
    name = original.removeprefix(_WRAPPER)
    for start, replacement in _STARTS.items():
        if name.startswith(start):
            name = replacement + name[len(start) :]
            break
    for old, new in _FEED_FORWARD.items():
        name = name.replace(f".{old}.", f".{new}.")
    return ".".join(_PARTS.get(part, part) for part in name.split("."))


def by_diffusers_name(names: Iterable[str]) -> dict[str, str]:
    """Stored names by diffusers name; names that are diffusers' already stay as they are."""
    stored = list(names)
    if any(".self_attn." in name for name in stored):
        return {diffusers_name(name): name for name in stored}
    return {name: name for name in stored}


def config_of_tensors(
    names: Iterable[str],
    shape: Callable[[str], tuple[int, ...]],
    *,
    stated: Mapping[str, Any],
) -> dict[str, Any]:
    """The transformer's diffusers config, of its tensors.

    Args:
        names: diffusers names of all tensors.
        shape: a tensor's shape by diffusers name.
        stated: Wan's own config.json where there is one; of it ``num_heads``, ``eps`` and
            ``vace_layers`` are taken, which no shape shows. Without it they are what all
            published Wan VACE networks have: heads of 128, 1e-6, evenly spread.

    Raises:
        CheckpointError: these are not the tensors of a Wan VACE transformer.
    """
    names = set(names)
    layers, hints = _count("blocks", names), _count("vace_blocks", names)
    try:
        width, channels, *patch = shape("patch_embedding.weight")
        config = {
            "_class_name": "WanVACETransformer3DModel",
            "patch_size": list(patch),
            "in_channels": channels,
            "out_channels": shape("proj_out.weight")[0] // max(1, _product(patch)),
            "text_dim": shape("condition_embedder.text_embedder.linear_1.weight")[1],
            "freq_dim": shape("condition_embedder.time_embedder.linear_1.weight")[1],
            "ffn_dim": shape("blocks.0.ffn.net.0.proj.weight")[0],
            "vace_in_channels": shape("vace_patch_embedding.weight")[1],
        }
    except (KeyError, ValueError) as error:
        raise CheckpointError(
            f"not a whole Wan VACE transformer: no {error}; expected Wan2.2-VACE-Fun-A14B's "
            "low-noise weights, or those of another Wan VACE"
        ) from error
    heads = stated.get("num_heads") or max(1, width // _HEAD_WIDTH)
    return {
        **config,
        "num_layers": layers,
        "num_attention_heads": heads,
        "attention_head_dim": width // heads,
        "cross_attn_norm": "blocks.0.norm2.weight" in names,
        "eps": stated.get("eps", 1e-6),
        "vace_layers": _hint_layers(stated.get("vace_layers"), layers, hints),
    }


def _count(group: str, names: set[str]) -> int:
    pattern = re.compile(rf"{group}\.(\d+)\.")
    found = [int(match[1]) for match in map(pattern.match, names) if match]
    return 1 + max(found, default=-1)


def _product(numbers: Iterable[int]) -> int:
    product = 1
    for number in numbers:
        product *= number
    return product


def _hint_layers(stated: Any, layers: int, hints: int) -> list[int]:
    if isinstance(stated, (list, tuple)):
        return [int(layer) for layer in stated]
    if hints == 0 or layers % hints:
        raise CheckpointError(
            f"{layers} blocks and {hints} VACE blocks, which cannot be spread evenly; put the "
            "config.json that names vace_layers beside the weights"
        )
    return list(range(0, layers, layers // hints))
