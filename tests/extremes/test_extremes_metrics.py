from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvtools.errors import ShapeError
from gvtools.evaluation.images import image_figures, psnr, relative_depth_error, ssim
from gvtools.evaluation.statistics import mean_interval

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
