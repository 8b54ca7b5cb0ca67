"""Contact sheets of several methods: what is where, and what is outlined."""

from __future__ import annotations

import numpy as np
import pytest

from gvtools.errors import ShapeError
from viz.plots.canvas import SKY
from viz.report.pictures import GAP, LETTERS, MISSING, JudgedView, method_sheet

COLOR = [int(SKY[i : i + 2], 16) for i in (1, 3, 5)]
WIDTH, HEIGHT = 64, 48


def view(**changes) -> JudgedView:
    truth = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    never = np.zeros((HEIGHT, WIDTH), bool)
    never[10:30, 20:40] = True
    pictures = {"exact": truth, "bright": np.full_like(truth, 250), "absent": None}
    fields = {"truth": truth, "mask": None, "never_observed": never, "pictures": pictures}
    return JudgedView(name="view", **{**fields, **changes})


def tiles(canvas: np.ndarray, line: int) -> list[np.ndarray]:
    """The tiles of a line of the sheet: truth and three methods."""
    top = LETTERS + GAP + line * (HEIGHT + GAP)
    lefts = [GAP + column * (WIDTH + GAP) for column in range(4)]
    return [canvas[top : top + HEIGHT, left : left + WIDTH] for left in lefts]


def test_a_view_has_truth_pictures_and_error_maps_below_its_methods():
    canvas = method_sheet([view()])
    truth, exact, bright, absent = tiles(canvas, 0)
    assert (exact == 100).all()
    assert (bright == 250).all()
    assert (absent == MISSING).all()
    assert (truth == 100).all()
    dimmed, exact_error, bright_error, absent_error = tiles(canvas, 1)
    assert (dimmed[10:30, 20:40] == 100).all()
    assert dimmed.astype(int).sum() == 3 * (100 * 400 + 20 * (WIDTH * HEIGHT - 400))
    rim = (exact_error == COLOR).all(axis=2)
    assert rim[10:12, 20:40].all()
    assert rim[10:30, 38:40].all()
    assert rim.sum() == 20 * 20 - 16 * 16
    inside = exact_error[13:27, 23:37]
    assert (inside == inside[0, 0]).all()
    assert inside.max() < 10
    # Off by more than the brightest difference.
    assert bright_error[0, 0].sum() > 600
    assert (bright_error == COLOR).all(axis=2).sum() == rim.sum()
    assert (absent_error == MISSING).all()


def test_without_truth_there_are_no_error_maps():
    with_truth, without = (method_sheet([one]) for one in (view(), view(truth=None)))
    assert with_truth.shape[0] - without.shape[0] == HEIGHT + GAP


def test_views_stand_below_each_other():
    one, two = method_sheet([view()]), method_sheet([view(), view()])
    assert two.shape[1] == one.shape[1]
    assert one.shape[0] < two.shape[0] < 2 * one.shape[0]


def test_no_view_is_refused():
    with pytest.raises(ShapeError, match="no views"):
        method_sheet([])
