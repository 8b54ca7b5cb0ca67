"""What networks save of cameras and points, read: layouts, and what is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from command_line import refused
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.capture.predictions import read_predictions
from gvtools.scenes.colmap_writer import write_colmap

V, WIDTH, HEIGHT = 3, 32, 24


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    poses = np.tile(np.eye(4), (V, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("y", [[-20], [5], [30]], degrees=True).as_matrix()
    poses[:, :3, 3] = np.arange(9).reshape(3, 3)
    K = np.array([[40.0, 0, WIDTH / 2], [0, 44.0, HEIGHT / 2], [0, 0, 1]])
    names = tuple(f"{row}.png" for row in range(V))
    return Cameras(np.tile(K, (V, 1, 1)), poses, np.array(WIDTH), np.array(HEIGHT), names)


@pytest.fixture(scope="module")
def depth():
    return np.random.default_rng(1).uniform(1, 4, (V, HEIGHT, WIDTH)).astype(np.float32)


def world_points(cameras, depth):
    return np.stack([
        (cameras.rays(row) * depth[row][..., None]) @ pose[:3, :3].T + pose[:3, 3]
        for row, pose in enumerate(cameras.world_from_cam)
    ])  # fmt: skip


def assert_same(found, cameras):
    assert_allclose(found.cameras.K, cameras.K, rtol=1e-5)
    assert_allclose(found.cameras.cam_from_world, cameras.cam_from_world, atol=1e-5)


def test_points_of_a_model_are_where_its_cameras_see_them(cameras, depth, tmp_path):
    """demo_colmap.py of VGGT shifts what pictures show by the padding at another scale."""
    points = world_points(cameras, depth)[:, ::4, ::4].reshape(-1, 3)
    y, x = np.mgrid[:HEIGHT:4, :WIDTH:4] + 0.5
    xy = np.tile(np.column_stack([x.ravel(), y.ravel()]), (V, 1))
    view = np.repeat(np.arange(V), x.size)
    write_colmap(
        tmp_path / "sparse", cameras, points=points, point_index=np.arange(len(points)),
        view_index=view, xy=xy - [0, 5],
    )  # fmt: skip
    found = read_predictions(tmp_path)
    assert_same(found, cameras)
    np.testing.assert_array_equal(found.view, view)
    assert_allclose(found.xy, xy, atol=1e-9)


def test_files_of_each_picture_as_cut3r_saves_them(cameras, depth, tmp_path):
    for folder in ("camera", "depth", "conf", "color"):
        (tmp_path / folder).mkdir()
    for row, pose in enumerate(cameras.world_from_cam):
        np.savez(tmp_path / f"camera/{row:06d}.npz", pose=pose, intrinsics=cameras.K[row])
        np.save(tmp_path / f"depth/{row:06d}.npy", depth[row])
        np.save(tmp_path / f"conf/{row:06d}.npy", np.ones_like(depth[row]))
        cv2.imwrite(str(tmp_path / f"color/{row:06d}.png"), np.full((HEIGHT, WIDTH, 3), row))
    found = read_predictions(tmp_path)
    assert_same(found, cameras)
    assert len(found.view) == depth.size
    assert found.pictures is not None and found.pictures[:, 0, 0, 0].tolist() == [0, 1, 2]


def test_points_alone_tell_pi3s_focal_lengths(cameras, depth, tmp_path):
    points = world_points(cameras, depth)
    points[:, :4] = np.nan
    np.savez(
        tmp_path / "predictions.npz", points=points, conf=np.ones((*depth.shape, 1)),
        camera_poses=cameras.world_from_cam, images=np.zeros((V, HEIGHT, WIDTH, 3)),
    )  # fmt: skip
    assert_same(read_predictions(tmp_path), cameras)


@pytest.mark.parametrize("K", [(3, 3), (1, 3, 3)])
def test_one_k_is_of_all_pictures(cameras, tmp_path, K):
    np.savez(
        tmp_path / "x.npz", extrinsics=cameras.cam_from_world, intrinsics=cameras.K[0].reshape(K)
    )
    assert_same(read_predictions(tmp_path / "x.npz"), cameras)


@pytest.mark.parametrize(
    ("name", "reason"),
    [("scene.glb", "without intrinsics"), ("model.pt", "needs pickle"), ("x.txt", "'.txt'"),
     ("points.ply", "without cameras"), ("nan.npz", "nan.npz: unreadable (pose 1")],
)  # fmt: skip
def test_other_files_are_refused_for_what_they_lack(cameras, room, tmp_path, capsys, name, reason):
    file, poses = tmp_path / name, cameras.cam_from_world.copy()
    poses[1, 0, 0] = np.nan
    if file.suffix == ".npz":
        np.savez(file, extrinsics=poses, intrinsics=cameras.K)
    else:
        file.write_bytes(b"glTF")
    line = refused(capsys, "capture", room / "images", "--poses", file, "--out", tmp_path / "o")
    assert reason in line and "expected poses" in line
