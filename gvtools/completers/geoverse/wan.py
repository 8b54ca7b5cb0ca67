"""Wan's VAE and VACE transformer, frozen, and the folder that they are read from.

::

    transformer/config.json, diffusion_pytorch_model*.safetensors   16 of 40 blocks, 4 of 8 VACE
    vae/config.json, diffusion_pytorch_model.safetensors            as published
    empty_prompt.safetensors                                        ``embedding`` (1, 4096)

Both networks are in diffusers' form; ``wan_checkpoint.truncate`` makes the folder. diffusers is
imported when first needed; no pipeline and no scheduler of it is used, and so no transformers.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gvtools.errors import CheckpointError
from gvtools.networks.compute import constant, on_device
from gvtools.networks.config_json import check_range
from gvtools.networks.tensors import Shapes, TensorFiles, check_fit, shapes, shapes_alone
from gvtools.untrusted import read_json

# More is no model, but a file that keeps a machine busy.
MOST_BLOCKS = 1000
# Pictures that the VAE encodes at once on a GPU: a pass of base still fits a card of 24 GB.
AT_ONCE = 2
STRIDE = 8  # pixels of a latent's edge
PATCH = (1, 2, 2)  # latents of a token
COMPONENTS = {"transformer": "WanVACETransformer3DModel", "vae": "AutoencoderKLWan"}
EMPTY_PROMPT = "empty_prompt.safetensors"
# Of the transformer, in the order in which they run.
BLOCKS = ("vace_blocks", "blocks")
_FLOAT32 = frozenset({"time_embedder", "scale_shift_table", "norm1", "norm2", "norm3"})


class WanNetworks:
    """Diffusers' WanVACETransformer3DModel and AutoencoderKLWan as two functions, with one prompt.

    ``prompt`` (tokens, channels), or zeros, is what the transformer always gets as text, padded to
    ``prompt_rows`` with zeros that take part in attention, as in Wan's training.
    """

    def __init__(
        self, transformer: Any, vae: Any, *, prompt: Tensor | None, prompt_rows: int = 512
    ) -> None:
        self.transformer = transformer.requires_grad_(False).eval()
        self.vae = vae.requires_grad_(False).eval()
        # One clip at a time: its latent does not depend on its company, to the last bit.
        self.vae.enable_slicing()
        model, sizes = transformer.config, vae.config
        prompt = torch.zeros(1, model.text_dim) if prompt is None else prompt
        for what, found, expected in (
            ("token", tuple(model.patch_size), PATCH),
            ("latent channels", model.in_channels, sizes.z_dim),
            ("VACE channels", model.vace_in_channels, 2 * sizes.z_dim + STRIDE**2),
            ("VAE stride", sizes.scale_factor_spatial, STRIDE),
            ("prompt", tuple(prompt.shape), (min(len(prompt), prompt_rows), model.text_dim)),
        ):
            if found != expected:
                raise CheckpointError(
                    f"video prior: {what} {found}; expected {expected}; transformer, VAE and "
                    "prompt are not of one model"
                )
        self.prompt = torch.zeros(prompt_rows, model.text_dim)
        self.prompt[: len(prompt)] = prompt

    @property
    def blocks(self) -> int:
        """Of the backbone."""
        return len(self.transformer.blocks)

    @property
    def channels(self) -> int:
        """Of a token."""
        model = self.transformer.config
        return int(model.num_attention_heads * model.attention_head_dim)

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return torch.device(self.transformer.patch_embedding.weight.device)

    @property
    def dtype(self) -> torch.dtype:
        """Of the transformer's large weights and of its tokens."""
        dtype: torch.dtype = self.transformer.patch_embedding.weight.dtype
        return dtype

    def to(self, device: torch.device | str) -> None:
        """Move the weights; their dtype stays, since some are float32 on purpose."""
        self.transformer.to(device)
        self.vae.to(device)

    def _tensors(self) -> list[Tensor]:
        return [*_tensors(self.transformer), *_tensors(self.vae)]

    def pin(self) -> None:
        """Lock the weights in the host's memory as far as it lets, for cards to fetch sooner."""
        with suppress(RuntimeError):
            for tensor in self._tensors():
                tensor.data = tensor.data.pin_memory()

    @contextmanager
    def lent(self, device: torch.device | None) -> Iterator[None]:
        """On another device within the block, where only copies go: nothing is brought back.

        Of the transformer's blocks two are there at a time, see ``Visits``.
        """
        if device is None or device == self.device:
            yield
            return
        lists = {name: getattr(self.transformer, name) for name in BLOCKS}
        visits = Visits([block for blocks in lists.values() for block in blocks], device)
        turns = iter(range(len(visits.blocks)))
        try:
            for name, blocks in lists.items():
                visitors = [Visitor(visits, next(turns)) for _ in blocks]
                setattr(self.transformer, name, nn.ModuleList(visitors))
            tensors = self._tensors()
            copies = [tensor.data.to(device, non_blocking=True) for tensor in tensors]
            with _held(tensors, copies):
                visits.fetch(0)
                yield
        finally:
            visits.wait()
            for name, blocks in lists.items():
                setattr(self.transformer, name, blocks)

    def encode(self, clips: Tensor) -> Tensor:
        """(N, 16, 1 + k, H / 8, W / 8) float32: the mode of the VAE's latents, normalised.

        Clips are (N, 3, 4k + 1, H, W) in [-1, 1].
        """
        clips = clips.to(self.vae.dtype)
        if clips.shape[2] == 1 and self.vae.config.get("patch_size") is None:
            latents = self._still(clips).float()
        else:
            latents = self.vae.encode(clips).latent_dist.mode().float()
        mean, deviation = (
            constant(self.vae.config[name], latents).view(-1, 1, 1, 1)
            for name in ("latents_mean", "latents_std")
        )
        return torch.sub(latents, mean) / deviation

    def _still(self, clips: Tensor) -> Tensor:
        """The mode for clips of one frame: of every kernel in time, the last tap alone sees it."""
        encoder, last = self.vae.encoder, self.vae.quant_conv
        flat = [part for part in encoder.modules() if isinstance(part, nn.Conv3d)] + [last]
        # On a CPU one at a time, as ``enable_slicing`` has it.
        parts = clips.split(1)
        if clips.device.type == "cuda":
            parts = clips.contiguous(memory_format=torch.channels_last_3d).split(AT_ONCE)
        try:
            for convolution in flat:
                convolution.forward = partial(_last_tap, convolution)
            moments = torch.cat([last(encoder(part)) for part in parts])
        finally:
            for convolution in flat:
                del convolution.forward
        return moments.chunk(2, dim=1)[0]

    def block_outputs(
        self, x: Tensor, condition: Tensor, *, timestep: float, blocks: Sequence[int]
    ) -> list[Tensor]:
        """(B, F, h / 2, w / 2, C) of each of some blocks in one forward, their VACE hints included.

        ``x`` (B, 16, F, h, w) are noised latents, ``condition`` (B, 96, F, h, w) is of the VACE
        branch, ``timestep`` 0 to 1000.
        """
        after = [*self.transformer.blocks[1:], self.transformer.norm_out]
        taken: dict[int, Tensor] = {}
        hooks = []
        for block in blocks:
            # diffusers adds the hint behind the block: what enters the next one includes it.
            def keep(_: nn.Module, entering: tuple[Tensor, ...], block: int = block) -> None:
                taken[block] = entering[0].to(self.dtype)

            hooks.append(after[block].register_forward_pre_hook(keep))
        prompt = on_device(self.prompt, x.device, dtype=self.dtype).expand(len(x), -1, -1)
        try:
            self.transformer(
                hidden_states=x.to(self.dtype),
                timestep=x.new_full((len(x),), timestep),
                encoder_hidden_states=prompt,
                control_hidden_states=condition.to(self.dtype),
                return_dict=False,
            )
        finally:
            for hook in hooks:
                hook.remove()
        frames, rows, columns = (n // p for n, p in zip(x.shape[2:], PATCH, strict=True))
        return [taken[block].unflatten(1, (frames, rows, columns)) for block in blocks]


class Visits:
    """Blocks on a device for their own turns alone; while one runs, the next one's weights come."""

    def __init__(self, blocks: Sequence[nn.Module], device: torch.device) -> None:
        self.blocks = blocks
        self.device = device
        self.coming: list[Tensor] = []
        self.aside = torch.cuda.Stream(device) if device.type == "cuda" else None

    def fetch(self, turn: int) -> None:
        """Begin to copy a block's weights."""
        home = [tensor.data for tensor in _tensors(self.blocks[turn])]
        self.coming = [torch.empty_like(data, device=self.device) for data in home]
        if self.aside is not None:
            # An earlier block, whose memory this may be, has to be done with it.
            self.aside.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(self.aside):  # None: no other one
            for copy, data in zip(self.coming, home, strict=True):
                copy.copy_(data, non_blocking=True)

    def wait(self) -> None:
        """What the device is asked from here on comes after the copies that were begun."""
        if self.aside is not None:
            torch.cuda.current_stream(self.device).wait_stream(self.aside)

    def run(self, turn: int, *inputs: Any) -> Any:
        """A block, in its turn."""
        self.wait()
        here = self.coming
        if turn + 1 < len(self.blocks):
            self.fetch(turn + 1)
        with _held(_tensors(self.blocks[turn]), here):
            return self.blocks[turn](*inputs)


class Visitor(nn.Module):
    """Stands for a block that visits; the block's weights are not among its own."""

    def __init__(self, visits: Visits, turn: int) -> None:
        super().__init__()
        self.run = partial(visits.run, turn)

    def forward(self, *inputs: Any) -> Any:
        """What the block gives."""
        return self.run(*inputs)


def _tensors(network: nn.Module) -> list[Tensor]:
    return [*network.parameters(), *network.buffers()]


@contextmanager
def _held(tensors: Sequence[Tensor], data: Sequence[Tensor]) -> Iterator[None]:
    """Other numbers in tensors within the block."""
    home = [tensor.data for tensor in tensors]
    try:
        for tensor, other in zip(tensors, data, strict=True):
            tensor.data = other
        yield
    finally:
        for tensor, own in zip(tensors, home, strict=True):
            tensor.data = own


def _last_tap(convolution: Any, x: Tensor, cache_x: Tensor | None = None) -> Tensor:
    """A causal convolution of diffusers' VAE on (N, C, 1, H, W), as a convolution of pictures."""
    weight = convolution.weight[:, :, -1]
    if x.device.type == "cuda":
        weight = weight.contiguous(memory_format=torch.channels_last)
    padding = getattr(convolution, "_padding", (0,) * 6)
    y = F.conv2d(
        x[:, :, 0], weight, convolution.bias, convolution.stride[1:], (padding[2], padding[0])
    )
    return y[:, :, None]


def expected_tensors(config: Mapping[str, Any], *, component: str = "transformer") -> Shapes:
    """Name and shape of every tensor that a network's weights have to hold."""
    return shapes(empty_network(component, config).state_dict())


def load_network(
    folder: Path, component: str, *, dtype: torch.dtype | None = None, device: str = "cpu"
) -> nn.Module:
    """A network of a truncated folder, strictly: every tensor is there, none is left over.

    ``dtype`` None keeps what is stored; otherwise what diffusers keeps in float32 is float32 and
    the rest is this. On "meta", names, shapes and types are checked by headers alone.
    """
    place = Path(folder) / component
    network: Any = empty_network(component, read_config(place))
    files, expected = TensorFiles.find(place), shapes(network.state_dict())
    check_fit(files.empty(), expected, where=place)
    if device != "meta":
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
    """What Wan's text encoder gives for the empty prompt, (tokens, channels) as stored."""
    path = Path(folder) / EMPTY_PROMPT
    if not path.is_file():
        raise CheckpointError(
            f"{path} is absent; make it once, where Wan's text encoder is (11 GB): gvtools weights "
            f"empty-prompt WAN {folder}"
        )
    files = TensorFiles.find(path)
    embedding = files.read("embedding") if "embedding" in files.places else torch.zeros(())
    if embedding.ndim != 2:
        raise CheckpointError(
            f"{path}: embedding {tuple(embedding.shape)}; expected (tokens, channels)"
        )
    return embedding


def cast(name: str, tensor: Tensor, dtype: torch.dtype | None) -> Tensor:
    """A tensor of the transformer in the dtype it is used in; None leaves it as it is."""
    return tensor if dtype is None else tensor.to(dtype_of(name, dtype))


def dtype_of(name: str, dtype: torch.dtype) -> torch.dtype:
    """``dtype``, or float32 for tensors (by diffusers' names) that diffusers keeps in that."""
    return dtype if _FLOAT32.isdisjoint(name.split(".")) else torch.float32


def network_class(component: str) -> Any:
    """The class of "transformer" or "vae"."""
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
    """A network of a diffusers config, on the meta device: shapes, no numbers, no memory."""
    kind = network_class(component)
    try:
        for name in ("num_layers", "num_res_blocks"):
            check_range(name, config.get(name), le=MOST_BLOCKS)
        with shapes_alone():
            network: nn.Module = kind.from_config(dict(config))
    except Exception as error:
        raise CheckpointError(
            f"no {COMPONENTS[component]} comes of this configuration ({error}); take the "
            "config.json that belongs to the weights"
        ) from error
    return network


def read_config(folder: Path) -> dict[str, Any]:
    """A component's config.json."""
    path = folder / "config.json"
    try:
        config = read_json(path)
        if not isinstance(config, dict):
            raise ValueError(f"a {type(config).__name__} instead of an object")
        return config
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error}); expected the config.json of a network in "
            "diffusers' form"
        ) from error


@contextmanager
def _broken_torchvision_hidden() -> Iterator[bool]:
    """Hide a torchvision that does not fit torch: diffusers would fail on it."""
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
