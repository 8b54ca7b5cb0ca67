"""The multi-view denoiser: a diffusion transformer with a wide head, over all tokens of all views.

A narrow, deep *encoder* reads the conditions and writes one conditioning vector a token; a wide,
shallow *head* denoises under it (Zheng et al. 2025, RAE; Geometric Latent Diffusion). Every block
attends over all views at once; position comes only from the cameras (``camera_encoding.py``).

The same class is level 1 (separate embedders for context and target views, both streams read
[condition | noisy]) and the level-0 cascade (``source``: the encoder reads [condition | level 1]).
Parameter names are those of GLD's checkpoints. What GeoVerse adds (``depth_condition``) starts at
zero: a fresh extension returns the pretrained output bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.camera_encoding import HEAD_MULTIPLE, CameraCondition, Projective
from gvtools.errors import OptionError
from gvtools.networks.compute import Recomputing, attend
from gvtools.networks.depth_anything.encoder import PatchEmbed

CAMERA_CHANNELS = 7
DEPTH_CHANNELS = 2


@dataclass(frozen=True)
class VideoKeys:
    """Keys and values of the video tokens for one block."""

    key: Tensor  # (B, heads, V * M, head_dim), projectively transformed
    value: Tensor  # likewise
    gate: Tensor | None  # share of the joint attention; None for all of it

    def attend(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Attention of (B, heads, T, head_dim) over both kinds of tokens."""
        key, value = self.key.to(k.dtype), self.value.to(v.dtype)
        joint = attend(q, torch.cat((key, k), dim=2), torch.cat((value, v), dim=2))
        if self.gate is None:
            return joint
        alone = attend(q, k, v)
        return alone + self.gate.to(v.dtype) * (joint - alone)


class TimeEmbed(nn.Module):
    """t in [0, 1] to a vector, by frozen Gaussian Fourier features."""

    W: Tensor

    def __init__(self, width: int, frequencies: int) -> None:
        super().__init__()
        self.W = nn.Parameter(torch.randn(frequencies), requires_grad=False)
        self.mlp = nn.Sequential(
            nn.Linear(2 * frequencies, width), nn.SiLU(), nn.Linear(width, width)
        )

    def forward(self, t: Tensor) -> Tensor:
        """(...,) to (..., width); the angles are computed in float32."""
        angle = t[..., None].float() * self.W.float() * (2 * math.pi)
        return self.mlp(torch.cat((angle.sin(), angle.cos()), -1).to(self.W.dtype))


class SwiGLU(nn.Module):
    """Gated MLP: w3(silu(a) * b) with [a, b] = w12(x)."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.w12 = nn.Linear(width, 2 * hidden)
        self.w3 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        """(..., width) to the same."""
        gate, value = self.w12(x).chunk(2, dim=-1)
        return self.w3(nn.functional.silu(gate) * value)


class CameraAttention(nn.Module):
    """Self-attention over all tokens of all views, with projective positions."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, positions: Projective, video: VideoKeys | None = None) -> Tensor:
        """(B, T, width) to the same; ``video`` holds further keys and values (MoT variant)."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k, v = positions.query(q), positions.key(k), positions.value(v)
        out = attend(q, k, v) if video is None else video.attend(q, k, v)
        return self.proj(positions.output(out).transpose(1, 2).flatten(2))


class DenoiserBlock(nn.Module):
    """Attention and MLP, each shifted, scaled and gated by the conditioning vector."""

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.norm1 = nn.RMSNorm(width, eps=1e-6)
        self.attn = CameraAttention(width, heads)
        self.norm2 = nn.RMSNorm(width, eps=1e-6)
        self.mlp = SwiGLU(width, int(2 / 3 * int(width * mlp_ratio)))
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))

    def forward(
        self,
        x: Tensor,  # (B, V, N, width)
        c: Tensor,  # (B, V, 1 or N, width)
        positions: Projective,  # of the V * N tokens
        video: VideoKeys | None = None,  # see ``CameraAttention``
    ) -> Tensor:
        """Tokens under their conditioning."""
        shift1, scale1, gate1, shift2, scale2, gate2 = self.adaLN_modulation(c).chunk(6, dim=-1)
        inner = modulate(self.norm1(x), shift1, scale1).flatten(1, 2)
        x = x + gate1 * self.attn(inner, positions, video).view_as(x)
        return x + gate2 * self.mlp(modulate(self.norm2(x), shift2, scale2))


class FinalLayer(nn.Module):
    """Tokens to latent channels."""

    def __init__(self, width: int, channels: int) -> None:
        super().__init__()
        self.norm_final = nn.RMSNorm(width, eps=1e-6)
        self.linear = nn.Linear(width, channels)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * width))

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        """(B, V, N, width) under (B, V, N, width) to (B, V, N, channels)."""
        shift, scale = self.adaLN_modulation(c).chunk(2, dim=-1)
        return self.linear(modulate(self.norm_final(x), shift, scale))


def modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """``x`` (1 + scale) + shift."""
    return x * (1 + scale) + shift


@dataclass(frozen=True)
class DenoiserConfig:
    """Dimensions of a denoiser; the defaults are GLD's level 1."""

    channels: int = 1536  # of the latents
    width: int = 768  # channels of the encoder's tokens
    depth: int = 28  # blocks of the encoder
    heads: int = 16  # attention heads of the encoder
    head_width: int = 2048  # channels of the head's tokens
    head_depth: int = 6  # blocks of the head
    head_heads: int = 16  # attention heads of the head
    mlp_ratio: float = 4.0  # hidden width of a block's MLP over 1.5 times its width (SwiGLU)
    frequencies: int = 256  # of the time embedding
    camera_patch: int = 14  # pixels of the camera map a token
    # The encoder's second input is a source latent (the cascade), not the noisy one.
    source: bool = False
    separate_embedders: bool = True  # context and target views have their own embedders
    # K is normalised by this square, px; by the image's size where None. The released cascade has a
    # fixed square.
    projective_size: int | None = None
    # Keys and values carry K's inverse, as the projective encoding is published; GLD's checkpoints
    # were trained with K itself in its place.
    invert_K: bool = False
    # Projected depth and validity enter through a zero-initialised embedder.
    depth_condition: bool = False

    def __post_init__(self) -> None:
        for what, width, heads in (
            ("heads", self.width, self.heads),
            ("head_heads", self.head_width, self.head_heads),
        ):
            if heads < 1 or width % (HEAD_MULTIPLE * heads):
                raise OptionError(
                    f"denoiser {what} = {heads} of {width} channels; expected heads of a multiple "
                    f"of {HEAD_MULTIPLE} channels"
                )


@dataclass(frozen=True)
class Conditions:
    """What a denoiser knows, constant over the steps."""

    latents: Tensor  # (B, V, C, h, w) normalised: clean context, hints or zeros on targets
    camera: CameraCondition  # Plücker map, cameras and image size
    source: Tensor | None = None  # (B, V, C, h, w) normalised level-1 latents, for the cascade
    depth: Tensor | None = None  # (B, V, 2, H, W) from ``conditioning.depth_condition``, or None


class Encoding:
    """The encoder's tokens in the steps of one pass, taken anew where a step says so."""

    def __init__(
        self,
        bounds: Sequence[float],  # of the steps, one evaluation each
        interval: float,  # how far a step may be, in time, from the one whose tokens it takes
    ) -> None:
        self.tokens: Tensor | None = None  # (B, V, N, width); None where they are to be made
        self._bounds, self._interval = iter(bounds), interval
        self._made = math.inf

    def begin_step(self) -> None:
        """The next step; its time is the bounds', since a device's would have to be waited for."""
        time = next(self._bounds)
        if self._made - time > self._interval:
            self._made, self.tokens = time, None


class Positions:
    """Projective transforms of one pass for the two head widths."""

    def __init__(self, config: DenoiserConfig, camera: CameraCondition, grid: tuple[int, int]):
        square = config.projective_size
        size = camera.size if square is None else (square, square)
        self.encoder, self.head = (
            Projective(
                camera.cam_from_world,
                camera.K,
                size,
                grid=grid,
                head_dim=head_dim,
                invert_K=config.invert_K,
            )
            for head_dim in (config.width // config.heads, config.head_width // config.head_heads)
        )


class Denoiser(Recomputing):
    """The velocity of the linear path, or clean latents, see ``FlowConfig.prediction``."""

    def __init__(self, config: DenoiserConfig) -> None:
        super().__init__()
        self.config = config
        width, head_width, pair = config.width, config.head_width, 2 * config.channels
        for stream, out in (("x", head_width), ("s", width)):
            for suffix in ("_ref", "_tgt") if config.separate_embedders else ("",):
                self.add_module(f"{stream}_embedder{suffix}", PatchEmbed(pair, out))
        self.s_projector = nn.Linear(width, head_width)
        self.t_embedder = TimeEmbed(width, config.frequencies)
        self.camera_embedder = PatchEmbed(CAMERA_CHANNELS, width, config.camera_patch)
        sizes = [(width, config.heads)] * config.depth
        sizes += [(head_width, config.head_heads)] * config.head_depth
        self.blocks = nn.ModuleList(DenoiserBlock(*size, config.mlp_ratio) for size in sizes)
        self.final_layer = FinalLayer(head_width, config.channels)
        if config.depth_condition:
            self.depth_embedder = PatchEmbed(DEPTH_CHANNELS, width, config.camera_patch)
        self._initialise()

    def _initialise(self) -> None:
        """Gates, the output and the added condition start at zero."""
        zero: list[nn.Module] = [self.final_layer.linear]
        zero += [
            module.adaLN_modulation[1]
            for module in self.modules()
            if isinstance(module, (DenoiserBlock, FinalLayer))
        ]
        if self.config.depth_condition:
            zero.append(self.depth_embedder.proj)
        for layer in zero:
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)

    def embed(self, noisy: Tensor, conditions: Conditions) -> tuple[Tensor, Tensor]:
        """Tokens that enter the encoder, (B, V, N, width), and the head, (B, V, N, head_width)."""
        pair = torch.cat((conditions.latents, noisy), dim=2)
        x = self._split("x", pair, conditions.camera.context).to(self.t_embedder.W.dtype)
        return self.encoder_tokens(noisy, conditions), x

    def encoder_tokens(self, noisy: Tensor, conditions: Conditions) -> Tensor:
        """Tokens that enter the encoder, (B, V, N, width)."""
        second = noisy
        if self.config.source:
            assert conditions.source is not None
            second = conditions.source
        pair = torch.cat((conditions.latents, second), dim=2)
        s = self._split("s", pair, conditions.camera.context)
        s = s + _tokens(self.camera_embedder, conditions.camera.map.to(s.dtype))
        if self.config.depth_condition and conditions.depth is not None:
            s = s + _tokens(self.depth_embedder, conditions.depth.to(s.dtype))
        # Under autocast the streams stay in full precision; only the products are rounded.
        return s.to(self.t_embedder.W.dtype)

    def time(self, t: Tensor, views: int) -> Tensor:
        """(B,) or (B, V) to the encoder's (B, V, 1, width) time embedding."""
        embedded = self.t_embedder(t)
        if t.ndim == 1:
            embedded = embedded[:, None].expand(-1, views, -1)
        return embedded[:, :, None]

    def forward(
        self,
        noisy: Tensor,  # (B, V, C, h, w)
        t: Tensor,  # (B,) or (B, V) in [0, 1]; 1 is noise
        conditions: Conditions,  # see ``Conditions``; its context views come first
        *,
        # What is added after an encoder block, (B, V, N, width), by its index.
        residuals: Mapping[int, Tensor] | None = None,
        # Further keys and values of an encoder block, by its index.
        video: Mapping[int, VideoKeys] | None = None,
        # Of this grid and cameras, when the caller has them already.
        positions: Positions | None = None,
        # Of a pass whose steps share the encoder's tokens.
        encoding: Encoding | None = None,
    ) -> Tensor:  # (B, V, C, h, w)
        """The velocity of every view."""
        grid = (noisy.shape[-2], noisy.shape[-1])
        positions = positions or Positions(self.config, conditions.camera, grid)
        s, x = self.embed(noisy, conditions)
        time = self.time(t, noisy.shape[1]).to(s.dtype)
        if encoding is not None and encoding.tokens is not None:
            s = encoding.tokens
        else:
            c = nn.functional.silu(time)
            for index in range(self.config.depth):
                keys = None if video is None else video.get(index)
                s = self.layer(self.blocks[index], s, c, positions.encoder, keys)
                if residuals is not None and index in residuals:
                    s = s + residuals[index]
        if encoding is not None:
            encoding.tokens = s
        s = self.s_projector(nn.functional.silu(time + s))
        for index in range(self.config.depth, len(self.blocks)):
            x = self.layer(self.blocks[index], x, s, positions.head)
        return self.final_layer(x, s).transpose(2, 3).unflatten(3, grid)

    def _split(self, stream: str, x: Tensor, context: int) -> Tensor:
        """Embeds (B, V, 2C, h, w), context views by their own layer where there is one."""
        if not self.config.separate_embedders:
            return _tokens(getattr(self, f"{stream}_embedder"), x)
        reference = _tokens(getattr(self, f"{stream}_embedder_ref"), x[:, :context])
        target = _tokens(getattr(self, f"{stream}_embedder_tgt"), x[:, context:])
        return torch.cat((reference, target), dim=1)


def _tokens(embed: nn.Module, x: Tensor) -> Tensor:
    """(B, V, C, H, W) through a per-view embedder to (B, V, N, width)."""
    return embed(x.flatten(0, 1)).unflatten(0, x.shape[:2])
