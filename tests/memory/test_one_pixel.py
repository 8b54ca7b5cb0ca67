from __future__ import annotations

import numba
import numpy as np
import pytest
from memory_scenes import camera

from gvtools.errors import OptionError
from gvtools.memory.splat.one_pixel import NearestImage, project_nearest, project_open3d


def _target(seed: int, *, width=160, height=120):
    rng = np.random.default_rng(seed)
    return camera(
        width=width, height=height, focal=130, rotation=rng.normal(0, 0.2, 3),
        center=rng.normal(0, 0.3, 3),
    )  # fmt: skip


def _cloud(seed: int, count: int) -> np.ndarray:
    """Around the camera, before and behind it."""
    rng = np.random.default_rng(seed)
    return rng.uniform((-3, -3, -1), (3, 3, 6), (count, 3)).astype(np.float32)


def _brute(positions, target, depth_max=np.inf):
    """Nearest point of each pixel in float64, one after the other."""
    xy, z = target.project(positions)
    depth = np.zeros((int(target.height[0]), int(target.width[0])))
    index = np.full(depth.shape, -1)
    for i in np.flatnonzero((z[0] > 0) & (z[0] <= depth_max)):
        column, row = np.floor(xy[0, i]).astype(int)
        if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
            continue
        if index[row, column] < 0 or z[0, i] < depth[row, column]:
            depth[row, column], index[row, column] = z[0, i], i
    return depth, index


@pytest.mark.parametrize("seed", range(4))
def test_every_pixel_holds_its_nearest_point(seed):
    cloud, target = _cloud(seed, 20_000), _target(seed)
    image = project_nearest(cloud, target)
    depth, index = _brute(cloud.astype(float), target)
    same = image.index == index
    assert (~same).sum() <= 4  # points whose float32 coordinates round over a pixel's border
    np.testing.assert_allclose(image.depth[same], depth[same], rtol=1e-5)
    assert (index >= 0).mean() > 0.1
    assert image.index.dtype == np.int32
    assert (image.depth[image.index < 0] == 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_open3d_finds_the_same_depth_and_winner(seed):
    """Where the two differ, a point lies on a pixel's border, or depths tie, but for rounding."""
    cloud, target = _cloud(seed, 200_000), _target(seed)
    image = project_nearest(cloud, target)
    number = np.arange(len(cloud))
    tags = np.stack([number // 65536, number % 65536, 0 * number], 1).astype(np.float32)
    depth, found = project_open3d(cloud, tags, target)
    winner = np.where(depth > 0, found[..., 0] * 65536 + found[..., 1], -1).astype(int)
    differ = winner != image.index
    assert (image.index >= 0).mean() > 0.5
    assert differ.sum() <= 1e-3 * differ.size
    np.testing.assert_allclose(image.depth[~differ], depth[~differ], rtol=1e-6)
    xy, z = target.project(cloud.astype(float))
    from_border = abs(xy[0] - np.round(xy[0])).min(axis=1)
    for one, two in zip(winner[differ], image.index[differ], strict=True):
        tie = min(one, two) >= 0 and abs(z[0, one] / z[0, two] - 1) < 1e-6
        assert tie or min(from_border[i] for i in (one, two) if i >= 0) < 1e-3


def test_equal_depths_go_to_the_lower_index():
    cloud = np.repeat(np.array([(0, 0, 2)], np.float32), 5000, axis=0)
    image = project_nearest(cloud, camera())
    assert image.index.max() == 0
    assert (image.index == 0).sum() == 1


def test_the_number_of_threads_changes_nothing():
    cloud, target = _cloud(9, 50_000), _target(9)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = project_nearest(cloud, target)
    finally:
        numba.set_num_threads(threads)
    many = project_nearest(cloud, target)
    np.testing.assert_array_equal(one.index, many.index)
    np.testing.assert_array_equal(one.depth, many.depth)


def test_half_a_pixel_leaves_no_false_holes():
    """Rounding half to even would leave every other pixel of such a grid open."""
    target = camera(width=40, height=30, focal=32.0)
    columns, rows = np.meshgrid(np.arange(40), np.arange(30))
    for shift in (0, 0.5):
        x = (columns + shift - 20) / 32 * 2
        y = (rows + shift - 15) / 32 * 2
        cloud = np.stack([x.ravel(), y.ravel(), np.full(1200, 2)], 1).astype(np.float32)
        image = project_nearest(cloud, target)
        np.testing.assert_array_equal(image.index, np.arange(1200).reshape(30, 40))


@pytest.mark.parametrize("far", [1e6, 5e6])
def test_an_origin_far_away_changes_nothing(far):
    cloud, target = _cloud(3, 5000), _target(3)
    home = project_nearest(cloud, target)
    origin = np.array([far, -far, far / 3])
    pose = target.cam_from_world.copy()
    pose[0, :3, 3] -= pose[0, :3, :3] @ origin
    moved = type(target)(target.K, pose, target.width, target.height, target.names)
    image = project_nearest(cloud, moved, origin=origin)
    same = image.index == home.index
    assert same.mean() > 0.999
    np.testing.assert_allclose(image.depth[same], home.depth[same], atol=1e-5)


def test_what_is_beyond_the_farthest_depth_is_left_out():
    cloud, target = _cloud(5, 20_000), _target(5)
    image = project_nearest(cloud, target, depth_max=2.5)
    _, index = _brute(cloud.astype(float), target, depth_max=2.5)
    assert (image.index != index).sum() <= 4
    assert 0 < image.depth.max() <= 2.5


@pytest.mark.parametrize(
    "where", [np.zeros((0, 3)), np.array([(0, 0, -1.0)]), np.zeros((3, 3)), np.array([(1e9, 0, 1)])]
)
def test_nothing_in_view_gives_an_empty_image(where):
    image = project_nearest(where.astype(np.float32), camera())
    assert isinstance(image, NearestImage)
    assert (image.index == -1).all()
    assert (image.depth == 0).all()


def test_skew_is_honoured_here_and_refused_for_open3d():
    cloud = np.array([(0, 0.5, 2)], np.float32)
    target = camera(skew=8.0)
    image = project_nearest(cloud, target)
    (xy,), _ = target.project(cloud)
    assert image.index[tuple(np.floor(xy[0, ::-1]).astype(int))] == 0
    with pytest.raises(OptionError, match="ignores skew and K has 8 px"):
        project_open3d(cloud, cloud, target)


def test_the_winners_colours_come_along():
    rng = np.random.default_rng(5)
    cloud = rng.uniform((-1, -1, 1), (1, 1, 3), (500, 3)).astype(np.float32)
    colors = rng.integers(1, 255, (500, 3)).astype(np.uint8)
    image = project_nearest(cloud, camera(), colors=colors)
    seen = image.index >= 0
    assert seen.any()
    assert not seen.all()
    assert image.colors is not None
    np.testing.assert_array_equal(image.colors[seen], colors[image.index[seen]])
    assert not image.colors[~seen].any()
