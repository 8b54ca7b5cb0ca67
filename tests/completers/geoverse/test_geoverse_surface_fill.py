from __future__ import annotations

import geoverse_models as micro
import numpy as np
import pytest
from walls import blotches, camera_at, cast, photograph

from gvtools.cameras import concatenate
from gvtools.completers.surface_fill import AVERAGED, CARRIED, surface_fill
from gvtools.guidance import Guidance

pytestmark = pytest.mark.usefixtures("one_thread")
SCALE = 0.5


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
    turned = surface_fill([], known.select([1, 0]), shared=True).rows([1, 0])
    for name in ("rgb", "depth", "confidence"):
        values = getattr(fill, name)
        np.testing.assert_array_equal(values, getattr(turned, name))
        np.testing.assert_array_equal(values[known.valid], getattr(known, name)[known.valid])


def test_every_call_gives_the_same_bits():
    known = micro.guidance(2, size=(30, 40))
    first = surface_fill(micro.context_views(2), known, shared=True)
    for _ in range(40):
        again = surface_fill(micro.context_views(2), known, shared=True)
        for name in ("rgb", "depth", "confidence"):
            assert getattr(again, name).tobytes() == getattr(first, name).tobytes(), name


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
