from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import geoverse_models as micro
import numpy as np
import pytest
import torch

from gvtools.completers import Completion, ScaleStatus, create
from gvtools.completers.geoverse.composition import (
    DOUBTED,
    MOST,
    align_color,
    compose,
    correct_color,
    correct_depth,
    depth_ratios,
    without_seams,
)
from gvtools.completers.geoverse.model import Decoded
from gvtools.completers.surface_fill import surface_fill
from gvtools.errors import OptionError

pytest.importorskip("safetensors", reason="weights are read with safetensors")
pytestmark = pytest.mark.usefixtures("one_thread")

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


def test_what_does_not_fit_is_refused(weights):
    with pytest.raises(OptionError, match="needs filled hints"):
        micro.config(composition="correction")


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
