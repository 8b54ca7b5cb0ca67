"""Stages of small models: encoder, heads and refiner; published encoders skip all three.

The encoder is trained from scratch with its geometry, ray, pose and RGB heads, on noisy features
and without level 0 now and then, since generated features are noisy and a cascade may be left out.
Depth, origins and camera centres are in units of the mean context depth, in the frame of the first
view.

After the denoisers the heads learn from what these, frozen, make. Colour and depth learn from
completions, made in as many steps as in use: what is uncertain about generated features, and where
their tokens meet, the encoder's stage could not know. Cameras are read off the rays, which that
stage, with five more terms, leaves before they are as good as its features allow. The layers that
depth and rays share stay as they are.

The refiner comes last, on what the frozen core makes. That costs far more than a step of the
refiner, and is cached: where ``data.pool`` shows samples again they are completed once. The refiner
sees them mirrored, cut out and in other colours each time; a few thousand views would soon be known
by heart.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from gvtools.completers.geoverse.composition import compose, correct_depth, remove_seams
from gvtools.completers.geoverse.conditioning import ViewBatch, encode_views, fill_holes
from gvtools.completers.geoverse.model import GeoVerse
from gvtools.completers.geoverse.objective import high_gradient_loss, rgb_loss
from gvtools.completers.geoverse.refiner import CompletedViews, completed_views
from gvtools.errors import OptionError
from gvtools.networks.depth_anything.encoder import encode_cameras, patch_rays
from gvtools.networks.depth_anything.geometry_head import ViewGeometry
from gvtools.training.options import EncoderStageOptions, HeadsStageOptions, RefinerStageOptions
from gvtools.training.samples import Draws, TrainingBatch
from gvtools.training.stages import Stage

# Pull of the confidence towards certainty against the error (DA3, VGGT).
CONFIDENCE_REWARD = 0.2


class EncoderStage(Stage):
    """A geometric encoder from scratch, with its geometry, ray, pose and RGB heads."""

    name = "encoder"

    options: EncoderStageOptions

    def learning_parts(self) -> Iterable[nn.Module | None]:
        """The encoder and its heads."""
        return self.model.geometry, self.model.rgb_head

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        model, options = self.model, self.options
        levels, token = noisy_features(model, batch, draws, options=options)
        geometry, rgb = decode_heads(model, levels, batch)
        unit = scene_unit(batch)
        depth = batch.depth[:, :, 0] / unit[:, None, None, None]
        direction, origin = _ray_errors(geometry, batch)
        terms = {
            "depth": _depth_error(geometry, depth),
            "gradient": _gradient_error(geometry.depth, depth),
            "ray": _with_confidence((direction + origin) / 2, geometry.ray_confidence),
            "rgb": (rgb - batch.images).abs().mean(),
            "hf": high_gradient_loss(rgb, batch.images).mean(),
            "pose": self._pose_error(token, batch, unit),
        }
        total = sum(getattr(options, name) * value for name, value in terms.items())
        with torch.no_grad():
            terms["rgb_psnr"] = -10 * (rgb.clamp(0, 1) - batch.images).square().mean().log10()
            known = depth > 0
            terms["depth_rel"] = (geometry.depth[known] / depth[known] - 1).abs().median()
        return torch.as_tensor(total), terms

    def _pose_error(self, token: Tensor, batch: TrainingBatch, unit: Tensor) -> Tensor:
        """The camera decoder's L1 error, centres in units of the mean context depth."""
        relative = batch.relative.float()
        relative[..., :3, 3] /= unit[:, None, None]
        truth = encode_cameras(relative, batch.views.K, batch.views.size)
        return (self.model.geometry.cam_dec(token.float()) - truth).abs().mean()


def noisy_features(
    model: GeoVerse,
    batch: TrainingBatch,
    draws: Draws,
    *,
    options: EncoderStageOptions | HeadsStageOptions,
) -> tuple[list[Tensor], Tensor]:
    """``head_features`` of all views; noise on levels 0 and 1, level 0 of some at its mean."""
    # True pictures; a share of the targets shows its projection, filled as inference fills it.
    views = batch.true_views
    hints = fill_holes(batch.views, model.config.hints).images
    swap = draws.uniform("hints", views.images.shape[1]).to(hints.device) < options.hints
    swap[:, : views.context] = False
    images = torch.where(swap[:, :, None, None, None], hints, views.images)
    views = replace(views, images=images)
    levels = encode_views(model.geometry, views, slice(None), config=model.config.hints)
    amount = options.noise * draws.uniform("noise", 1, 1, 1).to(views.images.device)
    noisy = []
    for index, level in enumerate(levels):
        spread = level.detach().float().std(dim=(1, 2), keepdim=True)
        noise = draws.normal(f"noise{index}", level.shape, level.device)
        noisy.append(level + amount * spread * noise)
    drop = draws.uniform("level0", 1, 1, 1).to(level.device) < options.drop_level0
    mean = noisy[0].detach().mean(dim=(1, 2), keepdim=True)
    noisy[0] = torch.where(drop, mean, noisy[0])
    return head_features(model, noisy, batch)


def head_features(
    model: GeoVerse, levels: Sequence[Tensor], batch: TrainingBatch
) -> tuple[list[Tensor], Tensor]:
    """What the heads get of levels 0 and 1, the deeper levels made of level 1.

    Four (B, V, N, C), normed, without token 0; and (B, V, C) token 0 of the last one.
    """
    encoder = model.geometry.encoder
    pyramid = [*levels, *encoder.propagate(levels[1], encoder.grid(*batch.views.size))]
    normed = [encoder.normed(level[:, :, 1:].float()) for level in pyramid]
    return normed, pyramid[-1][:, :, 0]


def decode_heads(
    model: GeoVerse, levels: list[Tensor], batch: TrainingBatch
) -> tuple[ViewGeometry, Tensor]:
    """The geometry and the colour (B, V, 3, H, W) that the heads make of features."""
    grid = model.geometry.encoder.grid(*batch.views.size)
    rgb = model.rgb_head(torch.cat(levels, dim=-1).flatten(0, 1), grid)
    return model.geometry.head(levels, grid), rgb.unflatten(0, batch.images.shape[:2])


def scene_unit(batch: TrainingBatch) -> Tensor:
    """(B,) mean true depth of the context views: the network's unit of length."""
    depth = batch.depth[:, : batch.views.context]
    known = depth > 0
    return (depth * known).sum(dim=(1, 2, 3, 4)) / known.sum(dim=(1, 2, 3, 4)).clamp_min(1)


def _ray_errors(geometry: ViewGeometry, batch: TrainingBatch) -> tuple[Tensor, Tensor]:
    """(B, V, h, w) L1 of the rays' directions (z = 1 in the camera), and of their origins.

    In the frame of the first view; a ray belongs to the middle of its cell of the ray grid.
    """
    grid = (geometry.ray.shape[-3], geometry.ray.shape[-2])
    rays = patch_rays(batch.relative.float(), batch.views.K, grid, size=batch.views.size)[..., :6]
    direction, origin = rays.unflatten(2, grid).split(3, dim=-1)
    unit = scene_unit(batch)[:, None, None, None, None]
    return (
        (geometry.ray[..., :3] - direction).abs().mean(-1),
        (geometry.ray[..., 3:] - origin / unit).abs().mean(-1),
    )


def _depth_error(geometry: ViewGeometry, depth: Tensor) -> Tensor:
    """L1 of the logarithm where depth is known, and the confidence's loss."""
    known = depth > 0
    error = (geometry.depth.log() - torch.where(known, depth, 1.0).log()).abs()
    return _with_confidence(error, geometry.depth_confidence, known)


def _with_confidence(error: Tensor, confidence: Tensor, known: Tensor | None = None) -> Tensor:
    """Error and its confidence's loss, mean over samples of each one's mean over known values."""
    # The confidence learns from the error, and does not weigh it: small errors, whose confidence is
    # high, would otherwise rule the gradient.
    value = error + confidence * error.detach() - CONFIDENCE_REWARD * confidence.log()
    return value.mean() if known is None else masked_mean(value, known)


def masked_mean(value: Tensor, known: Tensor) -> Tensor:
    """Mean over samples of each one's mean over known values; a sample without any counts as 0."""
    total = torch.where(known, value, 0.0).flatten(1).sum(1)
    return (total / known.flatten(1).sum(1).clamp_min(1)).mean()


def _gradient_error(predicted: Tensor, depth: Tensor) -> Tensor:
    """L1 of log-depth differences between neighbours, where both are known."""
    total = predicted.new_zeros(())
    known = depth > 0
    log = torch.where(known, depth, 1.0).log()
    for dim in (-1, -2):
        size = depth.shape[dim] - 1
        both = known.narrow(dim, 0, size) & known.narrow(dim, 1, size)
        gap = predicted.log().diff(dim=dim) - log.diff(dim=dim)
        total = total + masked_mean(gap.abs(), both)
    return total


@torch.no_grad()
def measure_statistics(model: GeoVerse, batches: list[TrainingBatch]) -> None:
    """Mean and variance of levels 0 and 1 over true pictures, into ``model.statistics``."""
    channels = model.config.geometry.encoder.channels
    sums = torch.zeros(2, channels, dtype=torch.float64)
    squares = torch.zeros_like(sums)
    count = 0
    for batch in batches:
        levels = encode_views(
            model.geometry, batch.true_views, slice(None), config=model.config.hints
        )
        for index, level in enumerate(levels):
            patches = level[:, :, 1:].double()
            sums[index] += patches.sum(dim=(0, 1, 2)).cpu()
            squares[index] += patches.square().sum(dim=(0, 1, 2)).cpu()
        count += levels[0][..., 1:, 0].numel()
    for index, statistics in enumerate(model.level_statistics):
        mean = sums[index] / count
        statistics.mean.copy_(mean)
        statistics.var.copy_(squares[index] / count - mean.square())


class HeadsStage(Stage):
    """The heads, on what the frozen denoisers make."""

    name = "heads"

    options: HeadsStageOptions

    def learning_parts(self) -> Iterable[nn.Module | None]:
        """The heads that have a weight."""
        model, options = self.model, self.options
        rays = model.geometry.head.chain(rays=True) if options.ray else []
        depth = model.geometry.head.chain(rays=False) if options.depth else []
        return [*rays, model.rgb_head if options.rgb else None, *depth]

    def forward(self, batch: TrainingBatch, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms for the log."""
        model, options = self.model, self.options
        total = batch.images.new_zeros(())
        terms: dict[str, Tensor] = {}
        if options.ray:
            with torch.no_grad():
                levels, _ = noisy_features(model, batch, draws, options=options)
            geometry = model.geometry.head(levels, model.geometry.encoder.grid(*batch.views.size))
            direction, origin = _ray_errors(geometry, batch)
            terms = {"direction": direction.mean(), "origin": origin.mean()}
            error = (direction + options.origin * origin) / 2
            total = total + options.ray * _with_confidence(error, geometry.ray_confidence)
        if options.rgb or options.depth:
            errors = self._completion_errors(batch, draws)
            color = errors["rgb"] + options.hf * errors["hf"]
            color = color + options.decoded * errors["rgb_decoded"]
            length = errors["depth"] + options.decoded * errors["depth_decoded"]
            total = total + options.rgb * color + options.depth * length
            terms |= errors
        return total, terms

    def _completion_errors(self, batch: TrainingBatch, draws: Draws) -> dict[str, Tensor]:
        """Errors of the targets as inference makes them; gradients reach the heads alone."""
        model, context = self.model, batch.views.context
        with torch.no_grad():
            prepared = self.prepare(batch, draws)
            like = prepared.hints.level1
            level1 = model.sample1(
                prepared,
                draws.normal("eps1", like.shape, like.device),
                temperature=self.options.temperature,
            )
            level0 = model.sample0(prepared, level1, draws.normal("eps0", like.shape, like.device))
        made = model.decode(prepared, level0, level1, targets_alone=True)
        rgb, depth = batch.images[:, context:], batch.depth[:, context:, 0]
        # Decoded depth is in units of the mean context depth, a correction's in the scene's.
        scaled = depth / scene_unit(batch)[:, None, None, None]
        hint, wanted, judged = None, scaled, torch.ones_like(depth, dtype=torch.bool)
        if model.config.composition == "correction":
            # What memory knows is kept as it is.
            hint = model.decode(prepared, level0, prepared.hints.unmasked, targets_alone=True)
            wanted, judged = depth, ~batch.views.valid[:, context:, 0]
        image, length = compose(prepared.batch, made, hint)
        return {
            "rgb": rgb_loss(image, rgb, valid=judged).mean(),
            "hf": high_gradient_loss(image, rgb, valid=judged).mean(),
            "rgb_decoded": rgb_loss(made.rgb, rgb).mean(),
            "depth": log_error(length, wanted, judged),
            "depth_decoded": log_error(made.depth, scaled, depth > 0),
        }


def log_error(depth: Tensor, truth: Tensor, judged: Tensor) -> Tensor:
    """L1 of log-depths where both are known: mean over samples of each one's mean, or 0.

    ``depth``: (B, T, H, W); 0 = none. ``judged``: (B, T, H, W) bool, pixels that count.
    """
    judged = judged & (depth > 0) & (truth > 0)
    error = torch.where(judged, depth, 1.0).log() - torch.where(judged, truth, 1.0).log()
    return masked_mean(error.abs(), judged)


# Completions of so many samples are cached; of 8 views at 96 x 96 that is 1 GB.
CACHED = 3072
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
    """The refiner, on completions that the frozen core makes once a sample."""

    name = "refiner"

    options: RefinerStageOptions

    def __init__(self, model: GeoVerse, options: RefinerStageOptions) -> None:
        if model.refiner is None or model.config.composition != "correction":
            raise OptionError(
                "stage refiner: expected a model with refiner and composition = 'correction' in "
                "its configuration, such as tiny"
            )
        super().__init__(model, options)
        self._cache: dict[bytes, tuple[Tensor, Tensor]] = {}

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
        fresh = [row for row, key in enumerate(keys) if key not in self._cache]
        pairs = {}
        if fresh:
            rows = torch.tensor(fresh, device=views.images.device)
            names = [
                [f"{keys[row].hex()} {view}" for view in range(views.images.shape[1])]
                for row in fresh
            ]
            rgb, depth = self._generate(views.samples(rows), names)
            # Rounded, whether from the cache or not.
            pairs = {keys[row]: (rgb[i].half(), depth[i].half()) for i, row in enumerate(fresh)}
            for key in list(pairs)[: max(0, CACHED - len(self._cache))]:
                self._cache[key] = (pairs[key][0].cpu(), pairs[key][1].cpu())
        device = views.images.device
        chosen = [pairs.get(key) or self._cache[key] for key in keys]
        rgb, depth = (torch.stack([pair[i].float().to(device) for pair in chosen]) for i in (0, 1))
        return rgb, depth

    def _generate(self, views: ViewBatch, names: list[list[str]]) -> tuple[Tensor, Tensor]:
        """As ``_completions``, by the model."""
        model, context = self.model, views.context
        training = model.training
        model.eval()
        generated = model.generate(views, names=names, bounds=(1.0, 0.0), targets_alone=True)
        generated = remove_seams(generated, model.config.patch)
        model.train(training)
        decoded, hint = generated.decoded, generated.hint
        assert hint is not None
        hints = fill_holes(views, model.config.hints)
        rgb, _ = compose(hints, decoded, hint)
        known, valid = (values[:, context:].flatten(0, 1) for values in (hints.depth, hints.valid))
        first, second = (each.depth.flatten(0, 1)[:, None] for each in (decoded, hint))
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

    share, *places = draws.numbers("window", 3).tolist()
    rows, columns = (
        _part(side, CUT + (1 - CUT) * share, place)
        for side, place in zip(truth.shape[-2:], places, strict=True)
    )

    def cut(values: Tensor) -> Tensor:
        turned = torch.where(mirrored[:, None, None, None], values.flip(-1), values)
        return turned[..., rows, columns]

    views = CompletedViews(
        filled=colored(cut(views.filled)),
        depth=cut(views.depth),
        valid=cut(views.valid),
        evidence=cut(views.evidence),
        made=colored(cut(views.made)),
        mean=colored(views.mean),
    )
    return views, colored(cut(truth)), [cut(values) for values in maps]


def _part(side: int, share: float, place: float) -> slice:
    """An even number of a side's pixels, from an even place."""
    length = 2 * round(share * side / 2)
    first = 2 * int(place * ((side - length) // 2 + 1))
    return slice(first, first + length)


def _key(hint: Tensor, context: int) -> bytes:
    """Of what a sample shows: the same for the same sample of a pool."""
    return hashlib.sha256(bytes([context]) + hint.cpu().numpy().tobytes()).digest()[:16]
