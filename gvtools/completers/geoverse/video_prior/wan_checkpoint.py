"""The frozen video prior's folder of published weights, offline; ``wan_folder`` says what is in it.

Of Wan2.2-VACE-Fun-A14B it takes 14.8 GB in bfloat16 instead of 34.7: the VACE blocks come before
the backbone and depend on its input alone, so the features of blocks 0 to 15 stay what they were,
bit for bit.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gvtools.completers.geoverse.video_prior.wan_files import (
    INDEX,
    TensorFiles,
    check_present,
    check_tensors,
)
from gvtools.completers.geoverse.video_prior.wan_folder import (
    COMPONENTS,
    EMPTY_PROMPT,
    cast,
    dtype_of,
    expected_tensors,
    read_config,
)
from gvtools.completers.geoverse.video_prior.wan_names import by_diffusers_name, config_of_tensors
from gvtools.errors import CheckpointError, OptionError, ProjectError

__all__ = ["expected_tensors", "truncate", "write_empty_prompt"]

_WEIGHTS = "diffusion_pytorch_model"
# Bytes of tensors held in memory at a time, and of one file.
_PART = 2 * 1024**3
_MARGIN = 64 * 1024**2


def write_empty_prompt(text_encoder: Path | str, out: Path | str) -> None:
    """Run Wan's text encoder on the empty prompt, which is the end-of-text token alone, once.

    Args:
        text_encoder: folder of the UMT5 encoder in transformers' form (``text_encoder`` of a Wan
            folder of diffusers); 11.4 GB in bfloat16 for the published one.
        out: the file to write, or the truncated folder that it belongs into.

    Raises:
        CheckpointError: transformers or the text encoder is absent.
    """
    from safetensors.torch import save_file

    folder = Path(text_encoder)
    try:
        from transformers import UMT5EncoderModel

        if not folder.is_dir():
            raise FileNotFoundError(f"{folder} is no folder")
        encoder = UMT5EncoderModel.from_pretrained(folder, local_files_only=True).eval()
    except (ImportError, OSError, ValueError) as error:
        raise CheckpointError(
            f"the empty prompt: {str(error).strip().splitlines()[0]}; expected transformers (pip "
            "install transformers) and the folder of Wan's text encoder"
        ) from error
    tokens = torch.tensor([[encoder.config.eos_token_id]])
    with torch.no_grad():
        embedding = encoder(tokens, attention_mask=torch.ones_like(tokens)).last_hidden_state[0]
    path = Path(out) / EMPTY_PROMPT if Path(out).is_dir() else Path(out)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    save_file({"embedding": embedding.float().contiguous()}, temporary)
    temporary.replace(path)


def truncate(
    source: Path | str,
    out: Path | str,
    *,
    blocks: int = 16,
    vace_blocks: int | None = 4,
    dtype: torch.dtype = torch.bfloat16,
    vae: Path | str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a ``wan_folder`` from published weights; only what is needed is read.

    The folder appears under its name when it is whole. The empty prompt is made separately, by
    ``write_empty_prompt``. At most about 2 GB of tensors are in memory.

    Args:
        source: a Wan VACE folder of diffusers (of two experts the low-noise one, ``transformer_2``,
            is taken), Wan's own folder (``low_noise_model``), a transformer's own folder, or its
            one safetensors file. Of several files only those that hold needed tensors are opened.
        out: the folder to make; it must not be there.
        blocks: backbone blocks to keep.
        vace_blocks: VACE blocks to keep: those that act on the kept blocks. None counts them.
        dtype: of the result, except for what diffusers keeps in float32.
        vae: folder of the VAE in diffusers' form; None looks beside the transformer.
        progress: called with bytes done and in all.

    Raises:
        CheckpointError: the source lacks something, or is of another kind; the first missing
            tensor is named.
        OptionError: numbers of blocks that the source does not have.
        ProjectError: ``out`` is there already, or cannot be written, or the disk is too full.
    """
    from safetensors import SafetensorError

    found, out = find_source(Path(source), None if vae is None else Path(vae)), Path(out)
    if out.exists():
        raise ProjectError(f"{out} is there already; remove it, or choose another folder")
    config = _truncated(found.config, blocks, vace_blocks)
    sizes = _sizes(found, config, dtype)
    copied = _vae_files(found.vae)
    needed = sum(sizes.values()) + sum(path.stat().st_size for path in copied)
    _check_space(out, needed + _MARGIN)
    report = progress or (lambda done, total: None)

    temporary = out.with_name(f".{out.name}.part")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        for component in ("transformer", "vae"):
            (temporary / component).mkdir(parents=True)
        _write_json(temporary / "transformer" / "config.json", config)
        for done in _written(temporary / "transformer", found, sizes, dtype=dtype):
            report(done, needed)
        for path in copied:
            shutil.copyfile(path, temporary / "vae" / path.name)
        temporary.replace(out)
    except (OSError, SafetensorError) as error:
        raise ProjectError(
            f"{out}: cannot be written ({error}); free some space or choose another folder"
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    report(needed, needed)


def _sizes(source: Source, config: Mapping[str, Any], dtype: torch.dtype) -> dict[str, int]:
    """Bytes of every tensor to be written; headers alone are read.

    Raises:
        CheckpointError: the source has not what the configuration asks for.
    """
    expected = expected_tensors(config)
    check_present(expected, source.names, where=source.place)
    for name, shape in expected.items():
        if source.shape(name) != shape:
            raise CheckpointError(
                f"{source.place}: {name} is {source.shape(name)}; expected {shape}; the "
                "configuration belongs to other weights"
            )
    return {name: source.numbers(name) * dtype_of(name, dtype).itemsize for name in expected}


def _vae_files(folder: Path) -> list[Path]:
    """What is copied of the VAE's folder, after a check of names and shapes."""
    files = TensorFiles.find(folder)
    expected = expected_tensors(read_config(folder), component="vae")
    check_tensors(files, expected, where=folder)
    return sorted({folder / "config.json", *files.files.values(), *folder.glob(f"*{INDEX}")})


def _truncated(config: Mapping[str, Any], blocks: int, vace_blocks: int | None) -> dict[str, Any]:
    layers = [layer for layer in config["vace_layers"] if layer < blocks]
    if not 0 < blocks <= config["num_layers"]:
        raise OptionError(
            f"blocks {blocks}; expected 1 to {config['num_layers']}, what the source has"
        )
    if vace_blocks is not None and vace_blocks != len(layers):
        raise OptionError(
            f"vace_blocks {vace_blocks}; expected {len(layers)}: blocks 0 to {blocks - 1} of the "
            f"source get hints at {layers}, and without one of them the features change"
        )
    return {**config, "num_layers": blocks, "vace_layers": layers}


def _written(
    folder: Path, source: Source, sizes: Mapping[str, int], *, dtype: torch.dtype
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


def _check_space(out: Path, needed: int) -> None:
    place = out.parent
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if free < needed:
        raise ProjectError(
            f"{out}: {needed / 1e9:.1f} GB are needed, {free / 1e9:.1f} GB are free; free some "
            "space or choose another folder"
        )


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


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
