"""The geometry head: four feature levels to depth, rays and their confidences.

Depth Anything 3's DualDPT: one shared projection of the levels, then two RefineNet chains from
coarse to fine, one for depth, one for rays. Rays come at 8/patch of the image's resolution.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gvtools.errors import DegenerateError
from gvtools.networks.compute import Recomputing


@dataclass(frozen=True)
class GeometryHeadConfig:
    """Dimensions of the geometry head; the defaults are Depth Anything 3 Base."""

    channels: int = 1536  # of each level
    features: int = 128  # channels of the RefineNet chains
    # Channels of the four projected levels.
    projected: tuple[int, int, int, int] = (96, 192, 384, 768)
    patch: int = 14  # patch edge of the encoder, px


@dataclass(frozen=True)
class ViewGeometry:
    """What the geometry head predicts."""

    depth: Tensor  # (B, V, H, W) z-depth along the rays, in units of the model
    depth_confidence: Tensor  # (B, V, H, W) > 1
    # (B, V, h, w, 6): direction (not of unit length, so that point = origin + depth * direction),
    # then origin, in the frame of the first view.
    ray: Tensor
    ray_confidence: Tensor  # (B, V, h, w) > 1


class ResidualConv(nn.Module):
    """Two 3x3 convolutions around a skip connection."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, features, h, w) to the same."""
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class Fusion(nn.Module):
    """Joins a coarser result with a level and doubles its resolution."""

    def __init__(self, features: int, *, lateral: bool = True) -> None:
        super().__init__()
        if lateral:
            self.resConfUnit1 = ResidualConv(features)
        self.resConfUnit2 = ResidualConv(features)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, x: Tensor, lateral: Tensor | None, size: Sequence[int]) -> Tensor:
        """(B, features, h, w), with ``lateral`` of the same size, resampled to ``size`` (h, w)."""
        if lateral is not None:
            x = x + self.resConfUnit1(lateral)
        return self.out_conv(_resized(self.resConfUnit2(x), size))


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of (B, C, h, w)."""

    def forward(self, x: Tensor) -> Tensor:
        """The same shape."""
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Scratch(nn.Module):
    """The layers after the projection, under the name that the checkpoints give them."""

    def __init__(self, config: GeometryHeadConfig) -> None:
        super().__init__()
        features, half = config.features, config.features // 2
        for index, channels in enumerate(config.projected, start=1):
            self.add_module(
                f"layer{index}_rn", nn.Conv2d(channels, features, 3, padding=1, bias=False)
            )
            for suffix in ("", "_aux"):
                self.add_module(f"refinenet{index}{suffix}", Fusion(features, lateral=index < 4))
        self.output_conv1 = nn.Conv2d(features, half, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(half, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, 2, 1)
        )
        # The checkpoints hold a ray output for each of the four scales; only the finest is used.
        self.output_conv1_aux = nn.ModuleList(
            nn.Sequential(
                *(
                    nn.Conv2d(*pair, 3, padding=1)
                    for pair in ((features, half), (half, features)) * 2 + ((features, half),)
                )
            )
            for _ in range(4)
        )
        self.output_conv2_aux = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(half, 32, 3, padding=1),
                nn.Identity(),
                ChannelNorm(32),
                nn.Identity(),
                nn.ReLU(),
                nn.Conv2d(32, 7, 1),
            )
            for _ in range(4)
        )


class GeometryHead(Recomputing):
    """See the module. Runs outside autocast, in the precision of its own weights."""

    def __init__(self, config: GeometryHeadConfig) -> None:
        super().__init__()
        self.config = config
        one, two, _, four = config.projected
        self.norm = nn.LayerNorm(config.channels)
        self.projects = nn.ModuleList(nn.Conv2d(config.channels, c, 1) for c in config.projected)
        self.resize_layers = nn.ModuleList(
            (
                nn.ConvTranspose2d(one, one, 4, stride=4),
                nn.ConvTranspose2d(two, two, 2, stride=2),
                nn.Identity(),
                nn.Conv2d(four, four, 3, stride=2, padding=1),
            )
        )
        self.scratch = Scratch(config)
        _initialise(self)

    def forward(
        self, levels: Sequence[Tensor], grid: tuple[int, int], *, views_at_once: int = 8
    ) -> ViewGeometry:
        """Depth and rays of all views, of four (B, V, N, channels) levels that are ``normed``."""
        depth, ray = self._outputs(
            levels, grid, (self._depth, self._ray), views_at_once=views_at_once
        )
        return ViewGeometry(
            depth=depth[:, :, 0].exp(),
            depth_confidence=depth[:, :, 1].exp() + 1,
            ray=ray[:, :, :6].permute(0, 1, 3, 4, 2),
            ray_confidence=ray[:, :, 6].exp() + 1,
        )

    def depth(
        self, levels: Sequence[Tensor], grid: tuple[int, int], *, views_at_once: int = 8
    ) -> tuple[Tensor, Tensor]:
        """Depth and its confidence, both (B, V, H, W), as ``forward`` gives them; no rays."""
        (depth,) = self._outputs(levels, grid, (self._depth,), views_at_once=views_at_once)
        return depth[:, :, 0].exp(), depth[:, :, 1].exp() + 1

    def chain(self, *, rays: bool) -> Iterator[nn.Module]:
        """The modules that rays alone, or depth alone, come from."""
        for name, module in self.scratch.named_children():
            if name.startswith(("refinenet", "output")) and name.endswith("_aux") == rays:
                yield module

    def _outputs(
        self,
        levels: Sequence[Tensor],
        grid: tuple[int, int],
        chains: Sequence[Callable[[list[Tensor], tuple[int, int]], Tensor]],
        *,
        views_at_once: int,
    ) -> list[Tensor]:
        """(B, V, ...) of each chain."""
        batch, views = levels[0].shape[:2]
        dtype = self.norm.weight.dtype
        image = (grid[0] * self.config.patch, grid[1] * self.config.patch)
        parts = []
        with torch.autocast(levels[0].device.type, enabled=False):
            flat = [level.to(dtype).flatten(0, 1) for level in levels]
            for start in range(0, batch * views, views_at_once):
                chunk = [level[start : start + views_at_once] for level in flat]
                pyramid = self.layer(self._pyramid, chunk, grid, image)
                parts.append([self.layer(chain, pyramid, image) for chain in chains])
        return [torch.cat(part).unflatten(0, (batch, views)) for part in zip(*parts, strict=True)]

    def _pyramid(
        self, levels: list[Tensor], grid: tuple[int, int], image: tuple[int, int]
    ) -> list[Tensor]:
        """Four maps of the levels (B', N, channels), from fine to coarse."""
        pyramid = []
        for index, level in enumerate(levels):
            x = self.norm(level).transpose(1, 2).unflatten(2, grid)
            x = _with_positions(self.projects[index](x), image)
            x = self.resize_layers[index](x)
            pyramid.append(getattr(self.scratch, f"layer{index + 1}_rn")(x))
        return pyramid

    def _depth(self, pyramid: list[Tensor], image: tuple[int, int]) -> Tensor:
        """(B', 2, H, W) before the exponential."""
        depth = self.scratch.output_conv1(self._fused(pyramid, ""))
        depth = _with_positions(_resized(depth, image), image)
        return self.scratch.output_conv2(depth)  # type: ignore[no-any-return]

    def _ray(self, pyramid: list[Tensor], image: tuple[int, int]) -> Tensor:
        """(B', 7, h, w)."""
        ray = self.scratch.output_conv1_aux[-1](self._fused(pyramid, "_aux"))
        ray = _with_positions(ray, image)
        return self.scratch.output_conv2_aux[-1](ray)  # type: ignore[no-any-return]

    def _fused(self, pyramid: list[Tensor], suffix: str) -> Tensor:
        """One RefineNet chain from the coarsest level to twice the finest one's resolution."""
        finest = pyramid[0].shape[-2:]
        sizes = [(2 * finest[0], 2 * finest[1])] + [level.shape[-2:] for level in pyramid[:3]]
        x = pyramid[3]
        for index in (3, 2, 1, 0):
            fusion = getattr(self.scratch, f"refinenet{index + 1}{suffix}")
            x = fusion(x, pyramid[index] if index < 3 else None, sizes[index])
        return x


@torch.no_grad()
def _initialise(head: GeometryHead) -> None:
    """Weights to train from: what varies between pixels keeps its size through a dozen layers.

    With torch's own, each of the convolutions in a row takes three quarters of the power and adds a
    bias of that size: a constant is all that reaches the end, and training stays there long.
    """
    if next(head.parameters()).is_meta:  # names and shapes alone; these calls are slow there
        return
    for module in head.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
            # Transposed: kernels do not overlap, so that a pixel has one input of each channel.
            transposed = isinstance(module, nn.ConvTranspose2d)
            fan = module.in_channels if transposed else module.weight[0].numel()
            nn.init.normal_(module.weight, std=fan**-0.5)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    for module in head.modules():
        if isinstance(module, ResidualConv):
            nn.init.zeros_(module.conv2.weight)
    for output in (head.scratch.output_conv2, *head.scratch.output_conv2_aux):
        last = output[-1]  # type: ignore[index]
        last.weight *= 0.1  # type: ignore[union-attr]


def _resized(x: Tensor, size: Sequence[int]) -> Tensor:
    """Bilinear, corners aligned."""
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=True)


def _with_positions(x: Tensor, image: tuple[int, int], *, ratio: float = 0.1) -> Tensor:
    """``x`` plus a tenth of the sine-cosine table of its pixels' directions in the image plane.

    Coordinates span the image's aspect on a circle of diameter 2 (VGGT, Wang et al. 2025).
    """
    channels, height, width = x.shape[1:]
    aspect = image[1] / image[0]
    diagonal = (aspect**2 + 1) ** 0.5
    span_x, span_y = aspect / diagonal, 1 / diagonal
    quarter = channels // 4
    exponent = torch.arange(quarter, dtype=torch.float64, device=x.device) / quarter
    tables = []
    for span, count in ((span_x, width), (span_y, height)):
        edge = span * (count - 1) / count
        place = torch.linspace(-edge, edge, count, dtype=torch.float64, device=x.device)
        angle = place[:, None] * 100.0**-exponent
        tables.append(torch.cat((angle.sin(), angle.cos()), dim=1))
    along_x = tables[0][None].expand(height, -1, -1)
    along_y = tables[1][:, None].expand(-1, width, -1)
    table = torch.cat((along_x, along_y), dim=-1).permute(2, 0, 1)
    return x + ratio * table.to(x.dtype)


def camera_centres(ray: Tensor, confidence: Tensor | None = None) -> Tensor:
    """(..., 3) mean of the origins of each view's rays (..., h, w, 6), weighted; differentiable."""
    origin = ray[..., 3:]
    if confidence is None:
        return origin.mean(dim=(-3, -2))
    total = confidence.sum(dim=(-2, -1))
    if not bool((total > 0).all() & (confidence >= 0).all() & torch.isfinite(total).all()):
        raise DegenerateError(
            "ray confidences are negative, not finite, or 0 all over a view; expected weights"
        )
    return (origin * confidence[..., None]).sum(dim=(-3, -2)) / total[..., None]


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """(..., 4, 4) of (..., 3, 3) and (..., 3)."""
    top = torch.cat((rotation, translation[..., None]), dim=-1)
    last = torch.eye(4, dtype=top.dtype, device=top.device)[3:].expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, last), dim=-2)
