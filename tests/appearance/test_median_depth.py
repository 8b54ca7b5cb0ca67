"""Depth of the surfaces that Gaussians show."""

import numpy as np
import pytest

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import LOGIT
from gvtools.appearance.splat.splat import Lens, Splat, median_depth
from gvtools.cameras import Cameras

SIZE = 45, 37
K = np.array([[40.0, 0, 22.0], [0, 40.0, 19.0], [0, 0, 1]])
LENS = Lens.of(np.eye(4), K, size=SIZE, near=0.05)
CAMERA = Cameras(K[None], np.eye(4)[None], np.array([45]), np.array([37]), ("one",))


def sheets(*depths_and_alphas):
    """Gaussians before the camera, each as wide as the picture."""
    depths, alphas = np.array(depths_and_alphas).T
    centers = np.stack([np.zeros_like(depths), np.zeros_like(depths), depths], axis=1)
    sheet = Gaussians.at(centers, np.full((len(depths), 3), 90), sizes=100 * depths)
    sheet.values[:, LOGIT] = np.log(alphas / (1 - alphas))
    return sheet


def test_each_pixel_has_the_gaussian_at_which_half_of_the_light_is_stopped():
    rng = np.random.default_rng(3)
    centers = np.stack([*rng.uniform(-1, 1, (2, 60)), rng.uniform(1, 3, 60)], axis=1)
    cloud = Gaussians.at(centers, np.full((60, 3), 90), sizes=rng.uniform(0.05, 0.15, 60))
    cloud.values[:, LOGIT] = rng.uniform(-1, 3, 60)
    found = median_depth(cloud.values, LENS)
    assert 0.3 < (found > 0).mean() < 0.99
    depths = np.unique(found[found > 0])
    assert len(depths) > 10
    place = centers[:, 2].astype(np.float32)
    for depth in depths:
        here = found == depth
        before = Splat(cloud.values[place < depth - 1e-5], LENS).image[4]
        with_it = Splat(cloud.values[place < depth + 1e-5], LENS).image[4]
        assert before[here].max() < 0.501 and with_it[here].min() > 0.499
    np.testing.assert_array_equal(found == 0, Splat(cloud.values, LENS).image[4] <= 0.5)


def test_fog_before_a_surface_does_not_count():
    values = sheets((1.0, 0.3), (3.0, 0.9)).values
    np.testing.assert_allclose(median_depth(values, LENS), 3.0, rtol=1e-5)
    _, _, _, weighted, alpha = Splat(values, LENS).image
    assert (weighted / alpha).max() < 2.4


def test_what_is_too_faint_has_no_depth():
    assert not median_depth(sheets((1.0, 0.2), (3.0, 0.3)).values, LENS).any()


@pytest.mark.parametrize(
    ("depths", "expected"), [((2.0, 8.0), 2.0), ((5.0, 2.0, 3.0), 3.0), ((None, 4.0), 4.0)]
)
def test_several_fits_have_the_median_of_those_that_show_a_surface(depths, expected):
    first, *others = (sheets((depth or 1.0, 0.9 if depth else 0.1)) for depth in depths)
    found = Appearance(first, 0.05, others=tuple(others)).depth(CAMERA)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5)
