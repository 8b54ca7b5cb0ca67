# mypy: no-check-untyped-defs
from __future__ import annotations

from dataclasses import replace

import geoverse_models as micro
import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from gvtools.completers import create
from gvtools.completers.geoverse.composition import REFINED
from gvtools.completers.geoverse.conditioning import fill_holes
from gvtools.completers.geoverse.refiner import (
    PRIOR_PIXELS,
    CompletedViews,
    Refiner,
    RefinerConfig,
    completed_views,
    distance_to,
)
from gvtools.completers.geoverse.weights import save_pretrained

pytestmark = pytest.mark.usefixtures("one_thread")
SMALL = RefinerConfig(widths=(8, 16))


def refiner(*, seed: int = 0, awake: bool = True) -> Refiner:
    torch.manual_seed(seed)
    built = Refiner(SMALL).eval()
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
    assert 0.01 < float(moved.abs().max()) <= SMALL.offset + 1e-5
    still = Refiner(replace(SMALL, offset=0.0)).eval()
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
    with_one = micro.model(micro.config(refiner=SMALL, **changes))
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
