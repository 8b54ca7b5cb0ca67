from __future__ import annotations

import cv2
import numpy as np
import pytest

from gvtools.evaluation.picture_readings import better_reading
from gvtools.scenes.scene import Frame

RNG = np.random.default_rng(0)


def smooth() -> np.ndarray:
    rgb = RNG.integers(0, 256, (12, 16, 3), np.uint8)
    return np.asarray(cv2.resize(rgb, (160, 120), interpolation=cv2.INTER_CUBIC), np.uint8)


TRUTHS = [smooth() for _ in range(3)]


def noisy(rgb: np.ndarray) -> np.ndarray:
    return (rgb + np.random.default_rng(1).normal(0, 3, rgb.shape)).clip(0, 255).astype(np.uint8)


def linear(rgb: np.ndarray) -> np.ndarray:
    share = rgb / 255
    return np.where(share < 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4) * 255


def enlarged(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.resize(rgb[6:-6, 8:-8], (160, 120), interpolation=cv2.INTER_CUBIC))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rgb: rgb, ""),
        (lambda rgb: rgb[:, ::-1], "mirrored"),
        (lambda rgb: rgb[::-1], "upside down"),
        (lambda rgb: rgb[::-1, ::-1], "turned by 180"),
        (lambda rgb: rgb[..., ::-1], "red and blue"),
        (lambda rgb: 255 - rgb, "negatives"),
        (lambda rgb: rgb[..., :1].repeat(3, 2), "grey, where"),
        (linear, "linear light"),
        (lambda rgb: 16 + rgb * (219 / 255), "another brightness"),
        (lambda rgb: np.roll(rgb, (2, 3), (0, 1)), "shifted (3"),
        (enlarged, "1.11 times as large"),
        (lambda rgb: 0 * rgb, "one colour"),
        (lambda rgb: RNG.integers(0, 9, rgb.shape), ""),
    ],
)
def test_pictures_that_would_fit_if_they_were_read_otherwise(change, said):
    pictures = [change(noisy(rgb)).astype(np.uint8) for rgb in TRUTHS]
    found = better_reading(pictures, [Frame(rgb) for rgb in TRUTHS])
    assert said in found and bool(found) == bool(said)


def test_pictures_of_other_views_and_masked_ones_tell_nothing():
    pictures = [noisy(rgb) for rgb in TRUTHS]
    assert better_reading(pictures[1:] + pictures[:1], [Frame(rgb) for rgb in TRUTHS]) == ""
    nothing = np.zeros((120, 160), bool)
    assert better_reading(pictures, [Frame(rgb, mask=nothing) for rgb in TRUTHS]) == ""
