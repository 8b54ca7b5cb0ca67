from __future__ import annotations

import numpy as np
import pytest
from scan_files import FAR, surface
from scipy.spatial.transform import Rotation

from gvtools.errors import DegenerateError, OptionError
from gvtools.scans import registration
from gvtools.scans.registration import Surface, given_placement, register

SEEN_FROM = np.array([2.0, 2.0, 1.5])


def similarity(scale=0.4):
    """World from scan: turned, scaled, from far coordinates."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_euler("zyx", [2.1, 0.4, -1.2]).as_matrix()
    matrix[:3, 3] = [1, 2, 3] - matrix[:3, :3] @ FAR
    return matrix


def seen(positions):
    return Surface(positions, np.broadcast_to(SEEN_FROM, positions.shape))


@pytest.mark.parametrize("stations", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_scan_in_another_frame_and_unit_is_placed_by_its_shape(stations):
    truth = similarity()
    photographed = surface(20_000, seed=1)[0]
    # The photographs saw two thirds of it.
    photographed = photographed[photographed[:, 0] + photographed[:, 1] < 4.2]
    scanned = surface(40_000, seed=2)[0]
    inverse = np.linalg.inv(truth)
    to_scan = lambda points: points @ inverse[:3, :3].T + inverse[:3, 3]  # noqa: E731
    viewpoints = np.broadcast_to(to_scan(SEEN_FROM[None]), scanned.shape) if stations else None
    found = register(
        Surface(to_scan(scanned), viewpoints), seen(photographed), least=0.5, metric=False
    )
    assert found.how == "estimated" and found.fitness is not None and found.fitness > 0.7
    assert found.scale == pytest.approx(0.4, rel=0.01)
    np.testing.assert_allclose(found.apply(to_scan(scanned)), scanned, atol=0.03)


def test_a_scan_that_fits_as_it_is_stays_where_it_is():
    one, two = surface(20_000, seed=1)[0] + FAR, surface(20_000, seed=2)[0] + FAR
    found = register(Surface(one), Surface(two, two * 0 + FAR + SEEN_FROM), least=0.5, metric=True)
    assert found.how == "as it is"
    np.testing.assert_array_equal(found.world_from_scan, np.eye(4))


@pytest.mark.slow
def test_another_place_is_refused():
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, 6.3, (2, 20_000))
    ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], 1)
    ball += 0.3 * np.sin(5 * u)[:, None] * ball
    with pytest.raises(DegenerateError, match="no placement of the scan is supported"):
        register(Surface(ball), seen(surface(20_000)[0]), least=0.5, metric=False)
    with pytest.raises(DegenerateError, match="20 points of the scan"):
        register(Surface(ball[:20]), seen(surface(20_000)[0]), least=0.5, metric=False)


def test_a_given_similarity_is_read_from_numbers_and_files(tmp_path):
    truth = similarity()
    path = tmp_path / "world_from_scan.txt"
    np.savetxt(path, truth, fmt="%.17g")
    numbers = ",".join(map(repr, truth[:3].ravel().tolist()))
    for text in (str(path), numbers):
        placement = given_placement(text)
        assert placement is not None
        np.testing.assert_allclose(placement.world_from_scan, truth, rtol=1e-15)
        # Far coordinates keep their digits.
        np.testing.assert_allclose(placement.apply(FAR[None] + 1e-6)[0] - [1, 2, 3], 0, atol=1e-6)
    assert given_placement("estimate") is None
    identity = given_placement("identity")
    assert identity is not None and identity.scale == 1


@pytest.mark.parametrize(
    "text",
    ["1,2,3", "there.txt", "1,0,0,0,0,1,0,0,0,0,nan,0", "2,0,0,0,0,1,0,0,0,0,1,0",
     "-1,0,0,0,0,1,0,0,0,0,1,0", "1,0,0,0,0,1,0,0,0,0,1,0,0,0,1,1"],
)  # fmt: skip
def test_what_is_no_similarity_is_refused(text):
    with pytest.raises(OptionError, match=r"scan\.placement"):
        given_placement(text)


@pytest.mark.parametrize("count", [2000, 60_000])
def test_noise_is_refused_before_it_is_searched(count, monkeypatch):
    monkeypatch.setattr(registration._Task, "candidates", None)
    noise = np.random.default_rng(1).uniform(-1, 1, (count, 3)) + FAR
    with pytest.raises(DegenerateError, match=r"lie on no surface .* give its placement"):
        register(Surface(noise), seen(surface(20_000)[0]), least=0.5, metric=True)


def test_a_scan_in_millimetres_with_z_up_around_what_was_photographed():
    scanned, photographed = surface(60_000, seed=2)[0], surface(40_000, seed=1)[0]
    # The photographs saw a corner, a quarter of the floor.
    photographed = photographed[(photographed[:, 0] < 2) & (photographed[:, 1] < 1.6)]
    truth = np.eye(4)
    truth[:3, :3] = 0.001 * np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    inverse = np.linalg.inv(truth)
    found = register(
        Surface(scanned @ inverse[:3, :3].T), seen(photographed), least=0.5, metric=True
    )
    assert found.scale == pytest.approx(0.001, rel=0.01)
    there = found.apply(photographed @ inverse[:3, :3].T)
    assert np.linalg.norm(there - photographed, axis=1).max() < 0.03
