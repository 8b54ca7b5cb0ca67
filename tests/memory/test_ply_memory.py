from __future__ import annotations

import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.errors import MemoryFileError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.ply import write_ply

COLOR = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
XYZ = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]


def wall(offset: float = 0.0) -> np.ndarray:
    """A grid of points 1 cm apart on the plane z = 2."""
    x, y = np.meshgrid(np.arange(-60, 61) * 0.01, np.arange(-60, 61) * 0.01)
    vertices = np.zeros(x.size, XYZ + COLOR)
    vertices["x"], vertices["y"], vertices["z"] = x.ravel() + offset, y.ravel(), 2.0
    vertices["red"], vertices["green"], vertices["blue"] = 200, 100, 50
    return vertices


@pytest.mark.parametrize("offset", [0.0, 4.0e6])
def test_a_wall_is_seen_where_it_stands(tmp_path, offset):
    path = tmp_path / "wall.ply"
    write_ply(path, wall(offset))
    memory = SpatialMemory.from_ply(path)
    assert memory.voxel == pytest.approx(0.01, rel=1e-3)
    K = np.array([[[100.0, 0, 24], [0, 100, 24], [0, 0, 1]]])
    pose = np.eye(4)
    pose[0, 3] = -offset
    seen = memory.project(Cameras(K, pose[None], np.array([48]), np.array([48]), ("a",)))
    assert seen.coverage == 1.0
    np.testing.assert_allclose(seen.depth, 2.0, atol=1e-5)
    np.testing.assert_allclose(seen.rgb[0, 20, 20] * 255, [200, 100, 50], atol=1e-3)


def test_what_is_no_coloured_cloud_is_refused(tmp_path):
    path = tmp_path / "cloud.ply"
    write_ply(path, np.zeros(5, XYZ))
    with pytest.raises(MemoryFileError, match="red"):
        SpatialMemory.from_ply(path)
    write_ply(path, np.zeros(5, XYZ + COLOR))
    with pytest.raises(MemoryFileError, match="distinct"):
        SpatialMemory.from_ply(path)
    write_ply(path, wall())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(MemoryFileError, match="truncated"):
        SpatialMemory.from_ply(path)
