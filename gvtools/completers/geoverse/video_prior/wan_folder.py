"""The folder with the frozen video prior, and how it is read.

::

    transformer/config.json, diffusion_pytorch_model*.safetensors   16 of 40 blocks, 4 of 8 VACE
    vae/config.json, diffusion_pytorch_model.safetensors            as published
    empty_prompt.safetensors                                        ``embedding`` (1, 4096)

Both networks are in diffusers' form; ``wan_checkpoint.truncate`` makes the folder. diffusers is
imported when first needed; no pipeline and no scheduler of it is used, and so no transformers.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.video_prior.wan_files import (
    TensorFiles,
    check_present,
    check_tensors,
)
from gvtools.completers.geoverse.video_prior.wan_names import kept_in_float32
from gvtools.errors import CheckpointError

COMPONENTS = {"transformer": "WanVACETransformer3DModel", "vae": "AutoencoderKLWan"}
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
        summary: what it holds, in a line.
    """

    bytes: int
    summary: str


def check_folder(folder: Path, *, prompt: bool = True) -> FolderReport:
    """Config, names and shapes of a truncated folder, and its prompt; reads headers alone.

    Args:
        folder: see the module.
        prompt: whether the empty prompt has to be there.

    Raises:
        CheckpointError: what is absent or does not fit.
    """
    size, found = 0, []
    for component in ("transformer", "vae"):
        place = Path(folder) / component
        expected = expected_tensors(read_config(place), component=component)
        files = TensorFiles.find(place)
        check_tensors(files, expected, where=place)
        size += sum(path.stat().st_size for path in set(files.files.values()))
        found.append(f"{component}: {len(expected)} tensors")
    if prompt:
        found.append(f"empty prompt: {tuple(read_empty_prompt(folder).shape)}")
    return FolderReport(size, ", ".join(found))


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


def network_class(component: str) -> Any:
    """The class of "transformer" or "vae".

    Raises:
        CheckpointError: diffusers is absent, too old, or does not work.
    """
    name = COMPONENTS[component]
    with _broken_torchvision_hidden() as hidden:
        try:
            import diffusers
            from diffusers.utils import import_utils

            if hidden:
                # Whoever imported diffusers before has let it believe otherwise.
                import_utils._torchvision_available = False
            return getattr(diffusers, name)
        except (ImportError, AttributeError, RuntimeError) as error:
            raise CheckpointError(
                f"the video prior needs diffusers' {name}, which cannot be imported "
                f"({str(error).strip().splitlines()[-1]}); pip install 'gvtools[wan]', or switch "
                "the video prior off"
            ) from error


def empty_network(component: str, config: Mapping[str, Any]) -> nn.Module:
    """A network of a diffusers config, on the meta device: shapes, no numbers, no memory.

    Args:
        component: "transformer" or "vae".
        config: as in the component's config.json.

    Raises:
        CheckpointError: diffusers is absent, or makes no network of the config.
    """
    kind = network_class(component)
    try:
        with torch.device("meta"):
            network: nn.Module = kind.from_config(dict(config))
    except Exception as error:
        raise CheckpointError(
            f"no {COMPONENTS[component]} comes of this configuration ({error}); take the "
            "config.json that belongs to the weights"
        ) from error
    return network


def read_config(folder: Path) -> dict[str, Any]:
    """A component's config.json.

    Raises:
        CheckpointError: absent, or not a JSON object.
    """
    path = folder / "config.json"
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error.strerror or error}); expected the config.json of a "
            "network in diffusers' form"
        ) from error
    except ValueError as error:
        raise CheckpointError(f"{path}: not JSON ({error}); download it again") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{path}: a {type(config).__name__}; expected a JSON object")
    return config


@contextmanager
def _broken_torchvision_hidden() -> Iterator[bool]:
    """Where torchvision does not fit torch, diffusers would fail on it, and can do without.

    Gives whether that is so.
    """
    try:
        import torchvision  # noqa: F401
    except Exception:
        for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
            del sys.modules[name]
        # None makes the import system, and diffusers with it, take the package as not installed.
        sys.modules["torchvision"] = None  # type: ignore[assignment]
        try:
            yield True
        finally:
            del sys.modules["torchvision"]
        return
    yield False
