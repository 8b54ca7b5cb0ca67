"""A small network behind the core: how far each pixel of a hole is to be trusted.

Far from what is known a fill is a guess, and so is what the core makes of it. For each pixel of a
hole the refiner mixes the core's picture with smoother guesses, moves the mixture by a bounded
offset, and says whether the depth is likely to be right. It works at half the model's grid; its
shares are enlarged, so that what it keeps of the core's picture keeps its detail. A departure from
the paper, which has nothing of the kind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.views import resample
from gvtools.completers.push_pull import push_pull
from gvtools.networks.config_json import check_range

# Standard deviations of the guesses, in shares of the half grid's longer side: two of the core's
# picture, one of known colours alone.
NARROW, WIDE, KNOWN = 0.03, 0.09, 0.2
# The photographs' mean colour counts as so many known pixels of the half grid.
PRIOR_PIXELS = 16.0
# Least weight of a wide average before its mean colour takes over.
PRIOR_WEIGHT = 1e-3
GUESSES = 5
# Channels: four pictures of 3, and seven maps.
INPUTS = 4 * 3 + 7
GROUPS = 8
# Inverse depth counts up to so many times that of the view's median.
NEAREST = 4.0
# What an untrained refiner gives the core's picture, in logarithms of the others' shares.
TRUST = 3.0


@dataclass(frozen=True)
class RefinerConfig:
    """Size of the refiner."""

    # Channels of each level, each of half the level's before resolution.
    widths: tuple[int, ...] = (16, 40, 80)
    offset: float = 0.2  # most that it adds to a colour

    def __post_init__(self) -> None:
        check_range("refiner.offset", self.offset, ge=0, le=1)
        check_range("number of refiner.widths", len(self.widths), ge=1)
        for width in self.widths:
            check_range("refiner.widths", width, ge=GROUPS)
            check_range(f"refiner.widths {width}: rest to a multiple of 8", width % GROUPS, le=0)


@dataclass(frozen=True, eq=False)
class CompletedViews:
    """N target views as the core leaves them, at the model's size."""

    filled: Tensor  # (N, 3, H, W) the projections, holes filled
    depth: Tensor  # (N, 1, H, W) of the fill, in any unit; 0 = none
    valid: Tensor  # (N, 1, H, W) bool, where the memory knows
    evidence: Tensor  # (N, 2, H, W) see ``ViewBatch``
    made: Tensor  # (N, 3, H, W) the core's pictures
    mean: Tensor  # (N, 3) mean colour of the view's context


@dataclass(frozen=True, eq=False)
class Refinement:
    """What the refiner says, at half the model's grid."""

    share: Tensor  # (N, 1, h, w) of the core's picture
    rest: Tensor  # (N, 3, h, w) colour that is added to it
    depth_right: Tensor  # (N, 1, h, w) logit that the depth is within 10 % of the true one

    def colors(self, made: Tensor, valid: Tensor) -> Tensor:
        """(N, 3, H, W) refined pictures of any size; what the memory knows stays."""
        size = (made.shape[-2], made.shape[-1])
        mixed = resample(self.share, size) * made + resample(self.rest, size)
        return torch.where(valid, made, mixed)


def completed_views(batch: ViewBatch, made: Tensor) -> CompletedViews:
    """The targets of all samples; ``batch`` as the model saw it, ``made`` (B, T, 3, H, W)."""
    context = batch.context
    images, depth, valid = (
        values[:, context:].flatten(0, 1) for values in (batch.images, batch.depth, batch.valid)
    )
    evidence = images.new_zeros((len(images), 2, *batch.size))
    if batch.evidence is not None:
        evidence = batch.evidence[:, context:].flatten(0, 1)
    mean = batch.images[:, :context].mean((1, 3, 4))
    mean = mean.repeat_interleave(made.shape[1], 0)
    return CompletedViews(images, depth, valid, evidence, made.flatten(0, 1).clamp(0, 1), mean)


class Refiner(nn.Module):
    """Shares, offset and trust of each pixel, see the module."""

    def __init__(self, config: RefinerConfig) -> None:
        super().__init__()
        self.config = config
        widths = config.widths
        self.enter = nn.Conv2d(INPUTS, widths[0], 3, padding=1)
        self.down = nn.ModuleList(
            nn.Conv2d(above, below, 3, stride=2, padding=1) for above, below in pairwise(widths)
        )
        self.descending = nn.ModuleList(_ResidualBlock(width) for width in widths)
        self.whole = nn.Linear(widths[-1], widths[-1])
        self.deepest = _ResidualBlock(widths[-1])
        self.up = nn.ModuleList(
            nn.Conv2d(above + below, above, 3, padding=1) for above, below in pairwise(widths)
        )
        self.ascending = nn.ModuleList(_ResidualBlock(width) for width in widths[:-1])
        self.leave = nn.Conv2d(widths[0], 1 + GUESSES + 3 + 1, 1)
        # Untrained it changes little.
        bias = torch.zeros(1 + GUESSES + 3 + 1)
        bias[0] = TRUST
        nn.init.zeros_(self.leave.weight)
        self.leave.bias = nn.Parameter(bias)

    def forward(self, views: CompletedViews) -> Refinement:
        """What to make of N views."""
        small = _halve(views)
        mean = _mean_color(small)
        guesses = _guesses(small, mean)
        x = self.enter(_inputs(views, small, mean=mean, pulled=guesses[2]))
        kept: list[Tensor] = []
        for level, block in enumerate(self.descending):
            x = block(x if level == 0 else self.down[level - 1](x))
            kept.append(x)
        x = self.deepest(x + self.whole(x.mean((2, 3)))[:, :, None, None])
        for level in reversed(range(len(self.up))):
            above = kept[level]
            larger = F.interpolate(x, size=(above.shape[-2], above.shape[-1]), mode="nearest")
            x = self.ascending[level](self.up[level](torch.cat((above, larger), 1)))
        out = self.leave(x).float()
        shares = out[:, : 1 + GUESSES].softmax(1)
        offset = self.config.offset * out[:, 1 + GUESSES : -1].tanh()
        rest = offset + sum(
            share * guess for share, guess in zip(shares[:, 1:].split(1, 1), guesses, strict=True)
        )
        # Of a view that nothing is known of there is no fill: the core's picture is all there is.
        some = _some_known(small)
        share = torch.where(some, shares[:, :1], 1.0)
        return Refinement(share, torch.where(some, rest, 0.0), out[:, -1:])


class _ResidualBlock(nn.Module):
    """Two convolutions beside the identity."""

    def __init__(self, width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for _ in range(2):
            conv = nn.Conv2d(width, width, 3, padding=1)
            layers += [nn.GroupNorm(GROUPS, width), nn.SiLU(), conv]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


@dataclass(frozen=True, eq=False)
class _Half(CompletedViews):
    """Views at half the grid; ``filled`` and ``made`` are means."""

    share: Tensor  # (N, 1, h, w) of known pixels
    known: Tensor  # (N, 3, h, w) sum of known colours, in shares of the pixels


def _halve(views: CompletedViews) -> _Half:
    known = views.valid.to(views.filled.dtype)
    filled, evidence, made, share, colors = (
        F.avg_pool2d(values, 2, ceil_mode=True, count_include_pad=False)
        for values in (views.filled, views.evidence, views.made, known, known * views.filled)
    )
    # Inverse depth of a view's own scale: the median of what has depth is 1.
    some = torch.where(views.depth > 0, views.depth, torch.nan).flatten(1)
    middle = some.nanmedian(1).values.nan_to_num(1.0)[:, None, None, None]
    inverse = torch.where(views.depth > 0, middle / views.depth.clamp_min(1e-12), 0.0)
    inverse = F.avg_pool2d(inverse.clamp_max(NEAREST), 2, ceil_mode=True, count_include_pad=False)
    return _Half(filled, inverse, share > 0, evidence, made, views.mean, share=share, known=colors)


def _mean_color(small: _Half) -> Tensor:
    """(N, 3, 1, 1) mean of the known colours, of the photographs where few are known."""
    total = small.known.sum((2, 3)) + PRIOR_PIXELS * small.mean
    count = small.share.sum((2, 3)) + PRIOR_PIXELS
    return (total / count)[:, :, None, None]


def _some_known(small: _Half) -> Tensor:
    """(N, 1, 1, 1) bool, whether anything is known of a view."""
    return small.valid.flatten(1).any(1)[:, None, None, None]


def _guesses(small: _Half, mean: Tensor) -> list[Tensor]:
    """GUESSES pictures (N, 3, h, w), from sharp to smooth."""
    weight = _blur(small.share, KNOWN) + PRIOR_WEIGHT
    pulled = push_pull(small.known / small.share.clamp_min(1e-6), small.valid)
    return [
        _blur(small.made, NARROW),
        _blur(small.made, WIDE),
        torch.where(_some_known(small), pulled, mean),
        (_blur(small.known, KNOWN) + PRIOR_WEIGHT * mean) / weight,
        mean.expand_as(small.made),
    ]


def _inputs(views: CompletedViews, small: _Half, *, mean: Tensor, pulled: Tensor) -> Tensor:
    """(N, INPUTS, h, w)."""
    rough = views.made - F.avg_pool2d(views.made, 3, stride=1, padding=1, count_include_pad=False)
    detail = F.avg_pool2d(rough.square().mean(1, keepdim=True), 2, ceil_mode=True).sqrt()
    confidence, looked_up = small.evidence.split(1, 1)
    known = small.share.mean((1, 2, 3), keepdim=True).expand_as(small.share)
    return torch.cat(
        (
            small.filled - mean,
            small.made - small.filled,
            pulled - small.made,
            mean.expand_as(small.made),
            small.depth,
            small.share,
            distance_to(small.valid).log1p() / 4,
            # From 0.001 to 1 as 0 to 1.
            (1 + (confidence + 1e-3).log() / math.log(1e3)).clamp_min(0),
            looked_up,
            10 * detail,
            known,
        ),
        1,
    )


def distance_to(known: Tensor) -> Tensor:
    """(N, 1, h, w) distance of each pixel to the nearest known one, pixels; large without any.

    Exact, a side after the other; the work grows with the cube of the side, which is small here.
    """
    height, width = known.shape[-2:]
    rows, columns = (
        torch.arange(side, device=known.device, dtype=torch.float32) for side in (height, width)
    )
    none = float(height + width) ** 2
    apart = (rows[:, None] - rows).square()[..., None]
    far = torch.where(known[:, 0], 0.0, none)
    along = (apart + far[:, None]).amin(2)
    across = (columns[:, None] - columns).square()
    return (across + along[:, :, None]).amin(3).clamp_max(none).sqrt()[:, None]


def _blur(values: Tensor, share: float) -> Tensor:
    """Gaussian means within the picture; ``share`` of its longer side is the deviation."""
    height, width = values.shape[-2:]
    deviation = share * max(height, width)
    down, right = (
        torch.softmax(-0.5 * ((place[:, None] - place) / deviation).square(), dim=1)
        for place in (
            torch.arange(side, device=values.device, dtype=values.dtype) for side in (height, width)
        )
    )
    return down @ values @ right.T
