from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from oracle import ABSENT, ORACLE, arrays, expected_values

from gvtools.evaluation.images import image_figures, psnr, ssim

IMAGE_KEYS = ("psnr", "gld_psnr", "ssim_wang")
CASES = [case for case in expected_values(ORACLE) if any(key in case[2] for key in IMAGE_KEYS)]
pytestmark = [pytest.mark.data, pytest.mark.skipif(not CASES, reason=ABSENT)]
FLOAT64 = 1e-6
FLOAT32 = 1e-4


def pair_of(path: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Reference and test image, (H, W, C)."""
    for stored in arrays(path):
        if f"{name}.a" in stored:
            break
    else:
        raise AssertionError(f"{path}: no arrays of {name}")
    return tuple(as_hwc(stored[f"{name}.{side}"]) for side in "ab")  # type: ignore[return-value]


def as_hwc(image: np.ndarray) -> np.ndarray:
    if image.ndim == 2:
        return image[..., None]
    return image if image.dtype == np.uint8 else np.moveaxis(image, 0, -1)


def close(ours: float | None, theirs: float | str, *, tolerance: float) -> None:
    assert ours == pytest.approx(float(theirs), rel=tolerance, abs=tolerance)


@pytest.mark.parametrize(("path", "name", "case"), CASES, ids=[name for _, name, _ in CASES])
def test_image_figures_are_the_references(path, name, case):
    first, second = pair_of(path, name)
    if "psnr" in case:
        close(psnr(second, first), case["psnr"], tolerance=FLOAT64)
        close(image_figures(second, first, {"all": None})["all"]["psnr"], case["psnr"],
              tolerance=FLOAT64)  # fmt: skip
    for key, sample in (("ssim_wang", False), ("ssim_wang_uint8_range255", False),
                        ("ssim_sample_covariance", True)):  # fmt: skip
        if key in case:
            close(ssim(second, first, sample_covariance=sample), case[key], tolerance=FLOAT64)
    if "gld_psnr" in case:
        clipped = [np.clip(image / 255 if image.dtype == np.uint8 else image, 0, 1)
                   for image in (second, first)]  # fmt: skip
        close(psnr(*clipped), case["gld_psnr"], tolerance=FLOAT32)
    if "gld_ssim" in case:
        close(ssim(second, first, sample_covariance=True), case["gld_ssim"], tolerance=FLOAT32)
