from __future__ import annotations

import numpy as np
import pytest
from inpaint_scenes import (
    HEIGHT,
    WIDTH,
    camera,
    guidance,
    kitchen_view,
    psnr,
    wall_view,
    warp,
)
from scipy import ndimage
from skimage.restoration import inpaint_biharmonic

from gvtools.completers import ContextView, create
from gvtools.errors import OptionError
from gvtools.guidance import Guidance


def _hole(*windows) -> np.ndarray:
    valid = np.ones((HEIGHT, WIDTH), bool)
    for window in windows:
        valid[window] = False
    return valid


def _square_before_wall():
    """The wall, what is seen of it behind a near blue square, and a hole at the square's right."""
    rgb, depth = wall_view(stripes=0.5)
    seen, near = rgb.copy(), depth.copy()
    seen[35:85, 40:80], near[35:85, 40:80] = (0.0, 0.0, 1.0), 1.5
    return rgb, depth, seen, near, _hole(np.s_[35:85, 80:105])


def test_valid_pixels_come_back_bit_for_bit():
    rgb, depth = wall_view()
    valid = np.random.default_rng(0).random(depth.shape) < 0.7
    given = guidance(rgb, depth, valid, camera())
    result = create("inpaint").complete([], given)
    assert result.rgb[given.valid].tobytes() == given.rgb[given.valid].tobytes()
    assert result.depth[given.valid].tobytes() == given.depth[given.valid].tobytes()
    assert np.array_equal(result.confidence[given.valid], given.confidence[given.valid])


def test_a_hidden_wall_gets_the_walls_depth_and_colour():
    rgb, depth, seen, near, valid = _square_before_wall()
    result = create("inpaint").complete([], guidance(seen, near, valid, camera()))
    np.testing.assert_allclose(result.depth[0][~valid], depth[~valid], rtol=1e-5)
    assert psnr(result.rgb[0], rgb, ~valid) > 30
    biharmonic = inpaint_biharmonic(np.where(valid[..., None], seen, 0), ~valid, channel_axis=-1)
    assert psnr(result.rgb[0], rgb, ~valid) > psnr(biharmonic, rgb, ~valid) + 8
    # Right beside the square, where a leak would show first.
    assert np.abs(result.rgb[0] - rgb)[36:84, 80].max() < 0.1


def test_nothing_known_is_left_empty():
    rgb, depth = wall_view()
    empty = np.zeros((HEIGHT, WIDTH), bool)
    few = empty.copy()
    few[60, 80:90] = True
    for valid in (empty, few):
        result = create("inpaint").complete([], guidance(rgb, depth, valid, camera()))
        assert not result.depth[0][~valid].any()
        assert not result.confidence[0][~valid].any()
        assert not result.rgb[0][~valid].any()


def test_a_view_without_holes_comes_back():
    rgb, depth = wall_view()
    result = create("inpaint").complete([], guidance(rgb, depth, _hole(), camera()))
    assert np.array_equal(result.rgb[0], rgb)


def test_the_same_seed_gives_the_same_bytes():
    rgb, depth = wall_view()
    valid = _hole(np.s_[30:70, 40:90])
    given = guidance(rgb, depth, valid, camera())
    context = [ContextView("side", camera(0.5), *wall_view(0.5))]
    results = [create("inpaint").complete(context, given, seed=7) for _ in range(2)]
    for part in ("rgb", "depth", "confidence"):
        assert getattr(results[0], part).tobytes() == getattr(results[1], part).tobytes()


def test_confidence_falls_with_distance_and_with_the_size_of_the_hole():
    rgb, depth = wall_view()
    valid = _hole(np.s_[10:20, 10:20], np.s_[40:100, 40:120])
    confidence = create("inpaint").complete([], guidance(rgb, depth, valid, camera())).confidence[0]
    assert (confidence[valid] == 1).all()
    assert (confidence[~valid] > 0).all() and (confidence[~valid] < 1).all()
    row = confidence[70, 40:80]
    assert (np.diff(row[:30]) < 0).all()
    assert confidence[10, 15] > confidence[40, 80]


def test_reach_leaves_what_is_farther_empty():
    rgb, depth = wall_view()
    valid = _hole(np.s_[20:100, 40:120])
    result = create("inpaint", reach=0.05).complete([], guidance(rgb, depth, valid, camera()))
    distance = ndimage.distance_transform_edt(~valid)
    assert np.array_equal(result.depth[0] > 0, distance <= 0.05 * np.hypot(HEIGHT, WIDTH))


def test_photographs_give_the_texture_that_no_depth_covers():
    rgb, depth = wall_view()
    valid = _hole(np.s_[40:80, 55:105])
    given = guidance(rgb, depth, valid, camera())
    side_rgb, side_depth = wall_view(0.1)
    # The photograph shows the place, its sensor does not.
    side_depth[25:95, 30:130] = 0
    context = [ContextView("side", camera(0.1), side_rgb, side_depth)]
    with_it = psnr(create("inpaint").complete(context, given).rgb[0], rgb, ~valid)
    without = psnr(create("inpaint", context_views=0).complete(context, given).rgb[0], rgb, ~valid)
    assert with_it > 25
    assert with_it > without + 10


def test_a_photograph_of_another_surface_is_not_used():
    rgb, depth = wall_view()
    valid = _hole(np.s_[40:80, 55:105])
    given = guidance(rgb, depth, valid, camera())
    red = np.zeros_like(rgb)
    red[..., 0] = 1
    context = [ContextView("blocked", camera(0.1), red, np.full_like(depth, 1.0))]
    without = create("inpaint").complete([], given)
    blocked = create("inpaint").complete(context, given)
    assert np.array_equal(blocked.rgb, without.rgb)


def test_a_photograph_that_disagrees_with_two_others_is_outvoted():
    rgb, depth = wall_view()
    valid = _hole(np.s_[40:80, 55:105])
    given = guidance(rgb, depth, valid, camera())
    unknown = np.zeros_like(depth)
    red = np.zeros_like(rgb)
    red[..., 0] = 1
    honest = [ContextView(f"{x}", camera(x), wall_view(x)[0], unknown) for x in (-0.1, 0.1)]
    liar = ContextView("liar", camera(0.02), red, unknown)
    result = create("inpaint").complete([*honest, liar], given)
    assert psnr(result.rgb[0], rgb, ~valid) > 20


def test_views_are_completed_independently():
    rgb, depth = wall_view()
    valid = _hole(np.s_[40:80, 55:105])
    one = guidance(rgb, depth, valid, camera())
    parts = ("rgb", "depth", "valid", "confidence", "generated")
    two = Guidance(camera()[[0, 0]], *(np.repeat(getattr(one, part), 2, axis=0) for part in parts))
    result = create("inpaint").complete([], two)
    assert np.array_equal(result.rgb[0], create("inpaint").complete([], one).rgb[0])
    assert np.array_equal(result.rgb[0], result.rgb[1])


@pytest.mark.parametrize("options", [{"confidence": 1.0}, {"confidence_reach": 0.0}])
def test_options_that_no_completion_could_honour_are_refused(options):
    with pytest.raises(OptionError, match="expected"):
        create("inpaint", **options)


@pytest.mark.data
@pytest.mark.parametrize(("source", "target"), [(500, 510), (200, 210)])
def test_real_frames_are_filled_better_than_by_the_nearest_pixel(shared, source, target):
    folder = shared / "data" / "sevenscenes_reg"
    context, truth = kitchen_view(folder, source), kitchen_view(folder, target)
    given = warp(context, truth.camera)
    assert truth.depth is not None
    real, hole = truth.depth, ~given.valid[0]
    where = tuple(ndimage.distance_transform_edt(hole, return_distances=False, return_indices=True))
    measured = hole & (real > 0)

    def depth_error(depth: np.ndarray) -> float:
        return float(np.median(np.abs(depth / np.maximum(real, 1e-9) - 1)[measured]))

    result = create("inpaint").complete([context], given)
    assert psnr(result.rgb[0], truth.rgb, hole) > psnr(given.rgb[0][where], truth.rgb, hole) + 2
    assert depth_error(result.depth[0]) < 0.7 * depth_error(given.depth[0][where])
