from __future__ import annotations

import numpy as np
import pytest

from benchmarks.experiments.generated_pixels import (
    GeneratedScore,
    figures,
    gradient_energy,
    paired_interval,
    score,
)
from gvtools.errors import ShapeError

RNG = np.random.default_rng(0)
SHAPE = (2, 12, 16)


def scored(
    *, color: float = 0.0, depth: float = 1.0, seed: int = 0, holes: bool = True
) -> GeneratedScore:
    rng = np.random.default_rng(seed)
    rgb = rng.uniform(0.2, 0.8, (*SHAPE, 3)).astype(np.float32)
    lengths = rng.uniform(1, 4, SHAPE).astype(np.float32)
    generated = rng.random(SHAPE) < 0.5 if holes else np.zeros(SHAPE, np.bool_)
    return score(
        rgb + np.float32(color),
        (lengths * depth).astype(np.float32),
        true_rgb=rgb,
        true_depth=lengths,
        generated=generated,
        distance=np.full(SHAPE, 2.0, np.float32),
    )


def test_constant_errors_are_found_pooled_and_per_view():
    found = figures([scored(color=0.1, depth=1.2, seed=i) for i in range(3)])
    assert found["psnr"] == pytest.approx(20, abs=1e-3)
    assert found["psnr_view"] == pytest.approx(20, abs=1e-3)
    # The pooled median is exact to a bin, 2.3 % wide.
    assert found["depth"] == pytest.approx(0.2, rel=0.025)
    assert found["depth_view"] == pytest.approx(0.2, rel=1e-4)
    assert found["distance"] == pytest.approx(2)
    assert found["energy"] == pytest.approx(1)


def test_depth_that_is_missing_is_an_infinite_error_and_unknown_truth_is_none():
    rgb = np.zeros((*SHAPE, 3), np.float32)
    depth, truth = np.ones(SHAPE, np.float32), np.ones(SHAPE, np.float32)
    generated = np.ones(SHAPE, np.bool_)
    depth[:, :, :9] = 0  # more than half
    truth[0] = 0
    depth[0] = 50
    found = figures([score(rgb, depth, true_rgb=rgb, true_depth=truth, generated=generated)])
    assert found["depth"] is None or found["depth"] > 10
    assert found["depth_view"] == 1.0


def test_gradient_energy_leaves_out_pairs_across_the_rim():
    rgb = np.zeros((1, 4, 6, 3), np.float32)
    rgb[:, :, 3:] = 1
    where = np.zeros((1, 4, 6), np.bool_)
    where[:, :, 3:] = True
    assert gradient_energy(rgb, where) == 0
    assert gradient_energy(rgb, np.ones_like(where)) == pytest.approx(4)


def test_intervals_are_paired():
    errors = np.geomspace(0.01, 0.3, 12)
    better = [scored(color=e, seed=i) for i, e in enumerate(errors)]
    worse = [scored(color=1.05 * e, seed=i) for i, e in enumerate(errors)]
    middle, low, high = paired_interval(worse, better, "psnr")
    assert low <= middle <= high < -0.3
    assert high - low < 0.3
    assert paired_interval(better, better, "psnr") == (0, 0, 0)
    with pytest.raises(ShapeError, match="expected the same"):
        paired_interval(better, better[:3], "psnr")
