from __future__ import annotations

import numpy as np
import pytest
from skimage.restoration import inpaint_biharmonic

from gvtools.completers.hole_depth import fill_depth

HEIGHT, WIDTH, FOCAL = 120, 160, 150.0


def _grid() -> np.ndarray:
    return np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)


def _fill(inverse: np.ndarray, valid: np.ndarray, **options):
    depth = np.where(valid, 1 / inverse, 0).astype(np.float32)
    return fill_depth(depth, valid, focal=FOCAL, **options)


def _holes(*windows) -> np.ndarray:
    valid = np.ones((HEIGHT, WIDTH), bool)
    for window in windows:
        valid[window] = False
    return valid


def _square_before_wall():
    """Inverse depth of a near square before a slanted wall, and a hole at the square's right."""
    y, x = _grid()
    wall = 0.25 + 0.0004 * x + 0.0002 * y
    seen = wall.copy()
    square = np.s_[35:85, 40:80]
    seen[square] = 0.6
    return wall, seen, _holes(np.s_[35:85, 80:105])


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.0008, -0.0005), (-0.0006, 0.0009)])
@pytest.mark.parametrize(
    "window", [np.s_[40:80, 50:110], np.s_[:, 130:], np.s_[90:, :40], np.s_[:15, :]]
)
def test_a_plane_is_continued_exactly(slope, window):
    y, x = _grid()
    plane = 0.4 + slope[0] * x + slope[1] * y
    result = _fill(plane, _holes(window))
    np.testing.assert_allclose(result.inverse, plane, rtol=2e-6)


def test_what_a_near_square_hid_is_the_wall():
    wall, seen, valid = _square_before_wall()
    result = _fill(seen, valid)
    np.testing.assert_allclose(result.inverse[~valid], wall[~valid], rtol=2e-6)
    naive = inpaint_biharmonic(np.where(valid, seen, 0), ~valid)
    naive_error = np.abs(naive / wall - 1)[~valid].mean()
    assert np.abs(result.inverse / wall - 1)[~valid].mean() < 1e-3 * naive_error


def test_a_hole_around_a_corner_of_the_square_is_the_wall():
    wall, seen, valid = _square_before_wall()
    valid[30:45, 40:105] = False
    result = _fill(seen, valid)
    np.testing.assert_allclose(result.inverse[~valid], wall[~valid], rtol=2e-6)


def test_what_stands_in_front_does_not_grow_into_a_hole_that_leaves_the_picture():
    """The wall ends at the left, the square stands free in the hole: nothing faces its rim.

    Beyond the square, where it is all that can be seen, it still goes on.
    """
    wall, seen, valid = _square_before_wall()
    valid[:, 30:] = False
    valid[35:85, 40:80] = True
    result = _fill(seen, valid)
    beside = ~valid & (result.distance > 8)
    beside[:, 75:] = False
    assert np.median(np.abs(result.inverse / wall - 1)[beside]) < 0.02
    assert (np.abs(result.inverse / 0.6 - 1) < 0.1)[beside].mean() < 0.02


def test_what_the_pictures_edge_cut_off_goes_on_a_little():
    """Square and wall end at one straight line, as at the edge of a photograph."""
    _, seen, valid = _square_before_wall()
    valid[:, 70:] = False
    result = _fill(seen, valid)
    middle = result.inverse[57:63, 70:72]
    np.testing.assert_allclose(middle, 0.6, rtol=0.02)


def test_a_hole_inside_the_square_is_the_square():
    _, seen, _ = _square_before_wall()
    valid = _holes(np.s_[50:70, 52:68])
    np.testing.assert_allclose(_fill(seen, valid).inverse[~valid], 0.6, rtol=2e-6)


def test_a_room_corner_hidden_by_a_hole_is_found_again():
    # Seen from inside a room, the nearest plane is the surface: the largest inverse depth.
    x = _grid()[1]
    room = np.maximum(0.30 + 0.0015 * (x - 80), 0.30 - 0.0015 * (x - 80))
    valid = _holes(np.s_[30:90, 50:110])
    result = _fill(room, valid)
    error = np.abs(result.inverse / room - 1)[~valid]
    assert np.quantile(error, 0.9) < 0.01
    # Smooth interpolation from all the rim rounds the corner off.
    naive = inpaint_biharmonic(np.where(valid, room, 0), ~valid)
    assert error.mean() < 0.4 * np.abs(naive / room - 1)[~valid].mean()


def test_noise_does_not_tilt_planes():
    y, x = _grid()
    plane = 0.4 + 0.0005 * x - 0.0004 * y
    rng = np.random.default_rng(1)
    noisy = plane * (1 + 0.005 * rng.standard_normal(plane.shape))
    valid = _holes(np.s_[40:80, 50:110], np.s_[:, 140:])
    result = _fill(noisy, valid)
    error = np.abs(result.inverse / plane - 1)[~valid]
    assert np.median(error) < 0.004
    assert error.max() < 0.03


def test_nothing_known_stays_unknown_and_everything_known_stays_as_it_is():
    plane = 0.4 + 0.0005 * _grid()[1]
    empty = _fill(plane, np.zeros((HEIGHT, WIDTH), bool))
    assert not empty.inverse.any() and (empty.hits == -1).all()
    full = _fill(plane, np.ones((HEIGHT, WIDTH), bool))
    np.testing.assert_allclose(full.inverse, plane, rtol=1e-6)


def test_hits_are_the_first_known_pixels_of_a_plain_march():
    from gvtools.completers.hole_depth import DIRECTIONS, _first_hits

    rng = np.random.default_rng(2)
    known = rng.random((20, 26)) < 0.15
    hits = np.full((16, 20, 26), -1, np.int32)
    _first_hits(0, 16, known, DIRECTIONS, hits)
    for k, (dy, dx) in enumerate(DIRECTIONS):
        if abs(dy) + abs(dx) == 3:
            continue
        for y in range(20):
            for x in range(26):
                v, u = y + dy, x + dx
                while 0 <= v < 20 and 0 <= u < 26 and not known[v, u]:
                    v, u = v + dy, u + dx
                inside = 0 <= v < 20 and 0 <= u < 26
                expected = v * 26 + u if inside and not known[y, x] else -1
                assert hits[k, y, x] == expected


def test_a_thin_rim_stops_every_direction():
    # One pixel thin, yet no knight's move may leap over it to the surface behind.
    inverse = np.full((HEIGHT, WIDTH), 0.5)
    valid = np.zeros((HEIGHT, WIDTH), bool)
    valid[:, 60] = valid[:, 100:] = True
    result = _fill(inverse, valid)
    columns = np.where(result.hits >= 0, result.hits % WIDTH, -1)[:, :, :60]
    assert set(np.unique(columns)) <= {-1, 60}


def test_the_fill_stays_within_limits():
    y = _grid()[0]
    floor = 0.002 * (y - 20.0) + 1e-4
    valid = y >= 60
    result = _fill(np.where(valid, floor, 1.0), valid)
    known = result.inverse[valid]
    assert result.inverse.min() == pytest.approx(0.5 * np.percentile(known, 1))


def test_an_observed_rim_outweighs_a_generated_one():
    """A hole with one wall on its left and right, and a nearer one above and below it."""
    window = np.s_[45:75, 65:95]
    inverse = np.full((HEIGHT, WIDTH), 0.3)
    inverse[45:75] = 0.25
    nearer, valid = inverse == 0.3, _holes(window)
    plain, left, above = (
        _fill(inverse, valid, generated=generated).inverse[window].mean()
        for generated in (None, nearer, ~nearer)
    )
    assert left < 0.98 * plain < 1.02 * plain < above
