from __future__ import annotations

import numpy as np
import pytest
import torch
from walls import blotches, camera_at, cast, photograph

from gvtools.cameras import concatenate
from gvtools.completers.push_pull import push_pull, push_pull_depth
from gvtools.completers.surface_fill import AVERAGED, CARRIED, surface_fill
from gvtools.guidance import Guidance

pytestmark = pytest.mark.usefixtures("one_thread")


def windows_of_two(values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted means and mean weights of 2 x 2 windows, fewer at an odd edge."""
    rows, columns = (-(-side // 2) for side in weight.shape)
    mean = np.zeros((len(values), rows, columns))
    share = np.zeros((rows, columns))
    for i, j in np.ndindex(rows, columns):
        window = np.s_[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
        share[i, j] = weight[window].mean()
        if weight[window].sum() > 0:
            sums = (values * weight)[(slice(None), *window)].sum((1, 2))
            mean[:, i, j] = sums / weight[window].sum()
    return mean, share


def between(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    found = np.zeros((len(values), *size))
    for i, j in np.ndindex(*size):
        places = []
        for index, side, full in ((i, values.shape[1], size[0]), (j, values.shape[2], size[1])):
            place = min(max((index + 0.5) * side / full - 0.5, 0), side - 1)
            low = int(place)
            places.append((low, min(low + 1, side - 1), place - low))
        (top, bottom, v), (left, right, u) = places
        found[:, i, j] = (1 - v) * ((1 - u) * values[:, top, left] + u * values[:, top, right])
        found[:, i, j] += v * ((1 - u) * values[:, bottom, left] + u * values[:, bottom, right])
    return found


def plain_push_pull(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The definition, for one (C, H, W) image."""
    known = np.where(valid, values, 0.0)
    if valid.shape == (1, 1):
        return known
    coarse, share = windows_of_two(known, valid.astype(float))
    return np.where(valid, values, between(_pulled(coarse, share), valid.shape))


def _pulled(values: np.ndarray, share: np.ndarray) -> np.ndarray:
    weight = np.minimum(4 * share, 1)
    if share.shape == (1, 1):
        return values
    coarse, coarser = windows_of_two(values, weight)
    return weight * values + (1 - weight) * between(_pulled(coarse, coarser), share.shape)


@pytest.mark.parametrize(
    "size", [(1, 1), (1, 2), (1, 9), (7, 1), (2, 2), (3, 3), (5, 8), (13, 6), (16, 16), (17, 11)]
)
@pytest.mark.parametrize("share", [0.02, 0.3, 0.9])
def test_holes_are_filled_as_the_plain_algorithm_fills_them(size, share):
    rng = np.random.default_rng(size[0] * 100 + size[1])
    values = rng.normal(size=(2, 3, *size))
    valid = rng.random((2, 1, *size)) < share
    given = torch.from_numpy(np.where(valid, values, np.nan))
    found = push_pull(given, torch.from_numpy(valid))
    for index in range(2):
        expected = plain_push_pull(values[index], valid[index, 0])
        if not valid[index].any():
            expected = np.zeros_like(expected)
        np.testing.assert_allclose(found[index].numpy(), expected, rtol=1e-10, atol=1e-12)


def test_depth_is_filled_in_its_logarithm():
    depth = torch.zeros(3, 1, 4, 8)
    depth[0, :, :, :4], depth[0, :, :, 6:] = 1.0, 4.0
    depth[1, 0, 2, 2] = 7.0
    depth[0, 0, 0, 0] = torch.nan
    found = push_pull_depth(depth, torch.ones_like(depth, dtype=torch.bool))
    log = push_pull(depth.nan_to_num(1).clamp_min(0.5).log(), depth > 0)
    torch.testing.assert_close(found[0], log[0].exp())
    assert found[0].min() >= 1 - 1e-6 and found[0].max() <= 4 + 1e-5
    torch.testing.assert_close(found[1], torch.full_like(found[1], 7.0))
    assert not found[2].any()


SCALE = 0.8


@pytest.fixture(scope="module")
def corner() -> tuple[Guidance, np.ndarray, np.ndarray]:
    """Two views of a room, their true depth, and what the second sees of the first's.

    The first lacks a narrow strip of the left wall, the second knows the right third alone, so that
    nothing there tells it of that wall.
    """
    rng = np.random.default_rng(0)
    textures = [blotches(rng) for _ in range(3)]
    cameras = [camera_at((x, 0, 0), scale=SCALE, name=f"view {x}") for x in (0.0, 0.08)]
    pictures = [photograph(camera, textures) for camera in cameras]
    rgb = np.stack([picture.rgb for picture in pictures]) / np.float32(255)
    depth = np.stack([cast(camera)[1] for camera in cameras])
    height, width = depth.shape[1:]
    valid = np.ones(depth.shape, bool)
    valid[0, 10 : height - 10, 12:24] = False
    valid[1, :, : 2 * width // 3] = False
    strip = ~valid[0] & (cast(cameras[0])[0] == 2)
    _, _, points = cast(cameras[1])
    row, column = np.moveaxis(_pixels(points, cameras[0]), -1, 0)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    seen = np.zeros((height, width), bool)
    seen[inside] = strip[row[inside], column[inside]]
    assert strip.sum() > 300 and seen.sum() > 300
    known = Guidance(
        concatenate(cameras),
        np.where(valid[..., None], rgb, 0).astype(np.float32),
        np.where(valid, depth, 0).astype(np.float32),
        valid,
        valid.astype(np.float32),
        np.zeros_like(valid),
    )
    return known, depth, seen


def _pixels(points, camera):
    """(..., 2) row and column of points in a camera."""
    local = points @ camera.cam_from_world[0, :3, :3].T + camera.cam_from_world[0, :3, 3]
    at = local @ camera.K[0].T
    return np.floor(at[..., 1::-1] / at[..., 2:]).astype(int)


def test_what_one_view_is_surer_of_is_carried_to_the_others(corner):
    known, depth, seen = corner
    alone, shared = (surface_fill([], known, shared=value) for value in (False, True))
    error = {
        name: float(np.median(np.abs(fill.depth[1] / depth[1] - 1)[seen]))
        for name, fill in (("alone", alone), ("shared", shared))
    }
    assert error["shared"] < 0.1 * error["alone"], error
    assert shared.confidence is not None
    assert np.median(shared.confidence[1][seen]) > CARRIED
    # The first view lies deep in no hole: nothing is carried to it.
    for name in ("rgb", "depth", "confidence"):
        np.testing.assert_array_equal(getattr(shared, name)[0], getattr(alone, name)[0])


def test_memory_stays_as_it_is_and_the_order_of_the_views_does_not_matter(corner):
    known = corner[0]
    fill = surface_fill([], known, shared=True)
    turned = surface_fill([], known.select([1, 0]), shared=True).select([1, 0])
    for name in ("rgb", "depth", "confidence"):
        values = getattr(fill, name)
        np.testing.assert_array_equal(values, getattr(turned, name))
        np.testing.assert_array_equal(values[known.valid], getattr(known, name)[known.valid])


def test_only_memory_is_certain_and_averages_are_the_least_so(corner):
    known = corner[0]
    few = known.select([0, 1])
    # Too few pixels for planes.
    few.valid[1] = False
    few.valid[1, 40, 60:70] = True
    for values in (few.rgb, few.depth, few.confidence):
        values[~few.valid] = 0
    fill = surface_fill([], few)
    assert fill.confidence is not None
    assert (fill.confidence[~few.valid] < 1).all()
    assert (fill.confidence[0][~few.valid[0]] > AVERAGED).any()
    np.testing.assert_array_equal(fill.confidence[1][~few.valid[1]], np.float32(AVERAGED))
