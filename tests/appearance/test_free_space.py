"""Free space before known surfaces, and fits and pictures without Gaussians in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splat_scene import HEIGHT, WIDTH, K, photographs, pose, rough_gaussians, walk

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.fit import Fit
from gvtools.appearance.fit_options import FitOptions
from gvtools.appearance.free_space import SHARE, UNKNOWN_SHARE, floaters, free_depth
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import LOG_SCALE, LOGIT, VALUES
from gvtools.appearance.splat.splat import Lens
from gvtools.cameras import Cameras


def lens_at(cam_from_world, near=0.01):
    return Lens.of(cam_from_world, K, size=(WIDTH, HEIGHT), near=near)


def free_of(surface, lens):
    free = free_depth(surface, lens)
    assert free is not None
    return free


def point(x, y, z):
    """(3,) seen at a place in the picture [px] of a camera at the origin."""
    return np.array([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z])


def test_free_space_ends_before_the_nearest_of_the_surfaces_in_a_part_of_the_picture():
    spots = ((0.25 * WIDTH, 2.0), (0.25 * WIDTH, 3.0), (0.75 * WIDTH, 5.0))
    surface = np.array([point(x, HEIGHT / 2, z) for x, z in spots], np.float32)
    free = free_of(surface, lens_at(np.eye(4)))
    rows, columns = free.shape
    assert free[rows // 2, columns // 4] == pytest.approx(SHARE * 2)
    assert free[rows // 2, 3 * columns // 4] == pytest.approx(SHARE * 5)
    # No surface is known in the corners.
    assert free[0, 0] == pytest.approx(UNKNOWN_SHARE * 2)
    assert free[0, -1] == pytest.approx(UNKNOWN_SHARE * 5)


def test_without_a_surface_in_the_picture_nothing_is_free():
    assert free_depth(np.array([[0, 0, -2.0]], np.float32), lens_at(np.eye(4))) is None
    assert free_depth(np.zeros((0, 3), np.float32), lens_at(np.eye(4))) is None


def test_floaters_are_before_the_surface_and_not_behind_the_camera_or_it():
    surface = np.array([point(WIDTH / 2, HEIGHT / 2, 2.0)], np.float32)
    lens = lens_at(np.eye(4))
    values = np.zeros((4, VALUES), np.float32)
    # Before it, on it, behind the camera, and beside the picture, where its border holds.
    values[:, :LOG_SCALE] = [
        point(WIDTH / 2, HEIGHT / 2, 1.0), point(WIDTH / 2, HEIGHT / 2, 1.9),
        [0, 0, -1], point(2 * WIDTH, HEIGHT / 2, 0.5),
    ]  # fmt: skip
    found = floaters(values, lens, free_of(surface, lens))
    assert found.tolist() == [True, False, False, True]
    rows = np.array([3, 1])
    assert floaters(values, lens, free_of(surface, lens), rows=rows).tolist() == [True, False]


def fog(count=40):
    """Opaque Gaussians just before the cameras of the walk."""
    rng = np.random.default_rng(0)
    eye = -pose(0.0)[:3, :3].T @ pose(0.0)[:3, 3]
    ahead = pose(0.0)[2, :3]
    places = eye + 0.3 * ahead + rng.normal(0, 0.05, (count, 3))
    out = Gaussians.at(places, np.full((count, 3), 90), sizes=np.full(count, 0.05))
    out.values[:, LOGIT] = 2.0
    return out


def test_a_fit_clears_free_space_and_a_picture_does_not_show_it():
    start = rough_gaussians()
    surface = start.values[:, :LOG_SCALE].copy()
    both = Gaussians(np.concatenate([start.values, fog().values]), frame=start.frame)
    kept = {}
    for name, known in (("all", None), ("free", surface)):
        fit = Fit(both, photographs(walk(5)), options=FitOptions(steps=40), surface=known)
        fit.run()
        lens = lens_at(pose(0.0))
        found = fit.gaussians.values
        floating = floaters(found, lens, free_of(surface, lens))
        kept[name] = (1 / (1 + np.exp(-found[floating, LOGIT]))).sum()
    assert kept["free"] < 0.1 * kept["all"]
    camera = Cameras(K[None], pose(0.0)[None], np.array([WIDTH]), np.array([HEIGHT]), ("a",))
    shown = Appearance(both, 0.01, surface=surface)
    truth = Appearance(start, 0.01).picture(camera)
    assert np.abs(shown.picture(camera).rgb - truth.rgb).max() < 0.02
    clouded = replace(shown, surface=None)
    assert np.abs(clouded.picture(camera).rgb - shown.picture(camera).rgb).mean() > 0.05
    depths = [one.depth(camera) for one in (clouded, shown)]
    near = [int(((depth > 0) & (depth < 1)).sum()) for depth in depths]
    assert near[0] > 100 and near[1] == 0


def test_surfaces_come_back_from_the_file(tmp_path):
    surface = np.array([[1, 2, 3]], np.float32)
    appearance = Appearance(fog(), 0.1, surface=surface)
    with (tmp_path / "a.npz").open("wb") as file:
        np.savez(file, **appearance.arrays())
    np.testing.assert_array_equal(Appearance.load(tmp_path / "a.npz").surface, surface)
    without = {name: array for name, array in appearance.arrays().items() if name != "surface"}
    with (tmp_path / "b.npz").open("wb") as file:
        np.savez(file, **without)
    assert Appearance.load(tmp_path / "b.npz").surface is None
