"""Wan's VAE and VACE transformer as two functions: clips to latents, latents to block outputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from gvtools.errors import CheckpointError

STRIDE = 8  # pixels of a latent's edge
PATCH = (1, 2, 2)  # latents of a token


class WanNetworks:
    """Both networks, frozen, in diffusers' form.

    Args:
        transformer: a WanVACETransformer3DModel.
        vae: an AutoencoderKLWan.
        prompt: (tokens, channels), the text embedding that the transformer always gets; None for
            zeros.
        prompt_rows: what it is padded to with zeros, which take part in attention, as in Wan's
            training.
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
        device: torch.device = self.transformer.patch_embedding.weight.device
        return device

    @property
    def dtype(self) -> torch.dtype:
        """Of the transformer's large weights and of its tokens."""
        dtype: torch.dtype = self.transformer.patch_embedding.weight.dtype
        return dtype

    def to(self, device: torch.device | str) -> None:
        """Move the weights; their dtype stays, since some are float32 on purpose."""
        self.transformer.to(device)
        self.vae.to(device)

    @contextmanager
    def lent(self, device: torch.device | None) -> Iterator[None]:
        """On another device within the block, where only copies go: nothing is brought back.

        Args:
            device: None for where the weights are.
        """
        if device is None or device == self.device:
            yield
            return
        tensors = [
            tensor
            for network in (self.transformer, self.vae)
            for tensor in (*network.parameters(), *network.buffers())
        ]
        home = [tensor.data for tensor in tensors]
        try:
            for tensor in tensors:
                tensor.data = tensor.data.to(device)
            yield
        finally:
            for tensor, data in zip(tensors, home, strict=True):
                tensor.data = data

    def encode(self, clips: Tensor) -> Tensor:
        """The mode of the VAE's latents, normalised by its published mean and deviation.

        Args:
            clips: (N, 3, T, H, W) in [-1, 1], T = 4k + 1.

        Returns:
            (N, 16, 1 + k, H / 8, W / 8) float32.
        """
        latents = self.vae.encode(clips.to(self.vae.dtype)).latent_dist.mode().float()
        mean, deviation = (
            latents.new_tensor(self.vae.config[name]).view(-1, 1, 1, 1)
            for name in ("latents_mean", "latents_std")
        )
        normalised: Tensor = (latents - mean) / deviation
        return normalised

    def block_outputs(
        self, x: Tensor, condition: Tensor, *, timestep: float, blocks: Sequence[int]
    ) -> list[Tensor]:
        """What some blocks give in one forward, their VACE hints included.

        Args:
            x: (B, 16, F, h, w) noised latents.
            condition: (B, 96, F, h, w) of the VACE branch.
            timestep: 0 to 1000.
            blocks: their numbers.

        Returns:
            For each block (B, F, h / 2, w / 2, C).
        """
        after = [*self.transformer.blocks[1:], self.transformer.norm_out]
        taken: dict[int, Tensor] = {}
        hooks = []
        for block in blocks:
            # diffusers adds the hint behind the block: what enters the next one includes it.
            def keep(_: nn.Module, entering: tuple[Tensor, ...], block: int = block) -> None:
                taken[block] = entering[0].to(self.dtype)

            hooks.append(after[block].register_forward_pre_hook(keep))
        prompt = self.prompt.to(x.device, self.dtype).expand(len(x), -1, -1)
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
