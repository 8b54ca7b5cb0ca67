"""A memory's own frame: what is stored and shown goes with it, wherever the world lies."""

from __future__ import annotations

import numpy as np
import pytest
from memory_scenes import camera
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.errors import ShapeError
from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.store.local_frame import LocalFrame

TURN = Rotation.from_rotvec([0.4, -0.9, 0.2]).as_matrix()
PLACE = np.array([3.0, -20.0, 7.0])


def world(turned: bool) -> LocalFrame:
    return LocalFrame.at(PLACE, TURN) if turned else LocalFrame.at()


def placed(cameras: Cameras, frame: LocalFrame) -> Cameras:
    """Cameras given in a frame, in the world."""
    local_from_cam = cameras.world_from_cam
    pose = local_from_cam.copy()
    pose[:, :3, :3] = frame.axes @ local_from_cam[:, :3, :3]
    pose[:, :3, 3] = frame.to_world(local_from_cam[:, :3, 3])
    cam_from_world = np.linalg.inv(pose).astype(np.float64)
    return Cameras(cameras.K, cam_from_world, cameras.width, cameras.height, names=cameras.names)


def filled(frame: LocalFrame) -> SpatialMemory:
    """Random pictures and depths of three views, the last of them generated."""
    memory = SpatialMemory(0.05, origin=frame.origin, axes=frame.axes)
    rng = np.random.default_rng(0)
    for number in range(3):
        source = placed(
            camera(center=(0.2 * number, 0.1, -0.1 * number), rotation=(0, 0.1 * number, 0)), frame
        )
        shape = int(source.height[0]), int(source.width[0])
        rgb = rng.integers(0, 256, (*shape, 3), np.uint8)
        depth = rng.choice([2.0, 2.03, 3.1], shape).astype(np.float32)
        points = back_project(rgb, depth, source, frame=memory.frame)
        memory.fuse(points, round=number, generated=number == 2)
    return memory


def test_the_same_scene_in_another_world_is_the_same_memory():
    here, there = filled(world(False)), filled(world(True))
    assert len(here) == len(there) and here.voxels == there.voxels
    np.testing.assert_allclose(here.columns.positions, there.columns.positions, atol=2e-5)
    assert np.array_equal(here.columns.colors[: len(here)], there.columns.colors[: len(there)])
    np.testing.assert_allclose(world(True).to_world(here.positions), there.positions, atol=2e-5)
    # And not that of a grid along the world's axes.
    assert len(filled(LocalFrame.at(PLACE))) != len(here) or not np.allclose(
        filled(LocalFrame.at(PLACE)).positions, there.positions, atol=1e-3
    )


@pytest.mark.parametrize("backend", ["cpu", "torch", "nearest", "open3d"])
def test_it_shows_the_same_pictures(backend):
    options = SplatOptions(backend=backend, device="cpu")
    target = camera(center=(0.1, 0.15, 0.05), rotation=(0.02, 0.08, 0))
    one = filled(world(False)).project(target, options=options)
    two = filled(world(True)).project(placed(target, world(True)), options=options)
    same = one.valid == two.valid
    assert same.mean() > 0.995 and one.valid.mean() > 0.2
    apart = np.abs(one.rgb - two.rgb).max(-1)[same]
    assert (apart < 1e-3).mean() > 0.995


def test_a_turned_memory_is_saved_exported_and_undone(tmp_path):
    memory = filled(world(True))
    memory.save(tmp_path / "memory.npz")
    loaded = SpatialMemory.load(tmp_path / "memory.npz")
    assert loaded.frame.same_as(memory.frame)
    assert np.array_equal(loaded.positions, memory.positions)
    loaded.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "memory.npz").read_bytes()
    cloud = loaded.cloud
    np.testing.assert_allclose(
        memory.frame.to_world(cloud.point.positions.numpy()), memory.positions, atol=1e-5
    )
    loaded.forget(round=2)
    assert not loaded.generated.any() and 0 < len(loaded) < len(memory)


def test_points_of_another_frame_are_refused():
    memory = SpatialMemory(0.1, axes=TURN)
    source = camera()
    shape = int(source.height[0]), int(source.width[0])
    points = back_project(np.zeros((*shape, 3), np.uint8), np.ones(shape, np.float32), source)
    with pytest.raises(ShapeError, match="back-project with the memory's frame"):
        memory.fuse(points, round=0)


@pytest.mark.parametrize(
    ("axes", "said"),
    [(np.eye(2), "rotation"), (2 * np.eye(3), "rotation"), (np.diag([1, 1, -1.0]), "mirror")],
)
def test_axes_that_are_no_rotation_are_refused(axes, said):
    with pytest.raises(ShapeError, match=said):
        SpatialMemory(0.1, axes=axes)


def test_a_cameras_frame_is_the_cameras_with_an_exact_rotation():
    seen = placed(camera(), world(True))
    crooked = seen.cam_from_world.copy()
    crooked[0, :3, :3] += 1e-7
    found = LocalFrame.of_camera(
        Cameras(seen.K, crooked, seen.width, seen.height, names=seen.names)
    )
    np.testing.assert_allclose(found.axes.T @ found.axes, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(found.axes, seen.world_from_cam[0, :3, :3], atol=1e-6)
    there = found.from_world(found.to_world([[1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(there, [[1, 2, 3]], atol=1e-12)


def test_what_two_parts_of_a_view_know_is_free_as_far_as_both_saw():
    """The nearer surface ends it; a cell that one part does not know is the other's."""
    memory = SpatialMemory(0.1)
    source = camera()
    rgb = np.zeros((24, 32, 3), np.uint8)
    for value, columns in ((3.0, np.s_[:24]), (2.0, np.s_[8:])):
        mask = np.zeros((24, 32), np.bool_)
        mask[:, columns] = True
        depth = np.full((24, 32), value, np.float32)
        memory.fuse(back_project(rgb, depth, source, mask=mask), round=0)
    assert len(memory.views) == 1
    assert memory.views[0].free_depth[0].tolist() == [3, 3, 2, 2, 2, 2, 2, 2]
