from __future__ import annotations

import io
from typing import Any

import matplotlib
import numpy as np
import pytest
from growth_rounds import rounds
from PIL import Image

from gvtools.errors import OptionError
from viz.plots.rounds import draw_growth, growth_text


def heights(axes, label):
    container = next(c for c in axes.containers if c.get_label() == label)
    return [patch.get_height() for patch in container]


def points(dots) -> np.ndarray:
    return np.asarray(dots.get_offsets())


def test_the_bars_are_the_figures():
    panels: list[Any] = draw_growth(rounds(), title="room").axes
    stored, fates, coverage, times = panels
    assert [axes.get_ylabel() for axes in panels] == [
        "observations, voxels", "points, voxels (logarithmic)", "coverage, % of pixels", "seconds",
    ]  # fmt: skip
    assert heights(stored, "observed") == [1000, 1000, 1000]
    assert heights(stored, "generated") == [0, 200, 400]
    assert list(stored.lines[0].get_ydata()) == [600, 750, 900]
    assert heights(fates, "added") == [1000, 200, 200]
    assert heights(fates, "merged") == [300, 40, 40]
    assert heights(fates, "rejected") == [0, 25, 25]
    assert heights(fates, "new voxels") == [600, 150, 150]
    before, after = (points(dots) for dots in coverage.collections[1:])
    np.testing.assert_allclose(before, [[1, 60], [2, 70]])
    np.testing.assert_allclose(after, [[1, 80], [2, 90]])
    assert sum(bar.get_height() for bar in times.patches) == pytest.approx(3 * 1.8)


def test_a_picture_without_pyplot_state():
    import matplotlib.pyplot as plt

    before = plt.get_fignums(), matplotlib.get_backend()
    buffer = io.BytesIO()
    draw_growth(rounds(), title="room").savefig(buffer, format="png", dpi=50)
    assert (plt.get_fignums(), matplotlib.get_backend()) == before
    assert np.asarray(Image.open(buffer).convert("L")).std() > 20


def test_one_round_without_anything_and_many_still_draw():
    draw_growth(rounds(40), title="room").savefig(io.BytesIO(), format="png", dpi=40)
    empty = rounds(1)
    for key in ("voxels", "added", "merged", "observed", "generated"):
        empty[0][key] = 0
    empty[0]["seconds"] = {}
    draw_growth(empty, title="room").savefig(io.BytesIO(), format="png", dpi=40)
    assert "0 added" in growth_text(empty)


def test_the_text_fits_and_tells_the_same():
    text = growth_text(rounds())
    lines = text.splitlines()
    assert max(map(len, lines)) <= 72
    bars = lines[1:4]
    assert [bar.count("+") > 0 for bar in bars] == [False, True, True]
    observed = [bar.count("#") for bar in bars]
    assert max(observed) - min(observed) <= 1
    assert bars[2].count("+") / bars[2].count("#") == pytest.approx(0.4, abs=0.05)
    assert "60.0% -> 80.0%" in bars[1]
    assert "200 added, 40 merged, 25 rejected, 150 new voxels" in lines[5]


def test_nothing_to_draw_is_refused():
    for call in (lambda: draw_growth([], title="x"), lambda: growth_text([])):
        with pytest.raises(OptionError, match="no rounds"):
            call()
