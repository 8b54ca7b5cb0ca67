"""The stage after the heads: the refiner, on what the frozen core makes.

What the core makes of a sample costs far more than a step of the refiner, and is kept: where
``data.pool`` shows samples again they are completed once. The refiner sees them mirrored, cut out
and in other colours each time; a few thousand views would soon be known by heart.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.composition import compose, correct_depth, remove_seams
from gvtools.completers.geoverse.conditioning import ViewBatch, fill_holes
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.refiner import CompletedViews, completed_views, crop_views
from gvtools.errors import OptionError
from gvtools.training.batch import Draws, TrainingBatch
from gvtools.training.options import RefinerStageOptions
from gvtools.training.stages import Stage

# Completions of so many samples are kept; of 8 views at 96 x 96 that is 1 GB.
KEPT = 3072
# A view with fewer pixels to generate does not count.
FEWEST = 16
# Squared error below which a view's errors are no longer counted up.
LEAST_ERROR = 3e-4
# Depth within this share of the true one is right.
RIGHT = 0.1
# Ranges of the changed colours: exponents, and gains in logarithms.
GAMMA, GAIN = 0.4, 0.3
# Least side of what is cut out, as a share.
CUT = 0.6


class RefinerStage(Stage):
    """Loss of the refiner; see the module."""

    name = "refiner"

    options: RefinerStageOptions

    def __init__(self, model: GeoVerse, options: RefinerStageOptions) -> None:
        if model.refiner is None or model.config.composition != "correction":
            raise OptionError(
                "stage refiner: expected a model with refiner and composition = 'correction' in "
                "its configuration, such as tiny"
            )
        super().__init__(model, options)
        self._kept: dict[bytes, tuple[Tensor, Tensor]] = {}

    def learning_parts(self) -> Iterable[nn.Module | None]:
        """The refiner."""
        return [self.model.refiner]

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        assert self.model.refiner is not None
        context = batch.views.context
        rgb, depth = self._completions(batch.views)
        shown = completed_views(fill_holes(batch.views, self.model.config.hints), rgb)
        truth, true_depth = (
            values[:, context:].flatten(0, 1) for values in (batch.images, batch.depth)
        )
        right = (depth.flatten(0, 1)[:, None] / true_depth.clamp_min(1e-12) - 1).abs() < RIGHT
        views, truth, (right, known) = augment(shown, truth, (right, true_depth > 0), draws=draws)
        with torch.autocast(truth.device.type, enabled=False):
            found = self.model.refiner(views)
        holes = ~views.valid
        error, count = view_errors(found.colors(views.made, views.valid), truth, holes)
        before, _ = view_errors(views.made, truth, holes)
        share = (count >= FEWEST).float() / (count >= FEWEST).sum().clamp_min(1)
        color = 0.5 * ((error + LEAST_ERROR).log() * share).sum()
        size = (truth.shape[-2], truth.shape[-1])
        logit = nn.functional.interpolate(
            found.depth_right, size=size, mode="bilinear", align_corners=False
        )
        judged = (holes & known).float()
        wrong = nn.functional.binary_cross_entropy_with_logits(
            logit, right.float(), reduction="none"
        )
        sure = (wrong * judged).sum() / judged.sum().clamp_min(1)
        psnr = -10 * ((error + 1e-6).log10() * share).sum()
        gain = psnr + 10 * ((before + 1e-6).log10() * share).sum()
        terms = {"color": color, "depth_right": sure, "psnr": psnr, "gain": gain}
        return color + self.options.depth * sure, terms

    @torch.no_grad()
    def _completions(self, views: ViewBatch) -> tuple[Tensor, Tensor]:
        """Pictures (B, T, 3, H, W) and depth (B, T, H, W) of the core, made once a sample."""
        keys = [_key(image, views.context) for image in views.images]
        fresh = [row for row, key in enumerate(keys) if key not in self._kept]
        made = {}
        if fresh:
            rows = torch.tensor(fresh, device=views.images.device)
            names = [
                [f"{keys[row].hex()} {view}" for view in range(views.images.shape[1])]
                for row in fresh
            ]
            rgb, depth = self._made(views.samples(rows), names)
            made = {keys[row]: (rgb[i], depth[i]) for i, row in enumerate(fresh)}
            room = max(0, KEPT - len(self._kept))
            for key in list(made)[:room]:
                self._kept[key] = (made[key][0].half().cpu(), made[key][1].half().cpu())
        found = [made.get(key) or self._kept[key] for key in keys]
        device = views.images.device
        # Rounded, whether kept or just made.
        rgb, depth = (
            torch.stack([pair[i].half().float().to(device) for pair in found]) for i in (0, 1)
        )
        return rgb, depth

    def _made(self, views: ViewBatch, names: list[list[str]]) -> tuple[Tensor, Tensor]:
        """As ``_completions``, by the model."""
        model, context = self.model, views.context
        training = model.training
        model.eval()
        found = model.generate(views, names=names, bounds=(1.0, 0.0), targets_alone=True)
        found = remove_seams(found, model.config.patch)
        model.train(training)
        assert found.hint is not None
        shown = fill_holes(views, model.config.hints)
        rgb, _ = compose(shown, found.decoded, found.hint)
        known, valid = (values[:, context:].flatten(0, 1) for values in (shown.depth, shown.valid))
        first, second = (d.depth.flatten(0, 1)[:, None] for d in (found.decoded, found.hint))
        depth = correct_depth(known, first, second, valid=valid)
        return rgb.clamp(0, 1), depth.unflatten(0, rgb.shape[:2])[:, :, 0]


def view_errors(made: Tensor, truth: Tensor, holes: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) mean squared colour error of each view's holes, and the number of their pixels.

    ``made``: (N, 3, H, W). ``holes``: (N, 1, H, W) bool.
    """
    squared = (made - truth).square().mean(1, keepdim=True) * holes
    count = holes.sum((1, 2, 3))
    return squared.sum((1, 2, 3)) / count.clamp_min(1), count


def augment(
    views: CompletedViews, truth: Tensor, maps: Iterable[Tensor], *, draws: Draws
) -> tuple[CompletedViews, Tensor, list[Tensor]]:
    """Views and what they are compared with: mirrored, in other colours, and cut out alike.

    ``truth``: (N, 3, H, W) true pictures. ``maps``: (N, 1, H, W) each.
    """
    count = len(views.made) // len(draws.samples)
    device = views.made.device
    drawn = draws.uniform("changes", 9).to(device).repeat_interleave(count, 0)
    mirrored = drawn[:, 0] < 0.5
    order = drawn[:, 1:4].argsort(1)
    exponent = (GAMMA * (2 * drawn[:, 4] - 1)).exp()[:, None]
    gain = (GAIN * (2 * drawn[:, 5:8] - 1)).exp()

    def colored(values: Tensor) -> Tensor:
        flat = values.flatten(2) if values.ndim == 4 else values[..., None]
        flat = flat.gather(1, order[..., None].expand_as(flat)).clamp(0, 1)
        flat = (flat ** exponent[..., None] * gain[..., None]).clamp(0, 1)
        return flat.reshape(values.shape)

    def turned(values: Tensor) -> Tensor:
        return torch.where(mirrored[:, None, None, None], values.flip(-1), values)

    views = replace(
        views,
        filled=colored(turned(views.filled)),
        depth=turned(views.depth),
        valid=turned(views.valid),
        evidence=turned(views.evidence),
        made=colored(turned(views.made)),
        mean=colored(views.mean),
    )
    share, *places = draws.numbers("window", 3).tolist()
    rows, columns = (
        _part(side, CUT + (1 - CUT) * share, place)
        for side, place in zip(truth.shape[-2:], places, strict=True)
    )
    truth = colored(turned(truth))[..., rows, columns]
    cut = [turned(values)[..., rows, columns] for values in maps]
    return crop_views(views, (rows, columns)), truth, cut


def _part(side: int, share: float, place: float) -> slice:
    """An even number of a side's pixels, from an even place."""
    length = 2 * round(share * side / 2)
    first = 2 * int(place * ((side - length) // 2 + 1))
    return slice(first, first + length)


def _key(hint: Tensor, context: int) -> bytes:
    """Of what a sample shows: the same for the same sample of a pool."""
    return hashlib.sha256(bytes([context]) + hint.cpu().numpy().tobytes()).digest()[:16]
