from __future__ import annotations

import json

import numpy as np
import pytest
from memory_scenes import camera, points
from scan_files import FAR, surface
from scipy.spatial.transform import Rotation

from gvtools.cameras import rigid_poses
from gvtools.errors import DegenerateError, OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.scans import registration
from gvtools.scans.fuse import fuse_scan, point_spacing
from gvtools.scans.points import Scan, Station
from gvtools.scans.registration import Placement, Surface, given_placement, register


def wall(step: float, *, z: float = 2.0, width: float = 2.0):
    """Points (N, 3) of a wall before the camera."""
    at = np.arange(-width / 2, width / 2, step) + step / 2
    x, y = np.meshgrid(at, at)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)


def scan_of(positions, color, *, center=None) -> Scan:
    colors = np.broadcast_to(np.array(color, np.uint8), positions.shape).copy()
    return Scan(
        "wall.laz", FAR, positions, colors, np.zeros(len(positions), np.int32),
        (Station("wall", center),), "colour", len(positions), {},
    )  # fmt: skip


def placed() -> Placement:
    """From far coordinates to the camera's frame, half as large."""
    matrix = np.diag([0.5, 0.5, 0.5, 1.0])
    matrix[:3, 3] = -0.5 * FAR
    return Placement(matrix, "given")


RED, BLUE = (200, 0, 0), (0, 0, 200)


def fused(*, photographed=True) -> SpatialMemory:
    """A red scan of a wall whose left half a photograph saw in blue."""
    memory = SpatialMemory(0.02)
    fuse_scan(memory, scan_of(2 * wall(0.02), RED), placed())
    if photographed:
        left = wall(0.02)
        left = left[left[:, 0] < 0]
        memory.fuse(points(left, source=camera(name="a"), colors=BLUE, spacing=0.02), round=0)
    return memory


def test_photographs_win_where_they_saw_the_surface_and_scans_fill_the_rest():
    memory = fused()
    shown = memory.project(camera(name="target"))
    rgb, valid, scanned = shown.rgb[0], shown.valid[0], shown.scanned[0]
    assert valid[4:-4, 4:-4].all() and not shown.generated.any()
    left, right = (slice(4, -4), slice(4, 15)), (slice(4, -4), slice(18, -4))
    np.testing.assert_allclose(rgb[left] * 255, np.broadcast_to(BLUE, rgb[left].shape), atol=1)
    np.testing.assert_allclose(rgb[right] * 255, np.broadcast_to(RED, rgb[right].shape), atol=1)
    assert not scanned[left].any() and scanned[right].all()
    np.testing.assert_allclose(shown.depth[0][valid], 2, atol=1e-3)


def test_a_scanned_thing_in_front_of_what_photographs_saw_is_let_through():
    memory = SpatialMemory(0.02)
    fuse_scan(memory, scan_of(2 * wall(0.02, z=1.0, width=0.5), RED), placed())
    memory.fuse(points(wall(0.02), source=camera(name="a"), colors=BLUE, spacing=0.02), round=0)
    shown = memory.project(camera(name="target"))
    assert shown.scanned[0, 12, 16] and shown.depth[0, 12, 16] == pytest.approx(1, abs=1e-3)
    assert not shown.scanned[0, 3, 3] and shown.depth[0, 3, 3] == pytest.approx(2, abs=1e-3)


def test_spacing_follows_the_density_around_each_point_and_dust_is_left_out():
    rng = np.random.default_rng(0)
    dense, sparse = rng.uniform(0, 1, (10_000, 3)), rng.uniform(0, 1, (2500, 3))
    sparse[:, 0] += 3
    dust = np.array([[2.0, 0.5, 2.0], [8.0, 0.5, 0.5]])
    positions = np.concatenate([dense, sparse, dust])
    positions[:, 2] *= [*np.zeros(12_500), 1, 1]
    spacing, isolated = point_spacing(positions)
    # So many points on one square: one a square of that side.
    assert np.median(spacing[:10_000]) == pytest.approx(0.01, rel=0.08)
    assert np.median(spacing[10_000:12_500]) == pytest.approx(0.02, rel=0.08)
    assert isolated[-2:].all() and isolated[:12_500].mean() < 1e-3


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
    file = to_scan(scanned)
    file[5], file[7] = 1e30, -1e12  # strays
    found = register(Surface(file, viewpoints), seen(photographed), least=0.5, metric=False)
    assert found.how == "estimated" and found.fitness is not None and found.fitness > 0.7
    assert found.scale == pytest.approx(0.4, rel=0.01)
    np.testing.assert_allclose(found.apply(to_scan(scanned)), scanned, atol=0.03)


def test_a_scan_that_fits_as_it_is_stays_where_it_is():
    one, two = surface(20_000, seed=1)[0] + FAR, surface(20_000, seed=2)[0] + FAR
    found = register(Surface(one), Surface(two, two * 0 + FAR + SEEN_FROM), least=0.5, metric=True)
    assert found.how == "as it is"
    np.testing.assert_array_equal(found.world_from_scan, np.eye(4))


@pytest.mark.parametrize(("moved", "fits"), [(0.0, True), (0.3, False), (1e6, False)])
def test_a_given_placement_is_judged_and_kept(moved, fits):
    one, two = surface(20_000, seed=1)[0], surface(20_000, seed=2)[0]
    matrix = rigid_poses(np.eye(3), moved)
    found = register(
        Surface(one), seen(two), least=0.5, metric=True, given=Placement(matrix, "given")
    )
    assert found.how == "given" and np.array_equal(found.world_from_scan, matrix)
    assert (found.fitness > 0.5) if fits else (found.fitness < 0.1)
    json.dumps(found.to_json(), allow_nan=False)


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


@pytest.mark.parametrize("count", [2000, 30_000])
def test_noise_is_refused_before_it_is_searched(count, monkeypatch):
    monkeypatch.setattr(registration._Task, "candidates", None)
    noise = np.random.default_rng(1).uniform(-1, 1, (count, 3)) + FAR
    with pytest.raises(DegenerateError, match=r"lie on no surface .* give its placement"):
        register(Surface(noise), seen(surface(20_000)[0]), least=0.5, metric=True)


def test_a_scan_in_millimetres_with_z_up_around_what_was_photographed():
    scanned, photographed = surface(30_000, seed=2)[0], surface(20_000, seed=1)[0]
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
