"""The video prior's folder (see ``wan.py``), made offline from published weights.

Of Wan2.2-VACE-Fun-A14B it takes 14.8 GB in bfloat16 instead of 34.7: the VACE blocks come before
the backbone and depend on its input alone, so the features of blocks 0 to 15 stay what they were,
bit for bit.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from math import prod
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gvtools.completers.geoverse.wan import (
    COMPONENTS,
    EMPTY_PROMPT,
    cast,
    dtype_of,
    expected_tensors,
    network_class,
    read_config,
)
from gvtools.errors import CheckpointError, OptionError, ProjectError
from gvtools.files import check_space, replaced_when_written
from gvtools.networks.tensors import INDEX, TensorFiles, check_fit, plain_tensors, read_pickled
from gvtools.untrusted import read_json

_WEIGHTS = "diffusion_pytorch_model"
# Of Wan's own release.
VAE_FILE, TEXT_FILE = "Wan2.1_VAE.pth", "models_t5_umt5-xxl-enc-bf16.pth"
# Bytes of tensors held in memory at a time, and of one file.
_PART = 2 * 1024**3
_MARGIN = 64 * 1024**2
# Every published Wan has heads of this width; the tensors do not show it.
_HEAD_WIDTH = 128


def write_empty_prompt(text_encoder: Path | str, out: Path | str) -> None:
    """Wan's text encoder on the empty prompt, which is the end-of-text token alone, once.

    ``text_encoder`` is Wan's own file (11.4 GB), its folder, or the encoder in the form of
    transformers; ``out`` the truncated folder that the prompt belongs into.
    """
    from safetensors.torch import save_file

    embedding = _end_token(Path(text_encoder))
    with replaced_when_written(Path(out) / EMPTY_PROMPT) as path:
        save_file({"embedding": embedding[None].contiguous()}, path)


# Tensors of UMT5 by Wan's own names and by those of transformers.
_TEXT = {
    "embedding": ("token_embedding", "shared"),
    "norm1": ("blocks.{}.norm1", "encoder.block.{}.layer.0.layer_norm"),
    "v": ("blocks.{}.attn.v", "encoder.block.{}.layer.0.SelfAttention.v"),
    "o": ("blocks.{}.attn.o", "encoder.block.{}.layer.0.SelfAttention.o"),
    "norm2": ("blocks.{}.norm2", "encoder.block.{}.layer.1.layer_norm"),
    "gate": ("blocks.{}.ffn.gate.0", "encoder.block.{}.layer.1.DenseReluDense.wi_0"),
    "in": ("blocks.{}.ffn.fc1", "encoder.block.{}.layer.1.DenseReluDense.wi_1"),
    "out": ("blocks.{}.ffn.fc2", "encoder.block.{}.layer.1.DenseReluDense.wo"),
    "norm": ("norm", "encoder.final_layer_norm"),
}
_END = 1  # the number of the end-of-text token


def _end_token(place: Path) -> Tensor:
    """The encoding of the one token: attention to oneself is one's own value, at any position."""
    file = place / TEXT_FILE if place.is_dir() else place
    if file.is_file():
        stored = plain_tensors(read_pickled(file, legacy=True), file)
        names, take, form = set(stored), stored.__getitem__, 0
    elif place.is_dir() and any(place.glob("*.safetensors")):
        files = TensorFiles.find(place)
        names, take, form = set(files.places), files.read, 1
    else:
        raise CheckpointError(
            f"{place}: no text encoder; expected {TEXT_FILE} of Wan, or the encoder's folder in "
            "transformers' form"
        )

    def weight(part: str, block: int = 0) -> Tensor:
        name = f"{_TEXT[part][form].format(block)}.weight"
        if name not in names:
            raise CheckpointError(f"{place}: no {name}; expected Wan's whole text encoder, UMT5")
        return take(name)

    def normed(x: Tensor, scale: Tensor) -> Tensor:
        return F.rms_norm(x, x.shape, scale.float(), 1e-6)

    start = _TEXT["norm1"][form].partition("{}")[0]
    x = weight("embedding")[_END].float()
    for block in range(len({name.removeprefix(start).partition(".")[0] for name in names
                            if name.startswith(start)})):  # fmt: skip
        y = normed(x, weight("norm1", block))
        x = x + weight("o", block).float() @ (weight("v", block).float() @ y)
        y = normed(x, weight("norm2", block))
        gate = F.gelu(weight("gate", block).float() @ y, approximate="tanh")
        x = x + weight("out", block).float() @ (gate * (weight("in", block).float() @ y))
    return normed(x, weight("norm"))


def truncate(
    # A Wan VACE folder of diffusers (of two experts the low-noise one, ``transformer_2``, is
    # taken), Wan's own folder (``low_noise_model``), a transformer's own folder, or its one
    # safetensors file. Of several files only those that hold needed tensors are opened.
    source: Path | str,
    out: Path | str,  # the folder to make; it must not be there
    *,
    blocks: int = 16,  # backbone blocks to keep, and with them the VACE blocks that act on them
    # Of the result, except for what diffusers keeps in float32.
    dtype: torch.dtype = torch.bfloat16,
    # Folder of the VAE in diffusers' form, or Wan's own file; None looks beside the transformer.
    vae: Path | str | None = None,
    # Called with bytes done and in all.
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a folder of the video prior from published weights; only what is needed is read.

    The folder appears under its name when it is whole. The empty prompt is made separately, by
    ``write_empty_prompt``. At most about 2 GB of tensors are in memory.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    place, out = _transformer(Path(source)), Path(out)
    if out.exists():
        raise ProjectError(f"{out} is there already; remove it, or choose another folder")
    files, config = _network(place, blocks)
    expected = expected_tensors(config)
    check_fit(files.empty(expected), expected, where=place)
    sizes = {n: prod(shape) * dtype_of(n, dtype).itemsize for n, shape in expected.items()}
    found = _vae(place, vae)
    own = _own_vae(found) if found.is_file() else None
    copied = _vae_files(found) if own is None else []
    needed = sum(sizes.values()) + sum(path.stat().st_size for path in copied or [found])
    check_space(out.parent, needed + _MARGIN)

    temporary = out.with_name(f".{out.name}.part")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        for component in COMPONENTS:
            (temporary / component).mkdir(parents=True)
        _write_json(temporary / "transformer" / "config.json", config)
        for done in _write(temporary / "transformer", files, sizes, dtype=dtype):
            progress(done, needed)
        if own is not None:
            _write_json(temporary / "vae" / "config.json", own[0])
            about = {"format": "pt"}
            save_file(own[1], temporary / "vae" / f"{_WEIGHTS}.safetensors", metadata=about)
        for path in copied:
            shutil.copyfile(path, temporary / "vae" / path.name)
        temporary.replace(out)
    except (OSError, SafetensorError) as error:
        raise ProjectError(
            f"{out}: cannot be written ({error}); free some space or choose another folder"
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    progress(needed, needed)


def _vae_files(folder: Path) -> list[Path]:
    """What is copied of the VAE's folder, after a check of names and shapes."""
    files = TensorFiles.find(folder)
    check_fit(files.empty(), expected_tensors(read_config(folder), component="vae"), where=folder)
    return sorted({folder / "config.json", *files.paths, *folder.glob(f"*{INDEX}")})


def _own_vae(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Diffusers' config and tensors of Wan's own VAE file, after a check of names and shapes."""
    network_class("vae")  # diffusers, or an error that says what is absent
    from diffusers.loaders.single_file_utils import convert_wan_vae_to_diffusers

    stored = plain_tensors(read_pickled(path, legacy=True), path)
    tensors = {n: t.contiguous() for n, t in convert_wan_vae_to_diffusers(stored).items()}
    config: dict[str, Any] = {"_class_name": COMPONENTS["vae"]}
    for key, name in (("base_dim", "encoder.conv_in.weight"), ("z_dim", "post_quant_conv.weight")):
        if name in tensors:
            config[key] = len(tensors[name])
    check_fit(tensors, expected_tensors(config, component="vae"), where=path)
    return config, tensors


def _write(
    folder: Path, source: TensorFiles, sizes: Mapping[str, int], *, dtype: torch.dtype
) -> Iterator[int]:
    """Writes the tensors, part by part, and gives the bytes that are done."""
    from safetensors.torch import save_file

    parts: list[list[str]] = [[]]
    for name, size in sizes.items():
        if parts[-1] and sum(sizes[n] for n in parts[-1]) + size > _PART:
            parts.append([])
        parts[-1].append(name)
    files: dict[str, str] = {}
    written = 0
    for number, names in enumerate(parts, start=1):
        part = f"-{number:05d}-of-{len(parts):05d}" if len(parts) > 1 else ""
        file = f"{_WEIGHTS}{part}.safetensors"
        tensors = {n: cast(n, source.read(n), dtype).contiguous() for n in names}
        save_file(tensors, folder / file, metadata={"format": "pt"})
        files |= dict.fromkeys(names, file)
        written += sum(sizes[n] for n in names)
        yield written
    if len(parts) > 1:
        index = {"metadata": {"total_size": sum(sizes.values())}, "weight_map": files}
        _write_json(folder / f"{_WEIGHTS}{INDEX}", index)


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _network(folder: Path, blocks: int) -> tuple[TensorFiles, dict[str, Any]]:
    """A transformer's tensors by diffusers' names, and its config cut to its first blocks."""
    files = TensorFiles.find(folder)
    files = files.renamed(by_diffusers_name(files.places))
    beside = folder if folder.is_dir() else folder.parent
    config = read_config(beside) if (beside / "config.json").is_file() else {}
    if "num_attention_heads" not in config:
        config = _config_of_tensors(files, stated=config)
    name = config.get("_class_name", COMPONENTS["transformer"])
    if name != COMPONENTS["transformer"]:
        raise CheckpointError(
            f"{folder}: a {name}; expected a {COMPONENTS['transformer']}, such as "
            "Wan2.2-VACE-Fun-A14B's low-noise expert"
        )
    if not 0 < blocks <= config["num_layers"]:
        raise OptionError(
            f"blocks {blocks}; expected 1 to {config['num_layers']}, what the source has"
        )
    hints = [layer for layer in config["vace_layers"] if layer < blocks]
    return files, {**config, "num_layers": blocks, "vace_layers": hints}


def by_diffusers_name(names: Iterable[str]) -> dict[str, str]:
    """Stored names by diffusers name; names that are diffusers' already stay as they are."""
    stored = {name: name for name in names}
    if not any(".self_attn." in name for name in stored):
        return stored
    network_class("transformer")  # diffusers, or an error that says what is absent
    from diffusers.loaders.single_file_utils import convert_wan_transformer_to_diffusers

    # It renames the keys of a dictionary of tensors, and looks at no tensor of this network.
    plain = {name.removeprefix("model.diffusion_model."): name for name in stored}
    converted: dict[str, str] = convert_wan_transformer_to_diffusers(plain)
    return converted


def _config_of_tensors(files: TensorFiles, *, stated: Mapping[str, Any]) -> dict[str, Any]:
    """The transformer's diffusers config, of its tensors by diffusers' names.

    Of Wan's own config.json, where ``stated``, num_heads, eps and vace_layers are taken, which no
    shape shows; else they are what all published Wan VACE networks have.
    """
    sides = {
        "ffn_dim": ("blocks.0.ffn.net.0.proj.weight", 0),
        "freq_dim": ("condition_embedder.time_embedder.linear_1.weight", 1),
        "in_channels": ("patch_embedding.weight", 1),
        "text_dim": ("condition_embedder.text_embedder.linear_1.weight", 1),
        "vace_in_channels": ("vace_patch_embedding.weight", 1),
        "width": ("patch_embedding.weight", 0),
    }
    found = files.empty(name for name, _ in sides.values())
    for name, _ in sides.values():
        if name not in found or found[name].ndim < 2:
            raise CheckpointError(
                f"not a whole Wan VACE transformer: no {name}; expected Wan2.2-VACE-Fun-A14B's "
                "low-noise weights, or those of another Wan VACE"
            )
    config = {key: found[name].shape[side] for key, (name, side) in sides.items()}
    width = config.pop("width")
    heads = stated.get("num_heads") or max(1, width // _HEAD_WIDTH)
    layers, hints = (_count(group, files.places) for group in ("blocks", "vace_blocks"))
    vace_layers = stated.get("vace_layers")
    if vace_layers is None:
        if hints == 0 or layers % hints:
            raise CheckpointError(
                f"{layers} blocks and {hints} VACE blocks, which cannot be spread evenly; put the "
                "config.json that names vace_layers beside the weights"
            )
        vace_layers = list(range(0, layers, layers // hints))
    return {
        "_class_name": COMPONENTS["transformer"],
        **config,
        "out_channels": config["in_channels"],
        "num_layers": layers,
        "num_attention_heads": heads,
        "attention_head_dim": width // heads,
        "eps": stated.get("eps", 1e-6),
        "vace_layers": vace_layers,
    }


def _count(group: str, names: Iterable[str]) -> int:
    found = [int(match[1]) for match in (re.match(rf"{group}\.(\d+)\.", n) for n in names) if match]
    return 1 + max(found, default=-1)


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
        return read_json(index).get("boundary_ratio") is not None
    except FileNotFoundError:
        return False
    except (OSError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{index}: cannot be read ({error}); download it again") from error


def _vae(transformer: Path, named: Path | str | None) -> Path:
    beside = [transformer, transformer.parent, transformer.parent.parent]
    places = [Path(named)] if named is not None else [folder / "vae" for folder in beside]
    for place in places:
        if (place / "config.json").is_file() or place.is_file():
            return place
    for folder in beside if named is None else places:
        if (folder / VAE_FILE).is_file():
            return folder / VAE_FILE
    raise CheckpointError(
        f"{places[-1]}: no VAE; expected {VAE_FILE} of Wan, or the folder vae of any Wan2.1 or "
        "Wan2.2-A14B model in diffusers' form"
    )
