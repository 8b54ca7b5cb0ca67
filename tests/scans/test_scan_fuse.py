from __future__ import annotations

import numpy as np
import pytest
from memory_scenes import camera, points
from scan_files import FAR

from gvtools.memory.ply import export_memory_ply
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.scans.fuse import fuse_scan, point_spacing
from gvtools.scans.points import Scan, Station
from gvtools.scans.registration import Placement


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


def test_scanned_and_photographed_points_never_merge():
    memory, alone = fused(), fused(photographed=False)
    assert int(memory.scanned.sum()) == len(alone) and int((~memory.scanned).sum()) > 0
    np.testing.assert_array_equal(memory.columns.colors[memory.scanned], alone.columns.colors)
    assert "scanned" in repr(memory)


def test_what_a_scanner_saw_refuses_generated_points_as_what_a_camera_saw_does():
    memory = fused(photographed=False)
    report = memory.fuse(points(wall(0.02), source=camera(name="b")), round=1, generated=True)
    assert report.rejected_observed == report.points


@pytest.mark.parametrize("backend", ["cpu", "torch", "nearest"])
def test_back_ends_say_what_is_scanned(backend):
    from gvtools.memory.splat.api import SplatOptions

    shown = fused(photographed=False).project(camera(), options=SplatOptions(backend=backend))
    np.testing.assert_array_equal(shown.scanned, shown.valid)


def test_files_keep_scanned_points_apart(tmp_path):
    memory = fused()
    memory.save(tmp_path / "memory.npz")
    again = SpatialMemory.load(tmp_path / "memory.npz")
    np.testing.assert_array_equal(again.scanned, memory.scanned)
    export_memory_ply(memory, tmp_path / "memory.ply")
    from_ply = SpatialMemory.from_ply(tmp_path / "memory.ply")
    assert from_ply.scanned.any() and not from_ply.scanned.all() and not from_ply.generated.any()


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


def test_points_go_into_voxels_of_their_own_density():
    memory = SpatialMemory(0.005)
    fuse_scan(memory, scan_of(2 * wall(0.02), RED), placed())
    # 0.02 apart in the world: the widest voxels of 0.005, 0.01, 0.02, ... within that.
    assert np.median(memory.columns.spacing) == pytest.approx(0.019, rel=0.1)
    assert set(memory.columns.level.tolist()) <= {1, 2}
