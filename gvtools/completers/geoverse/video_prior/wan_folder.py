"""The folder with the frozen video prior, and how it is read.

::

    transformer/config.json, diffusion_pytorch_model*.safetensors   16 of 40 blocks, 4 of 8 VACE
    vae/config.json, diffusion_pytorch_model.safetensors            as published
    empty_prompt.safetensors                                        ``embedding`` (1, 4096)

Both networks are in diffusers' form; ``wan_checkpoint.truncate`` makes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.video_prior.wan_files import (
    TensorFiles,
    check_present,
    check_tensors,
)
from gvtools.completers.geoverse.video_prior.wan_library import empty_network, read_config
from gvtools.completers.geoverse.video_prior.wan_names import kept_in_float32
from gvtools.errors import CheckpointError

EMPTY_PROMPT = "empty_prompt.safetensors"
_MAKER = "gvtools.completers.geoverse.video_prior.wan_checkpoint"


def expected_tensors(
    config: Mapping[str, Any], *, component: str = "transformer"
) -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor that a network's weights have to hold; nothing is allocated.

    Args:
        config: of the truncated folder's ``transformer/config.json`` or ``vae/config.json``.
        component: "transformer" or "vae".

    Raises:
        CheckpointError: diffusers is absent, or makes no network of the config.
    """
    network = empty_network(component, config)
    return {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}


class FolderReport(NamedTuple):
    """A folder in which nothing is amiss.

    Attributes:
        bytes: of its weights.
        said: what it holds, in a line.
    """

    bytes: int
    said: str


def check_folder(folder: Path, *, prompt: bool = True) -> FolderReport:
    """Config, names and shapes of a truncated folder, and its prompt; reads headers alone.

    Args:
        folder: see the module.
        prompt: whether the empty prompt has to be there.

    Raises:
        CheckpointError: what is absent or does not fit.
    """
    size, said = 0, []
    for component in ("transformer", "vae"):
        place = Path(folder) / component
        expected = expected_tensors(read_config(place), component=component)
        files = TensorFiles.find(place)
        check_tensors(files, expected, where=place)
        size += sum(path.stat().st_size for path in set(files.files.values()))
        said.append(f"{component}: {len(expected)} tensors")
    if prompt:
        said.append(f"empty prompt: {tuple(read_empty_prompt(folder).shape)}")
    return FolderReport(size, ", ".join(said))


def load_network(
    folder: Path, component: str, *, dtype: torch.dtype | None = None, device: str = "cpu"
) -> nn.Module:
    """A network of a truncated folder, strictly: every tensor is there and none is left over.

    Args:
        folder: see the module.
        component: "transformer" or "vae".
        dtype: None keeps what is stored. Otherwise what diffusers keeps in float32 is float32 and
            the rest is this.
        device: where to.

    Raises:
        CheckpointError: diffusers, the folder, or a tensor is absent or does not fit.
    """
    place = Path(folder) / component
    network: Any = empty_network(component, read_config(place))
    files = TensorFiles.find(place)
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    check_tensors(files, expected, where=place)
    state = {n: cast(n, files.read(n, device=device), dtype) for n in expected}
    network.load_state_dict(state, assign=True)
    if component == "transformer":
        # Its tables are computed, not stored, and so still on the meta device.
        sizes = network.config
        table = type(network.rope)(
            sizes.attention_head_dim, sizes.patch_size, sizes.rope_max_seq_len
        )
        network.rope = table.to(device)
    return network.requires_grad_(False).eval()


def read_empty_prompt(folder: Path) -> Tensor:
    """What Wan's text encoder gives for the empty prompt, (tokens, channels) as stored.

    Raises:
        CheckpointError: it is absent; the message says how it is made.
    """
    path = Path(folder) / EMPTY_PROMPT
    if not path.is_file():
        raise CheckpointError(
            f"{path} is absent; make it once, where Wan's text encoder is (11 GB, needs pip "
            f'install transformers): python -c "from {_MAKER} import write_empty_prompt; '
            f"write_empty_prompt('WAN/text_encoder', '{path}')\""
        )
    files = TensorFiles.find(path)
    check_present(["embedding"], files.files, where=path)
    embedding = files.read("embedding")
    if embedding.ndim != 2:
        raise CheckpointError(
            f"{path}: embedding {tuple(embedding.shape)}; expected (tokens, channels)"
        )
    return embedding


def cast(name: str, tensor: Tensor, dtype: torch.dtype | None) -> Tensor:
    """A tensor of the transformer in the dtype it is used in; None leaves it as it is."""
    return tensor if dtype is None else tensor.to(dtype_of(name, dtype))


def dtype_of(name: str, dtype: torch.dtype) -> torch.dtype:
    """``dtype``, or float32 where diffusers keeps that beside smaller types."""
    return torch.float32 if kept_in_float32(name) else dtype
