from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import geoverse_models as micro
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gvtools.completers import Completer, Completion, ContextView, create
from gvtools.completers.geoverse.config import FlowConfig
from gvtools.completers.geoverse.flow import (
    MOST_SHIFT,
    check_bounds,
    clean_from_velocity,
    interpolate,
    interval_times,
    reflow_pair,
    sample,
    seeded_noise,
    shift_time,
    time_grid,
    unshift_time,
    velocity_from_clean,
    velocity_target,
)
from gvtools.completers.geoverse.objective import gradient_weights, high_gradient_loss, rgb_loss
from gvtools.completers.push_pull import push_pull, push_pull_depth
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance

pytest.importorskip("safetensors", reason="weights are read with safetensors")
pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.filterwarnings("error")]

NAMES = ("none", "inpaint", "decoded", "correction")
GENERATIVE = ("decoded", "correction")
SIZE = (24, 32)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("models")
    fills = {"decoded": "push-pull", "correction": "surfaces"}
    return {
        name: micro.weights_folder(
            place / name,
            micro.config(hints={"cameras": True, "fill": fill, "mask": 0.0}, composition=name),
        )
        for name, fill in fills.items()
    }


@pytest.fixture(scope="module")
def completers(folders: dict[str, Path]) -> dict[str, Completer]:
    made = {"none": create("none"), "inpaint": create("inpaint", min_support=1)}
    for name in GENERATIVE:
        weights = str(folders[name])
        made[name] = create("geoverse", weights=weights, steps=1, alignment="hint")
    return made


def complete(
    completers: dict[str, Completer], name: str, context: Sequence[ContextView], known: Guidance
) -> Completion:
    with np.errstate(all="raise", under="ignore"):
        return completers[name].complete(context, known, seed=1)


def flat(valid: np.ndarray, *, color: float = 0.4, depth: float = 3.0) -> Guidance:
    plain = micro.guidance(1, size=valid.shape)
    known = valid[None]
    return replace(
        plain,
        rgb=np.repeat(np.where(known, color, 0)[..., None], 3, -1).astype(np.float32),
        depth=np.where(known, depth, 0).astype(np.float32),
        valid=known,
        confidence=known.astype(np.float32),
        generated=np.zeros_like(known),
    )


def check(made: Completion, known: Guidance) -> None:
    for values in (made.rgb, made.depth, made.confidence):
        assert np.isfinite(values).all()
    assert made.rgb.min() >= 0 and made.rgb.max() <= 1
    assert made.depth.min() >= 0
    assert made.confidence.min() >= 0 and made.confidence.max() <= 1
    assert not made.confidence[made.depth == 0].any()
    np.testing.assert_array_equal(made.rgb[known.valid], known.rgb[known.valid])
    np.testing.assert_array_equal(made.depth[known.valid], known.depth[known.valid])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 2), (1, 40), SIZE])
def test_masks_of_nothing_everything_and_a_half_at_any_size(completers, name, size):
    half = np.zeros(size, np.bool_)
    half[:, : max(1, size[1] // 2)] = True
    context = micro.context_views(2)
    for valid in (np.zeros(size, np.bool_), np.ones(size, np.bool_), half):
        known = flat(valid)
        made = complete(completers, name, context, known)
        check(made, known)
        if name in GENERATIVE:
            # The context's own depth gives the scale where memory tells nothing.
            assert (made.depth > 0).all()
        elif name == "none" or not valid.any():
            assert not made.depth[~known.valid].any()


def test_a_constant_picture_is_continued_as_it_is(completers):
    valid = np.ones(SIZE, np.bool_)
    valid[8:16, 10:20] = False
    for color in (0.0, 0.4, 1.0):
        known = flat(valid, color=color)
        made = complete(completers, "inpaint", [], known)
        np.testing.assert_allclose(made.rgb, color, atol=1e-6)
        np.testing.assert_allclose(made.depth, 3, rtol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_no_photograph_is_enough_or_said_and_one_is_enough(completers, name):
    known = micro.guidance(1, size=SIZE)
    for context in ([], micro.context_views(1), micro.context_views(1, depth=False)):
        if not context and name in GENERATIVE:
            with pytest.raises(OptionError, match="at least one context view"):
                complete(completers, name, context, known)
            continue
        made = complete(completers, name, context, known)
        check(made, known)
        assert name == "none" or (made.depth > 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_no_target_is_an_empty_completion(completers, name):
    plain = micro.guidance(1, size=SIZE)
    none = {f: getattr(plain, f)[:0] for f in ("rgb", "depth", "valid", "confidence", "generated")}
    nothing = Guidance(plain.cameras[:0], **none)
    made = complete(completers, name, micro.context_views(1), nothing)
    assert made.rgb.shape == (0, *SIZE, 3)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("power", [-30, 30])
def test_the_unit_of_the_scene_does_not_matter(completers, name, power):
    context, known = micro.context_views(2), micro.guidance(1, size=SIZE)
    far = micro.moved(context, known, scale=10.0**power)
    made, plain = complete(completers, name, *far), complete(completers, name, context, known)
    check(made, far[1])
    np.testing.assert_allclose(made.depth / np.float32(10.0**power), plain.depth, rtol=1e-3)
    assert np.mean(np.abs(made.rgb - plain.rgb).max(-1) > 1e-3) < 0.005


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("what", "bad"), [("rgb", np.nan), ("depth", np.inf), ("confidence", np.nan)]
)
def test_memory_that_is_not_finite_is_refused_and_named_and_holes_may_hold_it(
    completers, name, what, bad
):
    known = micro.guidance(1, size=SIZE)
    context = micro.context_views(2)
    row, column = np.argwhere(known.valid[0])[5]
    damaged = {what: getattr(known, what).copy()}
    damaged[what][0, row, column] = bad
    with pytest.raises(ShapeError, match=r"view target_1_0: 1 pixel\(s\) hold NaN"):
        complete(completers, name, context, replace(known, **damaged))
    holes = {what: getattr(known, what).copy()}
    holes[what][~known.valid] = bad
    made = complete(completers, name, context, replace(known, **holes))
    plain = complete(completers, name, context, known)
    np.testing.assert_array_equal(made.rgb, plain.rgb)
    np.testing.assert_array_equal(made.depth, plain.depth)


@pytest.mark.parametrize("name", NAMES)
def test_photographs_that_are_not_finite_are_refused_and_named(completers, name):
    context = micro.context_views(2)
    context[1].rgb[3, 4, 0] = np.inf
    with pytest.raises(ShapeError, match=r"view photo_0_1: 1 pixel\(s\) hold NaN"):
        complete(completers, name, context, micro.guidance(1, size=SIZE))


@pytest.mark.parametrize("name", NAMES)
def test_depth_of_a_photograph_that_is_none_counts_as_none(completers, name):
    known = micro.guidance(1, size=SIZE)
    views = micro.context_views(2)
    damaged = [replace(v, depth=np.full(v.rgb.shape[:2], np.nan, np.float32)) for v in views]
    without = [replace(v, depth=None) for v in views]
    made, plain = (complete(completers, name, context, known) for context in (damaged, without))
    np.testing.assert_array_equal(made.rgb, plain.rgb)
    np.testing.assert_array_equal(made.depth, plain.depth)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (65, 47)])
def test_one_known_pixel_fills_everything_and_none_fills_nothing(dtype, size):
    values = torch.full((1, 2, *size), float("nan"), dtype=dtype)
    valid = torch.zeros(1, 1, *size, dtype=torch.bool)
    assert not push_pull(values, valid).any()
    assert not push_pull_depth(values[:, :1], valid).any()
    valid[..., -1, -1], values[..., -1, -1] = True, 2.5
    rounding = 4 * torch.finfo(dtype).eps
    for filled in (push_pull(values, valid), push_pull_depth(values[:, :1], valid)):
        torch.testing.assert_close(filled, torch.full_like(filled, 2.5), rtol=rounding, atol=0)


DTYPES = (torch.float32, torch.bfloat16, torch.float16)
# float32 carries the state: a thousand roundings of it, and one to the dtype.
EXACT = {torch.float32: 1e-4, torch.bfloat16: 2e-2, torch.float16: 2e-3}
SHAPE = (2, 3, 4, 5, 5)


def states(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    first, second = (
        seeded_noise(SHAPE, [[k, k + 1, k + 2], [k + 3, k + 4, k + 5]], dtype=dtype)
        for k in (0, 10)
    )
    return first, second


def toward(clean: Tensor) -> float:
    """Largest size of a latent, the unit of its rounding."""
    return float(clean.float().abs().max())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("steps", [1, 2, 1000])
def test_any_number_of_steps_reaches_the_clean_state_in_every_precision(dtype, steps):
    clean, noise = states(dtype)
    constant = velocity_target(clean, noise)

    def shrinking(state: Tensor, t: Tensor) -> Tensor:
        return velocity_from_clean(clean, state, t, least=1e-6)

    for velocity in (lambda state, t: constant, shrinking):
        for shift in (1.0, 1 / MOST_SHIFT, 6.0, MOST_SHIFT):
            made = sample(velocity, noise, time_grid(steps, shift=shift))
            assert made.dtype == dtype
            gap = float((made.float() - clean.float()).abs().max())
            assert gap <= EXACT[dtype] * toward(noise)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batched", [False, True])
def test_the_ends_of_the_path_are_its_ends_bit_for_bit(dtype, batched):
    clean, noise = states(dtype)
    for t, end in ((0.0, clean), (1.0, noise)):
        time = torch.full((2,), t) if batched else t
        assert torch.equal(interpolate(clean, noise, time), end)
    velocity = velocity_target(clean, noise)
    time = torch.ones(2) if batched else 1.0
    gap = (clean_from_velocity(velocity, noise, time) - clean).float().abs().max()
    assert float(gap) <= 2 * torch.finfo(dtype).eps * toward(velocity)
    still = torch.zeros(2) if batched else 0.0
    assert torch.equal(clean_from_velocity(velocity, clean, still), clean)
    assert velocity_from_clean(clean, noise, still).isfinite().all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_states_up_to_half_the_largest_number_are_sampled_and_beyond_it_saturate(dtype):
    """u = noise - clean has to be a number of the dtype; the state itself may fill it."""
    large = 0.49 * torch.finfo(dtype).max
    clean, noise = torch.full((1, 1), -large, dtype=dtype), torch.full((1, 1), large, dtype=dtype)
    velocity = velocity_target(clean, noise)
    assert velocity.isfinite().all()
    made = sample(lambda state, t: velocity, noise, (1, 0.5, 0))
    torch.testing.assert_close(made, clean)
    assert velocity_target(2.02 * clean, 2.02 * noise).isinf().all()


@settings(max_examples=60, deadline=None)
@given(
    st.one_of(st.sampled_from([0.0, 1e-9, 1 - 1e-9, 1.0]), st.floats(0, 1, allow_subnormal=False)),
    st.floats(-6, 6).map(lambda power: min(max(10.0**power, 1 / MOST_SHIFT), MOST_SHIFT)),
)
def test_shifted_times_stay_in_order_and_come_back(t, shift):
    moved = shift_time(t, shift)
    assert 0 <= moved <= 1
    assert (moved == 0) == (t == 0)
    assert shift_time(0.0, shift) == 0 and shift_time(1.0, shift) == 1
    assert shift_time(torch.ones(1), shift).item() == 1
    # One rounding of the shifted time is so much of the unshifted one.
    assert unshift_time(moved, shift) == pytest.approx(t, abs=4e-16 * max(shift, 1 / shift))
    # 1 - t' is the shift by 1 / s of 1 - t.
    other = shift_time(1 - t, 1 / shift)
    assert 1 - moved == pytest.approx(other, abs=4e-16 * max(shift, 1 / shift))
    wide = shift_time(torch.tensor([t], dtype=torch.float64), shift)
    assert wide.item() == pytest.approx(moved, rel=1e-15)


@pytest.mark.parametrize("shift", [0.99 / MOST_SHIFT, 1.01 * MOST_SHIFT])
def test_a_shift_that_rounds_times_away_is_refused(shift):
    for name in ("shift", "sampling_shift"):
        with pytest.raises(OptionError, match=rf"flow\.{name} "):
            FlowConfig(**{name: shift})


@pytest.mark.parametrize("shift", [1 / MOST_SHIFT, 1.0, MOST_SHIFT])
@pytest.mark.parametrize("steps", [1, 100_000])
def test_grids_of_any_length_fall_strictly(steps, shift):
    assert len(check_bounds(time_grid(steps, shift=shift))) == steps + 1


@settings(max_examples=150, deadline=None)
@given(
    st.floats(0.001, 0.95),
    st.floats(-3.99, -0.5).map(lambda power: 10.0**power),
    st.one_of(st.sampled_from([0.0, 1 - 2**-24]), st.floats(0, 1 - 2**-24, width=32)),
)
def test_times_drawn_from_the_shortest_intervals_are_learnt_from(lower, width, share):
    upper = min(lower + width, 0.999)
    bounds = (1.0, upper, lower, 0.0)
    which = torch.tensor([0.5])
    intervals, t = interval_times(which, torch.tensor([share]), bounds)
    clean, noise = torch.zeros(1, 2), torch.ones(1, 2)
    pair = reflow_pair(
        lambda state, t: torch.ones_like(state), clean, noise,
        intervals=intervals, t=t, bounds=bounds, steps=1,
    )  # fmt: skip
    # The straight path's state is its time, to the rounding of the time.
    assert pair.state.isfinite().all() and pair.velocity.isfinite().all()
    torch.testing.assert_close(pair.state, t[:, None].expand(1, 2), atol=2e-7, rtol=0)
    # A difference of states, rounded, over the interval.
    torch.testing.assert_close(pair.velocity, torch.ones(1, 2), atol=4e-7 / (upper - lower), rtol=0)


GRID = (9, 11)


def pictures(*, size: tuple[int, int] = GRID, views: int = 2) -> torch.Tensor:
    return torch.rand(1, views, 3, *size, generator=torch.Generator().manual_seed(0))


def everywhere(images: torch.Tensor) -> torch.Tensor:
    return torch.ones(*images.shape[:2], *images.shape[-2:], dtype=torch.bool)


@settings(max_examples=30, deadline=None)
@given(
    st.floats(-1e4, 1e4),
    st.sampled_from([torch.float16, torch.bfloat16, torch.float32, torch.float64]),
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
)
def test_constant_pictures_of_any_brightness_size_and_precision_have_no_weight(value, dtype, size):
    images = torch.full((1, 2, 3, *size), value, dtype=dtype)
    assert not gradient_weights(images, everywhere(images)).any()


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("loss", [rgb_loss, high_gradient_loss])
def test_reference_pixels_that_are_not_finite_count_as_absent_in_the_losses(loss, poison):
    reference = pictures()
    predicted = (reference + 0.1).requires_grad_()
    damaged = reference.clone()
    damaged[0, 0, 1, 2:5, 3:6] = poison
    masked = everywhere(reference)
    masked[0, 0, 2:5, 3:6] = False
    found = loss(predicted, damaged)
    assert found.item() == pytest.approx(loss(predicted, reference, valid=masked).item())
    (gradient,) = torch.autograd.grad(found.sum(), predicted)
    assert gradient.isfinite().all() and not gradient[0, 0, :, 2:5, 3:6].any()
