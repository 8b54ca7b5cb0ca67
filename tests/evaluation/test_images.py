from __future__ import annotations

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from gvtools.errors import ShapeError
from gvtools.evaluation.images import image_figures, psnr, relative_depth_error, ssim, ssim_map

SSIM = {
    "gaussian_weights": True,
    "sigma": 1.5,
    "use_sample_covariance": False,
    "data_range": 1.0,
    "channel_axis": -1,
}


@pytest.fixture
def pair():
    rng = np.random.default_rng(4)
    truth = rng.random((40, 52, 3))
    return np.clip(truth + rng.normal(0, 0.1, truth.shape), 0, 1), truth


def test_psnr_is_skimages(pair):
    assert psnr(*pair) == pytest.approx(peak_signal_noise_ratio(pair[1], pair[0], data_range=1))


def test_psnr_of_a_constant_error_is_its_closed_form():
    truth = np.full((8, 9, 3), 0.5)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0)
    assert psnr(truth, truth) == float("inf")


def test_bytes_stand_for_255ths(pair):
    image, truth = (np.round(array * 255).astype(np.uint8) for array in pair)
    assert psnr(image, truth) == pytest.approx(psnr(image / 255, truth / 255))
    assert ssim(image, truth / 255) == pytest.approx(ssim(image / 255, truth / 255))
    # float32 is compared in float64.
    single = (truth / 255).astype(np.float32)
    assert psnr(image, single) == pytest.approx(psnr(image / 255, single.astype(np.float64)))


def test_ssim_is_skimages_and_a_full_mask_changes_nothing(pair):
    image, truth = pair
    expected = structural_similarity(image, truth, **SSIM)
    assert ssim(image, truth) == pytest.approx(expected, abs=1e-12)
    full = np.ones(truth.shape[:2], bool)
    assert ssim(image, truth, mask=full) == pytest.approx(expected, abs=1e-12)
    assert ssim(truth, truth) == pytest.approx(1.0)


def test_depth_error_is_the_median_over_pixels_with_both():
    truth = np.full((6, 6), 2.0)
    depth = truth * 1.05
    depth[0] = truth[0] * 3
    truth[1], depth[2] = 0, 0
    depth[3, 0], truth[3, 1] = np.nan, np.inf
    assert relative_depth_error(depth, truth) == pytest.approx(0.05)
    first_row = np.zeros((6, 6), bool)
    first_row[0] = True
    assert relative_depth_error(depth, truth, mask=first_row) == pytest.approx(2.0)
    assert relative_depth_error(depth, np.zeros((6, 6))) is None


def test_what_does_not_fit_is_refused():
    image = np.zeros((20, 20, 3))
    with pytest.raises(ShapeError, match="expected equal"):
        psnr(image, image[:-1])
    with pytest.raises(ShapeError, match="int64"):
        psnr(image.astype(np.int64), image)
    with pytest.raises(ShapeError, match="at least 11x11"):
        ssim(image[:10], image[:10])


@pytest.mark.parametrize("sample", [False, True])
def test_the_compiled_map_is_scikit_images(sample):
    rng = np.random.default_rng(5)
    first = rng.random((37, 53, 3))
    second = np.clip(first + 0.2 * rng.standard_normal(first.shape), 0, 1)
    _, expected = structural_similarity(
        first, second, gaussian_weights=True, sigma=1.5, use_sample_covariance=sample,
        data_range=1.0, channel_axis=-1, full=True,
    )  # fmt: skip
    ours = ssim_map(first, second, sample_covariance=sample)
    np.testing.assert_allclose(ours, expected[5:-5, 5:-5].mean(axis=-1), atol=1e-12)


def test_regions_have_the_figures_of_their_masks():
    rng = np.random.default_rng(6)
    first = (rng.random((40, 50, 3)) * 255).astype(np.uint8)
    second = (rng.random((40, 50, 3)) * 255).astype(np.uint8)
    mask = rng.random((40, 50)) > 0.4
    found = image_figures(first, second, {"all": None, "some": mask, "none": mask & ~mask})
    assert found["all"]["psnr"] == pytest.approx(psnr(first, second))
    assert found["all"]["ssim"] == pytest.approx(ssim(first, second))
    assert found["some"]["psnr"] == pytest.approx(psnr(first, second, mask=mask))
    assert found["some"]["ssim"] == pytest.approx(ssim(first, second, mask=mask))
    assert found["none"] == {"psnr": None, "ssim": None}
    small = image_figures(first[:9], second[:9], {"all": None})
    assert small["all"]["ssim"] is None
