# mypy: no-check-untyped-defs
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import geoverse_models as micro
import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from torch import nn

from gvtools.completers import Completion, ScaleStatus, create
from gvtools.completers.geoverse.composition import (
    DOUBTED,
    MOST,
    REFINED,
    align_color,
    compose,
    correct_color,
    correct_depth,
    depth_ratios,
    without_seams,
)
from gvtools.completers.geoverse.conditioning import fill_holes
from gvtools.completers.geoverse.model import Decoded
from gvtools.completers.geoverse.refiner import (
    PRIOR_PIXELS,
    CompletedViews,
    Refiner,
    RefinerConfig,
    completed_views,
    distance_to,
)
from gvtools.completers.geoverse.rgb_head import RGBHead, RGBHeadConfig, sine_table
from gvtools.completers.geoverse.weights import save_pretrained
from gvtools.completers.surface_fill import surface_fill
from gvtools.networks.depth_anything.encoder import IMAGENET_MEAN, IMAGENET_STD

HEAD = RGBHeadConfig(
    in_channels=20, width=16, depth=2, heads=2, mlp=24, patch=4, base_grid=(3, 5), eps=1e-12
)


def head(config: RGBHeadConfig = HEAD, *, seed: int = 0) -> RGBHead:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        module = RGBHead(config)
        nn.init.normal_(module.trainable_cls_token)
        for parameter in module.parameters():
            if parameter.ndim == 1:
                nn.init.normal_(parameter, mean=0.5, std=0.3)
    return module.double().eval()


def features(views: int, grid: tuple[int, int], *, seed: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    shape = (views, grid[0] * grid[1], HEAD.in_channels)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def test_the_layers_are_torchs_pre_norm_encoder_layers():
    module = head()
    x = features(3, HEAD.base_grid)
    ours = module.logits(x, HEAD.base_grid)
    y = module.decoder_embed(x)
    y = torch.cat((module.trainable_cls_token.expand(3, -1, -1), y), 1) + module.decoder_pos_embed
    for layer in module.decoder_layers:
        theirs = nn.TransformerEncoderLayer(
            HEAD.width, HEAD.heads, HEAD.mlp, dropout=0.0, activation="gelu",
            layer_norm_eps=HEAD.eps, batch_first=True, norm_first=True,
        ).double()  # fmt: skip
        own = layer.state_dict()
        part = {
            name: torch.cat(
                [own[f"attention.attention.{k}.{name}"] for k in ("query", "key", "value")]
            )
            for name in ("weight", "bias")
        }
        theirs.load_state_dict(
            {f"self_attn.in_proj_{name}": value for name, value in part.items()}
            | {
                f"{there}.{name}": own[f"{here}.{name}"]
                for there, here in (
                    ("self_attn.out_proj", "attention.output.dense"),
                    ("linear1", "intermediate.dense"),
                    ("linear2", "output.dense"),
                    ("norm1", "layernorm_before"),
                    ("norm2", "layernorm_after"),
                )
                for name in ("weight", "bias")
            }
        )
        y = theirs(y)
    theirs_logits = module.decoder_pred(module.decoder_norm(y)[:, 1:])
    torch.testing.assert_close(ours, theirs_logits, rtol=1e-9, atol=1e-9)


def test_pixels_go_where_their_patch_lies():
    module, grid, patch = head(), (2, 3), HEAD.patch
    logits = torch.randn(2, 6, patch * patch * 3, dtype=torch.float64)
    found = module.image(logits, grid).numpy()
    assert found.shape == (2, 3, 2 * patch, 3 * patch)
    for view, c, y, x in np.ndindex(found.shape):
        token = (y // patch) * 3 + x // patch
        channel = ((y % patch) * patch + x % patch) * 3 + c
        expected = logits[view, token, channel].item() * IMAGENET_STD[c] + IMAGENET_MEAN[c]
        assert found[view, c, y, x] == pytest.approx(expected)


def test_the_sine_table_in_closed_form():
    width, (rows, columns) = 16, (3, 5)
    found = sine_table(width, (rows, columns)).numpy()
    assert found.dtype == np.float32 and not found[0].any()
    for y, x, i in np.ndindex(rows, columns, width // 4):
        row = found[1 + y * columns + x]
        rate = 10000 ** (-i / (width // 4))
        expected = [f(p * rate) for p in (x, y) for f in (np.sin, np.cos)]
        np.testing.assert_allclose(row[i :: width // 4], expected, atol=1e-7)


def test_the_table_is_the_constructors_and_is_saved_but_not_trained():
    module = RGBHead(HEAD)
    assert "decoder_pos_embed" in module.state_dict()
    assert "decoder_pos_embed" not in dict(module.named_parameters())
    assert module.positions(HEAD.base_grid) is module.decoder_pos_embed
    other = module.positions((6, 10))
    assert other.shape == (1, 61, HEAD.width)
    torch.testing.assert_close(other[:, 0], module.decoder_pos_embed[:, 0])
    # Twice the grid: the mean over 2 x 2 cells is near the table (bicubic, so not exactly).
    fine = other[0, 1:].unflatten(0, (3, 2, 5, 2)).mean(dim=(1, 3))[1:-1, 1:-1]
    table = module.decoder_pos_embed[0, 1:].unflatten(0, (3, 5))[1:-1, 1:-1]
    torch.testing.assert_close(fine, table, rtol=0, atol=0.1)


@pytest.mark.parametrize("chunk", [1, 2, 5])
def test_chunks_change_neither_pictures_nor_gradients(chunk):
    module, grid = head(), (4, 3)
    results = []
    for options in ({}, {"chunk": chunk}):
        x = features(3, grid).requires_grad_()
        image = module(x, grid, **options)
        image.square().sum().backward()
        weight = module.decoder_embed.weight.grad
        assert weight is not None
        results.append((image.detach(), x.grad, weight.clone()))
        module.zero_grad()
    for whole, parts in zip(*results, strict=True):
        torch.testing.assert_close(parts, whole)


REFINER = RefinerConfig(widths=(8, 16))


def refiner(*, seed: int = 0, awake: bool = True) -> Refiner:
    torch.manual_seed(seed)
    built = Refiner(REFINER).eval()
    return micro.awake(built, seed=seed) if awake else built


def views(count: int = 3, *, size: tuple[int, int] = (20, 28), seed: int = 0) -> CompletedViews:
    generator = torch.Generator().manual_seed(seed)
    picture = torch.rand(count, 3, *size, generator=generator)
    valid = torch.zeros(count, 1, *size, dtype=torch.bool)
    valid[..., : size[1] // 2] = True
    return CompletedViews(
        filled=picture,
        depth=2 + torch.rand(count, 1, *size, generator=generator),
        valid=valid,
        evidence=torch.rand(count, 2, *size, generator=generator),
        made=torch.where(valid, picture, torch.rand(count, 3, *size, generator=generator)),
        mean=torch.rand(count, 3, generator=generator),
    )


@pytest.mark.parametrize("share", [0.002, 0.05, 0.9])
def test_the_distance_is_euclidean(share):
    known = torch.rand(2, 1, 31, 18, generator=torch.Generator().manual_seed(1)) < share
    known[:, :, 7, 5] = True
    expected = np.stack([distance_transform_edt(~view[0]) for view in known.numpy()])
    np.testing.assert_allclose(distance_to(known)[:, 0].numpy(), expected, rtol=1e-6)
    nothing = distance_to(torch.zeros(1, 1, 4, 4, dtype=torch.bool))
    assert nothing.isfinite().all() and float(nothing.min()) >= 8


def test_an_untrained_refiner_leaves_most_as_it_is_and_what_is_known_alone():
    given = views()
    found = refiner(awake=False)(given)
    # e^3 against five guesses of 1.
    assert torch.allclose(found.share, torch.tensor(20.0855 / 25.0855), atol=1e-4)
    picture = found.colors(given.made, given.valid)
    known = given.valid.expand_as(picture)
    assert torch.equal(picture[known], given.made[known])
    assert 0 < float((picture - given.made)[~known].detach().abs().mean()) < 0.1


def test_colours_are_mixed_of_what_is_there_and_a_bounded_offset():
    given = views()
    # One colour everywhere: every guess is that colour, and only the offset can change it.
    grey = torch.full_like(given.made, 0.5)
    plain = replace(given, filled=grey, made=grey, mean=torch.full_like(given.mean, 0.5))
    network = refiner()
    moved = network(plain).colors(plain.made, plain.valid) - 0.5
    assert 0.01 < float(moved.abs().max()) <= REFINER.offset + 1e-5
    still = Refiner(replace(REFINER, offset=0.0)).eval()
    still.load_state_dict(network.state_dict())
    assert torch.allclose(still(plain).colors(plain.made, plain.valid), grey, atol=1e-5)


def test_a_view_of_which_nothing_is_known_keeps_the_cores_picture():
    given = views(2)
    nothing = replace(
        given,
        valid=torch.zeros_like(given.valid),
        depth=torch.zeros_like(given.depth),
        evidence=torch.zeros_like(given.evidence),
    )
    found = refiner()(nothing)
    assert torch.equal(found.colors(nothing.made, nothing.valid), nothing.made)
    # A pixel is enough, and most of its mean is the photographs'.
    nothing.valid[1, :, 4, 6] = True
    network = refiner(awake=False)
    with torch.no_grad():
        # All to the last guess.
        network.leave.bias[5] = 50.0
    picture = network(nothing).colors(nothing.made, nothing.valid)
    assert torch.equal(picture[0], nothing.made[0])
    hole = picture[1][:, ~nothing.valid[1, 0]]
    share = 0.25 / (0.25 + PRIOR_PIXELS)
    expected = torch.lerp(given.mean[1], given.filled[1, :, 4, 6], share)
    assert torch.allclose(hole, expected[:, None].expand_as(hole), atol=1e-4)


@pytest.mark.parametrize("size", [(16, 16), (18, 34), (7, 9), (24, 2)])
def test_any_size_is_taken_and_any_size_refined(size):
    given = views(2, size=size)
    found = refiner()(given)
    assert found.share.shape == (2, 1, -(-size[0] // 2), -(-size[1] // 2))
    large = torch.rand(2, 3, 3 * size[0], 5 * size[1])
    valid = torch.rand(2, 1, 3 * size[0], 5 * size[1]) < 0.5
    picture = found.colors(large, valid)
    assert picture.shape == large.shape and picture.isfinite().all()


def test_the_targets_of_a_batch_are_taken_with_their_contexts_mean():
    batch = fill_holes(micro.batch(2), micro.config(hints={"fill": "push-pull"}).hints)
    made = torch.rand(2, 2, 3, *micro.SIZE)
    found = completed_views(batch, made)
    assert torch.equal(found.filled, batch.images[:, 2:].flatten(0, 1))
    mean = batch.images[1, :2].mean((0, 2, 3))
    assert torch.allclose(found.mean[2:], mean.expand(2, 3)) and not found.evidence.any()


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    changes = {"composition": "correction", "hints": {"fill": "surfaces"}}
    with_one = micro.model(micro.config(refiner=REFINER, **changes))
    without = micro.model(micro.config(**changes))
    without.load_state_dict(
        {n: t for n, t in with_one.state_dict().items() if not n.startswith("refiner.")}
    )
    out = tmp_path_factory.mktemp("weights")
    save_pretrained(with_one, out / "with")
    save_pretrained(without, out / "without")
    return out


def test_completions_are_refined_in_holes_alone(folders):
    context, known = micro.context_views(2), micro.guidance(2)
    before, after = (
        create("geoverse", weights=str(folders / name), device="cpu").complete(context, known)
        for name in ("without", "with")
    )
    for name in ("rgb", "depth", "confidence"):
        given, found = getattr(before, name), getattr(after, name)
        assert np.array_equal(given[known.valid], found[known.valid]), name
    holes = ~known.valid
    assert np.array_equal(before.depth, after.depth)
    assert np.abs(before.rgb - after.rgb)[holes].mean() > 1e-3
    assert ((after.rgb >= 0) & (after.rgb <= 1)).all()
    certain = after.confidence[holes & (after.depth > 0)]
    assert 0 < certain.max() <= REFINED and certain.std() > 0
    assert not after.confidence[after.depth == 0].any()
    # The decoded pictures themselves are not refined.
    decoded = [
        create("geoverse", weights=str(folders / name), device="cpu", composition="decoded")
        for name in ("without", "with")
    ]
    first, second = (each.complete(context, known).rgb for each in decoded)
    assert np.array_equal(first, second)


HINTS = {"cameras": True, "fill": "surfaces", "mask": 0.0}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("micro")
    return micro.weights_folder(folder, micro.config(hints=HINTS, composition="correction"))


def complete(weights: Path, size: tuple[int, int], **options: Any) -> Completion:
    completer = create("geoverse", weights=str(weights), device="cpu", **options)
    return completer.complete(micro.context_views(2), micro.guidance(2, size=size), seed=1)


def stripes(offset: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    hint = torch.rand(2, 3, 16, 24, generator=generator) + offset
    valid = torch.zeros(2, 1, 16, 24, dtype=torch.bool)
    valid[..., :12] = True
    return hint, valid


def test_a_model_that_changes_nothing_leaves_the_filled_projection():
    filled, valid = stripes()
    made = torch.rand(2, 3, 16, 24)
    assert torch.equal(correct_color(filled, made, made, valid=valid), filled)
    depth = filled[:, :1] + 1
    assert torch.allclose(
        correct_depth(depth, made[:, :1] + 1, made[:, :1] + 1, valid=valid), depth
    )


def test_a_change_of_everything_is_none_and_one_of_the_hole_is_whole():
    filled, valid = stripes()
    hint = torch.rand(2, 3, 16, 24)
    assert torch.allclose(correct_color(filled, hint + 0.2, hint, valid=valid), filled, atol=1e-5)
    change = torch.where(valid, 0.0, 0.3)
    found = correct_color(filled, hint + change, hint, valid=valid)
    assert torch.allclose(found, filled + change, atol=1e-5)
    depth = filled[:, :1] + 1
    grown = correct_depth(depth, torch.where(valid, 1.0, 9.0), torch.ones_like(depth), valid=valid)
    assert torch.allclose(grown, torch.where(valid, depth, MOST * depth), rtol=1e-4)
    assert (correct_depth(torch.zeros_like(depth), depth, depth + 1, valid=valid) == 0).all()


def test_every_depth_correction_has_a_gradient_while_training():
    batch = micro.batch(1)
    batch = replace(batch, depth=torch.full_like(batch.depth, 2.0))
    shape = (1, batch.images.shape[1] - batch.context, *batch.images.shape[-2:])
    for factor in (1.0, 1.001, 40.0):
        depth = torch.full(shape, factor, requires_grad=True)
        rgb = torch.zeros((*shape[:2], 3, *shape[2:]))
        one = torch.ones(shape)
        _, found = compose(batch, Decoded(rgb, depth, one), Decoded(rgb, one, one))
        holes = ~batch.valid[:, batch.context :, 0]
        assert holes.any()
        found.sum().backward()
        assert depth.grad is not None
        assert (depth.grad[holes].abs() > 0).all(), factor


def test_colours_follow_the_memory():
    hint, valid = stripes()
    made = hint - 0.1
    found = align_color(made, hint.clamp(0, 1), valid)
    assert torch.allclose(found, hint.clamp(0, 1), atol=1e-5)
    broken = made.clone()
    broken[0, :, 3, 3] = torch.nan
    kept = align_color(broken, hint, valid)
    assert kept[0, :, 3, 3].isnan().all() and kept[1].isfinite().all()


@pytest.mark.parametrize("size", [(30, 40), (24, 32), (100, 133)])
def test_without_denoising_the_completion_is_the_fill(weights, size):
    known = micro.guidance(2, size=size)
    made = complete(weights, size, steps=0)
    fill = surface_fill(micro.context_views(2), known, shared=True)
    np.testing.assert_allclose(made.rgb, fill.rgb, atol=1e-5)
    np.testing.assert_allclose(made.depth, fill.depth, rtol=1e-5)
    assert fill.confidence is not None
    # As sure as the fill; half as sure in a view whose decoded depth is not the memory's.
    holes = ~known.valid
    share = made.confidence[holes] / fill.confidence[holes]
    assert np.isin(share, (DOUBTED, 1)).all()
    assert {a and a.status for a in made.scale_alignment or ()} == {ScaleStatus.MEMORY_SURFACES}


def test_denoising_changes_holes_alone(weights):
    size = (30, 40)
    known = micro.guidance(2, size=size)
    fill, made = (complete(weights, size, steps=steps) for steps in (0, 2))
    hole = ~known.valid
    assert made.rgb[known.valid].tobytes() == known.rgb[known.valid].tobytes()
    assert np.abs(made.rgb - fill.rgb)[hole].max() > 1e-3
    assert (made.confidence[hole] > 0).all() and (made.confidence[hole] < 1).all()
    decoded = complete(weights, size, composition="decoded")
    assert np.abs(decoded.rgb - made.rgb)[hole].max() > 1e-3


def test_a_view_that_memory_tells_nothing_of_leaves_the_others_as_they_are(weights):
    size = (30, 40)
    known = micro.guidance(2, size=size)
    completer = create(
        "geoverse", weights=str(weights), device="cpu", context_views=2, shared_fill=False
    )
    both = completer.complete(micro.context_views(2), known, seed=1)
    for values in (known.valid, known.rgb, known.depth):
        values[1] = 0
    one = completer.complete(micro.context_views(2), known, seed=1)
    known_view, empty_view = one.scale_alignment or ()
    assert known_view and known_view.status is ScaleStatus.MEMORY_SURFACES
    assert empty_view and empty_view.status is not ScaleStatus.MEMORY_SURFACES
    assert (one.confidence[0] > 0).all() and (one.depth[0] > 0).all()
    # The empty view is seen by the model too, so that only the form is the same.
    hole = ~known.valid[0]
    np.testing.assert_allclose(one.depth[0][hole], both.depth[0][hole], rtol=0.5)


def test_a_views_unit_is_its_ratio_to_memory_and_none_where_they_disagree():
    known = micro.guidance(2, size=(30, 40))
    made = known.depth / np.array([4.0, 0.5], np.float32)[:, None, None]
    made[0, :3] = np.nan
    np.testing.assert_allclose(depth_ratios(known, made), [4.0, 0.5], rtol=1e-5)
    made[1] *= np.exp(np.random.default_rng(0).normal(0, 1, made[1].shape)).astype(np.float32)
    assert np.isnan(depth_ratios(known, made)[1])
    known.valid[0] = False
    assert np.isnan(depth_ratios(known, made)).all()


def test_steps_between_patches_go_and_what_a_patch_shows_stays():
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(2, 3, 4, 5, generator=generator)
    detail = torch.rand(2, 3, 24, 30, generator=generator)
    detail = detail - without_means(detail)
    picture = means.repeat_interleave(6, -1).repeat_interleave(6, -2) + detail
    smooth = without_seams(picture, 6)
    # Across a border the means differ by a sixth of their step, a pixel on.
    across = (smooth - detail).diff(dim=-1).abs().amax()
    assert across <= means.diff(dim=-1).abs().amax() / 6 + 1e-5
    assert (picture - detail).diff(dim=-1).abs().amax() > 3 * across
    # Patches that agree are left alone, and so is a picture of one patch.
    flat = 0.3 + detail
    torch.testing.assert_close(without_seams(flat, 6), flat)
    one = picture[..., :6, :6]
    torch.testing.assert_close(without_seams(one, 6), one)


def without_means(values: torch.Tensor) -> torch.Tensor:
    means = torch.nn.functional.avg_pool2d(values, 6)
    return means.repeat_interleave(6, -1).repeat_interleave(6, -2)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_broken_pixel_does_not_spread_when_seams_are_taken_away(bad):
    picture = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(4))
    picture[0, 1, 7, 8] = bad
    smooth = without_seams(picture, 6)
    assert int((~smooth.isfinite()).sum()) == 1 and not smooth[0, 1, 7, 8].isfinite()
    picture[0, 0, :6, :6] = bad
    assert int((~without_seams(picture, 6).isfinite()).sum()) == 37
