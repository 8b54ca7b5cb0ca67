"""Predictions of networks: the layouts that are read, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from command_line import refused
from numpy.testing import assert_allclose
from PIL import Image
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


def draw_camera(scene, pose, picture, focal):
    """As DUSt3R's ``add_scene_cam``: the picture on the base of a pyramid, and that pyramid."""
    trimesh = pytest.importorskip("trimesh")
    height, width = picture.shape[:2]
    deep, side = 0.1 * focal / height, 0.1 * width / height
    base = np.array([[-side, -0.1, 0], [side, -0.1, 0], [side, 0.1, 0], [-side, 0.1, 0]]) / 2
    base[:, 2] = -deep
    turned = pose @ np.diag([1.0, -1, -1, 1])
    corners = base @ turned[:3, :3].T + turned[:3, 3]
    quad = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    quad.visual = trimesh.visual.TextureVisuals(uv, image=Image.fromarray(picture))
    tip = turned[:3, 3]
    inner = 0.95 * tip + 0.05 * corners.mean(axis=0)
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 5]]
    pyramid = trimesh.Trimesh(np.vstack([corners, tip, inner]), faces, process=False)
    pyramid.visual.face_colors[:, :3] = 255, 0, 0
    scene.add_geometry(quad)
    scene.add_geometry(pyramid)


@pytest.mark.parametrize("drawn", [True, False])
def test_cameras_that_dust3r_and_mast3r_draw(cameras, depth, room, tmp_path, capsys, drawn):
    trimesh = pytest.importorskip("trimesh")
    square = replace(cameras, K=np.where(cameras.K == 44, 40, cameras.K))
    pictures = np.random.default_rng(2).integers(0, 256, (V, HEIGHT, WIDTH, 3), np.uint8)
    scene, points = trimesh.Scene(), world_points(square, depth)
    scene.add_geometry(trimesh.PointCloud(points.reshape(-1, 3), colors=pictures.reshape(-1, 3)))
    for row in range(V if drawn else 0):
        draw_camera(scene, square.world_from_cam[row], pictures[row], 40.0)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("xyz", [1, 2, 3]).as_matrix()
    scene.apply_transform(turn)
    scene.export(str(tmp_path / "scene.glb"))
    if not drawn:
        line = refused(capsys, "capture", room / "images", "--poses", tmp_path / "scene.glb",
                       "--out", tmp_path / "out")  # fmt: skip
        assert "no cameras are drawn with their pictures" in line
        return
    found = read_predictions(tmp_path / "scene.glb")
    assert_allclose(found.cameras.K, square.K, rtol=1e-4)
    assert_allclose(found.cameras.cam_from_world @ turn, square.cam_from_world, atol=1e-4)
    np.testing.assert_array_equal(found.pictures, pictures)
    # Random colours hardly ever agree by chance.
    x, y = np.floor(found.xy).astype(int).T
    assert len(found.view) > 0.98 * depth.size
    assert_allclose(found.points @ turn[:3, :3], points[found.view, y, x], atol=1e-3)


@pytest.mark.parametrize("K", [(3, 3), (1, 3, 3)])
def test_one_k_is_of_all_pictures(cameras, tmp_path, K):
    np.savez(
        tmp_path / "x.npz", extrinsics=cameras.cam_from_world, intrinsics=cameras.K[0].reshape(K)
    )
    assert_same(read_predictions(tmp_path / "x.npz"), cameras)


@pytest.mark.parametrize(
    ("name", "reason"),
    [("scene.glb", "ends early"), ("model.pt", "needs pickle"), ("x.txt", "'.txt'"),
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
