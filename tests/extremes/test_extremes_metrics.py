from __future__ import annotations

import importlib.util
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvtools.errors import ShapeError
from gvtools.evaluation.images import image_figures, psnr, relative_depth_error, ssim
from gvtools.evaluation.intervals import mean_interval
from gvtools.evaluation.lpips_distance import BACKBONES, distance, load_model

pytestmark = pytest.mark.filterwarnings("error")

NOISE = np.random.default_rng(0).random((20, 24, 3))
EVERYWHERE = np.ones(NOISE.shape[:2], np.bool_)
COLORS: dict[str, Any] = {
    "noise": NOISE,
    "black": np.zeros_like(NOISE),
    "grey": np.full_like(NOISE, 0.3),
    "white": np.ones_like(NOISE),
    "bytes": (NOISE * 255).astype(np.uint8),
    "half": NOISE.astype(np.float16),
}


@pytest.mark.parametrize("name", COLORS)
def test_a_picture_is_equal_to_itself(name):
    picture = COLORS[name]
    assert psnr(picture, picture) == math.inf
    assert ssim(picture, picture) == pytest.approx(1, abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.floats(0, 1), st.floats(0, 1))
def test_two_constant_pictures_have_their_closed_form(first, second):
    one, other = np.full((12, 12, 3), first), np.full((12, 12, 3), second)
    found = ssim(one, other)
    # Without variance only the luminance term of SSIM is left.
    wanted = (2 * first * second + 1e-4) / (first**2 + second**2 + 1e-4)
    assert found == pytest.approx(wanted, abs=1e-9)
    gap = (first - second) ** 2
    ratio = psnr(one, other)
    assert ratio == (math.inf if gap == 0 else pytest.approx(-10 * math.log10(gap), rel=1e-9))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 255.0, -1.01])
@pytest.mark.parametrize("call", [psnr, ssim, lambda a, b: image_figures(a, b, {"": None})])
def test_values_that_are_no_colours_are_refused_wherever_they_stand(call, bad):
    damaged = NOISE.copy()
    damaged[0, 0, 1] = bad
    for pair in ((damaged, NOISE), (NOISE, damaged)):
        with pytest.raises(ShapeError, match=r"expected floats in \[0, 1\]"):
            call(*pair)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (10, 11), (0, 5)])
def test_small_and_empty_pictures_have_what_they_can_have(size):
    picture = np.full((*size, 3), 0.5)
    wanted = math.inf if picture.size else None
    assert psnr(picture, picture) == wanted
    assert image_figures(picture, picture, {"": None})[""] == {"psnr": wanted, "ssim": None}
    with pytest.raises(ShapeError, match="11x11"):
        ssim(picture, picture)


def test_an_empty_mask_has_no_figure_and_a_full_one_those_of_the_picture():
    other = np.clip(NOISE + 0.1, 0, 1)
    found = image_figures(NOISE, other, {"no": ~EVERYWHERE, "all": EVERYWHERE, "whole": None})
    assert found["no"] == {"psnr": None, "ssim": None}
    assert found["all"] == found["whole"]
    assert psnr(NOISE, other, mask=~EVERYWHERE) is None
    assert ssim(NOISE, other, mask=~EVERYWHERE) is None
    rim = EVERYWHERE.copy()
    rim[5:-5, 5:-5] = False
    assert ssim(NOISE, other, mask=rim) is None


DEPTH = np.random.default_rng(1).uniform(1, 2, (20, 24))


@settings(max_examples=30, deadline=None)
@given(st.integers(-38, 38), st.just(0.0) | st.floats(1e-30, 2))
def test_relative_depth_errors_have_no_unit(power, factor):
    truth = DEPTH * 10.0**power
    found = relative_depth_error(truth * factor, truth)
    if factor == 0:
        assert found is None
    else:
        assert found == pytest.approx(abs(factor - 1), abs=1e-15)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0, -1.0])
def test_depth_that_is_none_is_not_compared(bad):
    damaged = DEPTH.copy()
    damaged[:15] = bad
    for pair in ((damaged, DEPTH * 2), (DEPTH, np.where(damaged == DEPTH, 2 * DEPTH, bad))):
        assert relative_depth_error(*pair) == pytest.approx(0.5)
        assert relative_depth_error(*pair, mask=np.arange(20)[:, None] + 0 * DEPTH < 15) is None
    assert relative_depth_error(np.full_like(DEPTH, bad), DEPTH) is None
    assert relative_depth_error(DEPTH, DEPTH, mask=~EVERYWHERE) is None
    assert relative_depth_error(DEPTH[:1, :1], DEPTH[:1, :1]) == 0


@pytest.mark.parametrize(
    ("values", "mean", "n"),
    [
        ([], None, 0),
        ([None, math.nan], None, 0),
        ([math.inf, 1.0], math.inf, 2),
        ([-math.inf, 1.0], -math.inf, 2),
        ([math.inf, -math.inf], None, 2),
        ([1e-30], 1e-30, 1),
    ],
)
def test_means_that_have_no_interval(values, mean, n):
    found = mean_interval(values)
    assert (found.mean, found.low, found.high, found.n) == (mean, None, None, n)


@pytest.mark.skipif(importlib.util.find_spec("lpips") is None, reason="needs the package lpips")
def test_lpips_of_equal_constant_and_smallest_pictures(tmp_path):
    import torch

    torch.manual_seed(0)
    backbone = BACKBONES["alex"]
    weights = {f"features.{k}": v for k, v in backbone.build().state_dict().items()}
    torch.save(weights, tmp_path / backbone.file)
    model = load_model("alex", tmp_path / backbone.file)
    black = np.zeros((32, 32, 3), np.uint8)
    noise = np.random.default_rng(0).integers(0, 256, black.shape, dtype=np.uint8)
    for picture in (black, black + 128, black + 255, noise):
        value, spread = distance(model, picture, picture)
        assert value == 0 and not spread.any()
    for pair in ((black, black + 255), (black, noise)):
        value, spread = distance(model, *pair)
        assert 0 < value < 10 and np.isfinite(spread).all()
    with pytest.raises(ShapeError, match="at least 32x32"):
        distance(model, black[:31], black[:31])
    with pytest.raises(ShapeError, match="uint8"):
        distance(model, *[np.full(black.shape, np.nan)] * 2)  # type: ignore[arg-type]
