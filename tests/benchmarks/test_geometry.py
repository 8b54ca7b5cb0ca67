from __future__ import annotations

import numpy as np
import pytest

from benchmarks.geometry import f1, kept_errors


def test_the_least_confident_pixels_are_dropped():
    error = np.array([0.01, 0.02, 0.03, 0.5, 0.9])
    confidence = np.array([0.9, 0.8, 0.7, 0.6, 0.1])
    assert kept_errors(error, confidence, 1.0) == pytest.approx([0.03, 0.4])
    assert kept_errors(error, confidence, 0.8) == pytest.approx([0.025, 0.25])
    assert kept_errors(error, confidence, 0.6) == pytest.approx([0.02, 0.0])
    # The other way round the good ones are dropped.
    assert kept_errors(error, -confidence, 0.4) == pytest.approx([0.7, 1.0])


def test_pixels_of_equal_confidence_are_dropped_without_regard_to_their_place():
    error = np.repeat([0.0, 1.0], 5_000)
    wrong = kept_errors(error, np.ones(10_000), 0.5)[1]
    assert wrong == pytest.approx(0.5, abs=0.03)


def test_f1_counts_points_off_the_surface_and_surface_without_points():
    x = np.arange(100.0)
    true = np.stack([x, 0 * x, 0 * x], axis=1)
    off = np.array([[0, 0, 0.2], [0, 0, 5.0]])
    found = np.vstack([true[:50] + off[0], true[:50] + off[1]])
    figures = f1(found, true, true, (0.1, 0.5, 6.0))
    assert figures[0] == [0.0, 0.0, 0.0]
    assert figures[1] == pytest.approx([0.5, 0.5, 0.5])
    assert figures[2] == pytest.approx([1.0, 0.55, 1.1 / 1.55])
    assert f1(np.zeros((0, 3)), true, true, (0.5, 1.0)) == [[0.0, 0.0, 0.0]] * 2


def test_far_surfaces_need_not_be_found_but_points_on_them_are_right():
    near, far = np.zeros((10, 3)), np.full((30, 3), 100.0)
    true = np.vstack([near, far])
    assert f1(near, true, near, (0.5,)) == [pytest.approx([1.0, 1.0, 1.0])]
    assert f1(far, true, near, (0.5,)) == [[1.0, 0.0, 0.0]]
