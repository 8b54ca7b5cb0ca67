"""Features of a frozen video model, computed once for all denoising steps.

Eq. 4 and the appendix on Wan VACE: projections are noised slightly and encoded by the video VAE
(z_proxy); x_t = (1 - sigma) z_proxy + sigma eps enters the backbone and [z_proxy, V] its VACE
branch; what four blocks give in that one forward is F^W. Nothing is sampled or decoded. Where the
paper leaves a choice, ``VideoPriorConfig`` says which one is taken.

The VAE takes clips of 4k + 1 frames and gives 1 + k latents: the first frame alone, then four by
four. It drops the rest of other lengths without a word, so clips have such a length here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from gvtools.completers.geoverse.flow import seeded_noise, view_seed
from gvtools.completers.geoverse.wan import STRIDE, WanNetworks, load_network, read_empty_prompt
from gvtools.errors import CheckpointError, OptionError
from gvtools.networks.compute import half_type
from gvtools.networks.config_json import check_range

GROUP = 4
Layout = Literal["per_view", "video9", "repeat4"]
# Bytes that a pass of base needs beside all weights: 2.5 GB (benchmarks/complete.md), and what the
# driver takes and an allocator loses.
ROOM = 3.5e9


@dataclass(frozen=True)
class ViewLayout:
    """Views in clips."""

    # The view shown by each frame of each clip; all clips have 4k + 1 frames.
    clips: tuple[tuple[int, ...], ...]

    @property
    def views_of_latent(self) -> tuple[tuple[int, ...], ...]:
        """The views that each latent holds, clip after clip."""
        views = []
        for clip in self.clips:
            groups = [clip[:1]] + [clip[i : i + GROUP] for i in range(1, len(clip), GROUP)]
            views += [tuple(sorted(set(group))) for group in groups]
        return tuple(views)

    @property
    def latent_of_view(self) -> tuple[int, ...]:
        """The latent that each view is in."""
        where = {v: i for i, views in enumerate(self.views_of_latent) for v in views}
        return tuple(where[view] for view in sorted(where))


def view_layout(name: Layout, views: int) -> ViewLayout:
    """One of the ways to show ``views`` views to the VAE.

    "per_view": each view is a clip of one frame, as Wan encodes reference images. "video9": one
    clip of all views, the last one repeated up to 4k + 1 frames (nine for eight views); after the
    first, four views share a latent. "repeat4": one clip, the first view once and every other one
    four times, so each has its latent.
    """
    if name == "per_view":
        return ViewLayout(tuple((view,) for view in range(views)))
    if name == "video9":
        return ViewLayout(((*range(views), *[views - 1] * ((1 - views) % GROUP)),))
    return ViewLayout(((0, *(view for view in range(1, views) for _ in range(GROUP))),))


def packed_mask(generate: Tensor, layout: ViewLayout, *, stride: int = 8) -> Tensor:
    """VACE's mask channels (B, stride^2, F, H / stride, W / stride): each latent's block of pixels.

    Of ``generate`` (B, V, 1, H, W), 1 = to be generated; channel = row * stride + column. A latent
    of several views is to be generated where any of them is: resampling the mask in time, as VACE
    does for true video, would give a latent the mask of a view that it does not hold.
    """
    shown = generate[:, :, 0].unbind(1)
    latents = [
        torch.stack([shown[v] for v in views], dim=1).amax(dim=1)
        for views in layout.views_of_latent
    ]
    packed = [F.pixel_unshuffle(mask[:, None], stride) for mask in latents]
    return torch.stack(packed, dim=2)


@dataclass(frozen=True)
class VideoPriorConfig:
    """How features are taken from the video model."""

    # How views become video, see ``view_layout``. The paper does not say; "per_view"
    # has each view's own latent and mask.
    layout: Layout = "per_view"
    # Backbone blocks whose outputs, VACE hint included, are the features.
    taps: tuple[int, ...] = (0, 5, 10, 15)
    channels: int = 5120  # of a feature, the backbone's width; checked against the weights
    timestep: float = 500.0  # of the single forward, 0 to 1000
    # Share of noise in x_t; None: timestep / 1000, as in Wan's schedulers whatever their shift.
    sigma: float | None = None
    # Standard deviation of the noise on valid target pixels, range [-1, 1].
    proxy_noise: float = 0.1
    # (rows, columns) in px that views are resized to, each rounded to the nearest multiple; None:
    # their own size, rounded. 576 gives 504-px views the tokens of a 14-px patch, 36 x 36.
    resolution: tuple[int, int] | None = None
    multiple: int = 16  # of both sides, px; itself a multiple of a token's 16
    # Of the transformer; None as stored. What diffusers keeps in float32 stays so.
    dtype: Literal["float32", "bfloat16", "float16"] | None = None
    # "empty", Wan's embedding of the empty prompt; or "zeros", for tests and tiny configurations:
    # Wan was not trained on it.
    prompt: Literal["empty", "zeros"] = "empty"
    prompt_rows: int = 512  # rows that the prompt's embedding is padded to with zeros

    def __post_init__(self) -> None:
        if not self.taps or list(self.taps) != sorted({*self.taps}) or self.taps[0] < 0:
            raise OptionError(f"video.taps = {self.taps}; expected ascending block numbers")
        if self.multiple < 1 or self.multiple % 16:
            raise OptionError(f"video.multiple = {self.multiple}; expected a multiple of 16")
        check_range("video.timestep", self.timestep, ge=0, le=1000)
        check_range("video.sigma", self.sigma, ge=0, le=1)
        check_range("video.proxy_noise", self.proxy_noise, ge=0)
        check_range("video.prompt_rows", self.prompt_rows, ge=1)

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns in px that views of a size are resized to."""
        rows, columns = self.resolution or (height, width)
        unit = self.multiple
        return max(1, round(rows / unit)) * unit, max(1, round(columns / unit)) * unit


def resize_views(images: Tensor, valid: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Views (B, V, 3, H, W), 0 where not valid, and validity (B, V, 1, H, W) in another size.

    Both float32. Colours of invalid pixels do not bleed in; validity is the nearest pixel's.
    """
    usable = (valid if valid.dtype == torch.bool else valid > 0.5).flatten(0, 1)
    weight = usable.float()
    seen = torch.where(usable, images.flatten(0, 1).float(), 0.0)
    if tuple(images.shape[-2:]) != size:
        seen, share = (
            F.interpolate(x, size=size, mode="bilinear", antialias=True) for x in (seen, weight)
        )
        weight = F.interpolate(weight, size=size, mode="nearest-exact")
        # The nearest pixel has the largest share, so the divisor is far from 0 where it counts.
        seen = torch.where(weight > 0, seen / share.clamp_min(1e-6), 0.0)
    count = images.shape[:2]
    return seen.unflatten(0, count), weight.unflatten(0, count)


# F^W, to be handed to every denoising step: a (B, V, C, h, w) for each tap.
VideoFeatures = tuple[Tensor, ...]


class VideoPrior:
    """The frozen video model. Not an ``nn.Module``: it is no part of a model's state."""

    def __init__(
        self,
        transformer: Any,  # diffusers' WanVACETransformer3DModel
        vae: Any,  # diffusers' AutoencoderKLWan
        # (tokens, channels) embedding of the empty prompt; None with ``prompt="zeros"``.
        prompt: Tensor | None = None,
        *,
        config: VideoPriorConfig | None = None,
    ) -> None:
        self.config = config or VideoPriorConfig()
        zeros = self.config.prompt == "zeros"
        if prompt is None and not zeros:
            raise CheckpointError(
                "video prior: no embedding of the empty prompt; expected that of "
                "read_empty_prompt, or video.prompt = 'zeros' where no trained network is used"
            )
        self.networks = WanNetworks(
            transformer, vae, prompt=None if zeros else prompt, prompt_rows=self.config.prompt_rows
        )
        # Where features are computed while the weights are kept elsewhere.
        self._guest: torch.device | None = None
        self._zero_latents: dict[tuple[int, ...], Tensor] = {}
        found = (self.networks.channels, self.networks.blocks)
        if found[0] != self.config.channels or found[1] <= self.config.taps[-1]:
            raise CheckpointError(
                f"video prior: {found[1]} blocks of {found[0]} channels; expected "
                f"{self.config.channels} channels and blocks {self.config.taps}"
            )

    def __deepcopy__(self, memo: dict[int, Any]) -> VideoPrior:
        """Itself: it is large, and nothing changes it."""
        return self

    @classmethod
    def from_pretrained(
        cls,
        folder: Path | str,  # see ``wan.py``
        *,
        config: VideoPriorConfig | None = None,  # how features are taken
        # Of the weights; "meta" compares everything and reads no weights.
        device: torch.device | str = "cpu",
        # The weights stay in the CPU's memory and go to a CUDA device for the time of a pass's one
        # forward: "always", "never", or, "auto", where less than ``ROOM`` would be free beside
        # them.
        offload: str = "never",
    ) -> VideoPrior:
        """From a folder that ``wan_checkpoint.truncate`` made, strictly."""
        config = config or VideoPriorConfig()
        prompt = read_empty_prompt(Path(folder)) if config.prompt == "empty" else None
        dtype = None if config.dtype is None else half_type(config.dtype, torch.device(device))
        guest = torch.device(device) if _leaves(Path(folder), device, offload) else None
        device = device if guest is None else "cpu"
        transformer = load_network(Path(folder), "transformer", dtype=dtype, device=str(device))
        vae = load_network(Path(folder), "vae", device=str(device))
        prior = cls(transformer, vae, prompt, config=config)
        prior._guest = guest
        if guest is not None:
            prior.networks.pin()
        return prior

    @property
    def summary(self) -> str:
        """What was loaded, in a line."""
        networks, prompt = self.networks, tuple(self.networks.prompt.shape)
        counts = (len(n.state_dict()) for n in (networks.transformer, networks.vae))
        return "transformer: {} tensors, vae: {} tensors, prompt: {}".format(*counts, prompt)

    def to(self, device: torch.device | str) -> VideoPrior:
        """Move the weights; their dtype stays, since some are float32 on purpose."""
        self.networks.to(device)
        self._zero_latents.clear()
        return self

    @torch.no_grad()
    def features(
        self,
        images: Tensor,  # (B, V, 3, H, W) in [0, 1]; what is not valid is not looked at
        valid: Tensor,  # (B, V, 1, H, W), bool or 1 = valid
        context: int,  # how many views, the first ones, are photographs: they get no noise
        *,
        # One number, or B rows of V of them (see ``view_seed``): a view's noise depends on
        # its own alone.
        seed: int | Sequence[Sequence[int]] = 0,
    ) -> VideoFeatures:
        """One forward of the video model."""
        batch, views = images.shape[:2]
        if isinstance(seed, int):
            seed = [[view_seed(seed, item, view) for view in range(views)] for item in range(batch)]
        layout = view_layout(self.config.layout, views)
        with self.networks.lent(self._guest):
            device = self.networks.device
            with torch.autocast(device.type, enabled=False):
                here = (images.to(device), valid.to(device))
                proxy, shown = self._proxy(*here, context, seeds=seed)
                z_proxy = self._encoded(proxy, layout)
                outputs = self.networks.block_outputs(
                    self._noised(z_proxy, layout, seed),
                    self._condition(z_proxy, shown, layout),
                    timestep=self.config.timestep,
                    blocks=self.config.taps,
                )
            where = list(layout.latent_of_view)
            return tuple(x[:, where].movedim(-1, 2).contiguous() for x in outputs)

    def _proxy(
        self, images: Tensor, valid: Tensor, context: int, *, seeds: Sequence[Sequence[int]]
    ) -> tuple[Tensor, Tensor]:
        """Views (B, V, 3, H', W') in [-1, 1], 0 where not shown, and shown (B, V, 1, H', W')."""
        size = self.config.size(images.shape[-2], images.shape[-1])
        seen, shown = resize_views(images, valid, size)
        noise = self._noise("rgb", seeds, (3, *size))
        noise[:, :context] = 0
        return (2 * seen - 1 + self.config.proxy_noise * noise) * shown, shown

    def _encoded(self, images: Tensor, layout: ViewLayout) -> Tensor:
        """Normalised latents (B, 16, F, h, w) of views (B, V, 3, H, W)."""
        clips = torch.stack(
            [torch.stack([images[:, view] for view in clip], dim=1) for clip in layout.clips], dim=1
        )
        latents = self.networks.encode(clips.flatten(0, 1).transpose(1, 2))
        return latents.unflatten(0, clips.shape[:2]).transpose(1, 2).flatten(2, 3)

    def _noised(
        self, z_proxy: Tensor, layout: ViewLayout, seeds: Sequence[Sequence[int]]
    ) -> Tensor:
        """x_t; a latent of several views takes the first one's noise."""
        sigma = self.config.timestep / 1000 if self.config.sigma is None else self.config.sigma
        first = [[row[held[0]] for held in layout.views_of_latent] for row in seeds]
        eps = self._noise("latent", first, (z_proxy.shape[1], *z_proxy.shape[-2:]))
        return (1 - sigma) * z_proxy + sigma * eps.transpose(1, 2)

    def _condition(self, z_proxy: Tensor, shown: Tensor, layout: ViewLayout) -> Tensor:
        """VACE's inactive and reactive latents and its mask m = 1 - V, (B, 96, F, h, w).

        Pixels without content are 0, so the inactive picture I (1 - m) is the proxy itself, and
        the reactive one I m is 0 everywhere.
        """
        key = (len(layout.clips[0]), *shown.shape[-2:])
        if key not in self._zero_latents:
            zero = torch.zeros(1, 3, *key, device=shown.device)
            self._zero_latents[key] = self.networks.encode(zero)
        reactive = self._zero_latents[key].repeat(1, 1, len(layout.clips), 1, 1)
        mask = packed_mask(1 - shown, layout, stride=STRIDE)
        return torch.cat([z_proxy, reactive.expand_as(z_proxy), mask], dim=1)

    def _noise(self, draw: str, seeds: Sequence[Sequence[int]], shape: tuple[int, ...]) -> Tensor:
        """Standard normal (B, views, *shape), each view's of its own seed."""
        rows = [[view_seed(value, "video", draw) for value in row] for row in seeds]
        device = self.networks.device
        return seeded_noise((len(rows), len(rows[0]), *shape), rows, device=device)


def _leaves(folder: Path, device: torch.device | str, offload: str) -> bool:
    """Whether the weights in a folder stay off the device but for a pass's one forward."""
    if torch.device(device).type != "cuda" or offload != "auto":
        return torch.device(device).type == "cuda" and offload == "always"
    stored = sum(path.stat().st_size for path in folder.rglob("*.safetensors"))
    return torch.cuda.mem_get_info(device)[0] < stored + ROOM
