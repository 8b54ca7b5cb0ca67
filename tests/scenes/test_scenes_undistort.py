# mypy: no-check-untyped-defs
from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
from scenes_workspace import HEIGHT, LENSES, WIDTH, ramp

from gvtools.errors import ProjectError
from gvtools.scenes.undistort import undistortion

SIZE = (WIDTH, HEIGHT)


@pytest.mark.parametrize("model", sorted(LENSES))
def test_nearest_follows_the_mapping_of_the_picture(model):
    lens = undistortion(model, LENSES[model], SIZE, what="test")
    picture = ramp()
    bilinear = lens.image(picture)
    width, height = lens.size
    assert bilinear.shape == (height, width, 3)
    for channel, steps in ((0, WIDTH), (1, HEIGHT)):
        near = lens.nearest(picture[..., channel])
        # On a ramp, nearest and bilinear differ by half a pixel's step at most, and not on average.
        difference = near.astype(float) - bilinear[..., channel]
        assert np.abs(difference).max() <= 0.5 * 255 / steps + 1
        assert abs(difference.mean()) < 0.25


def test_points_are_those_of_the_simple_radial_closed_form():
    f, cx, cy, k = 90, 48, 36, -0.15
    lens = undistortion("SIMPLE_RADIAL", [f, cx, cy, k], SIZE, what="test")
    ray = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    recorded = ray * (1 + k * (ray**2).sum(axis=1, keepdims=True)) * f + (cx, cy)
    expected = ray * f + lens.K[:2, 2]
    np.testing.assert_allclose(lens.points(recorded), expected, atol=1e-3)


def test_points_outside_the_picture_are_kept_and_impossible_ones_are_nan():
    lens = undistortion("SIMPLE_RADIAL", LENSES["SIMPLE_RADIAL"], SIZE, what="test")
    kept = lens.points([[-3, 30], [WIDTH + 4, HEIGHT + 2]])
    assert np.isfinite(kept).all()
    # With k < 0 no ray reaches farther than f * 2 / 3 * sqrt(1 / (3 |k|)) from the centre.
    assert np.isnan(lens.points([[48 + 95, 36]])).all()
    assert lens.points(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    ("model", "params", "size", "told"),
    [
        ("EQUIRECTANGULAR", [200, 100], (200, 100), "EQUIRECTANGULAR is spherical"),
        ("PINHOLES", [1], SIZE, "unknown camera model 'PINHOLES'"),
        ("INVALID", [], SIZE, "unknown camera model"),
        ("PINHOLE", [90, 90, 48], SIZE, "has 3 parameters"),
        ("PINHOLE", [90, np.nan, 48, 36], SIZE, "NaN"),
        ("PINHOLE", [90, -90, 48, 36], SIZE, "not positive"),
        ("PINHOLE", [90, 90, 48, 36], (0, 10), "impossible size"),
        ("PINHOLE", [90, 90, 48, 36], (2**40, 10), "impossible size"),
    ],
)
def test_impossible_cameras(model, params, size, told):
    with pytest.raises(ProjectError, match=told) as error:
        undistortion(model, params, size, what="camera 7")
    assert str(error.value).startswith("camera 7: ")
    assert "\n" not in str(error.value)


def test_colours_are_those_of_pycolmap():
    lens = undistortion("OPENCV", (80, 80, 48, 32, -0.2, 0.05, 0.01, 0.0), (96, 64), what="test")
    noise = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    picture = cv2.GaussianBlur(noise, (0, 0), 1.0)
    options = pycolmap.UndistortCameraOptions()
    bitmap, _ = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(picture), lens.source)
    apart = np.abs(lens.image(picture).astype(int) - bitmap.to_array())[lens._source_pixel >= 0]
    assert np.quantile(apart, 0.99) <= 1
