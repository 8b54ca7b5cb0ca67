"""``gvtools capture --poses``: what networks save, by a room's true cameras and by random ones."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from command_line import refused, run_command
from micro_weights import write_micro_weights
from numpy.testing import assert_allclose
from PIL import Image
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.capture.posed_photographs import capture_posed
from gvtools.capture.predictions import read_predictions
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.pose_forms import pose_findings
from gvtools.scenes.project import open_project
from gvtools.similarity import align_poses

pytestmark = pytest.mark.usefixtures("unpainted")
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def refused_poses(capsys, images, poses):
    out = poses.with_name("refused")
    line = refused(capsys, "capture", images, "--poses", poses, "--out", out)
    assert not out.exists()
    return line


def saved(folder, cameras, pictures, **arrays):
    """Photographs, and what a network saved of them."""
    (folder / "images").mkdir()
    for name, rgb in zip(cameras.names, pictures, strict=True):
        cv2.imwrite(str(folder / "images" / name), rgb)
    np.savez(folder / "x.npz", extrinsics=cameras.cam_from_world, intrinsics=cameras.K, **arrays)
    return folder / "images", folder / "x.npz"


@pytest.fixture(scope="module")
def truth(room):
    """The room's true cameras and pictures."""
    scene = open_project(room / "transforms.json")
    return scene.cameras, [view.load().rgb for view in scene.views]


@pytest.fixture(scope="module")
def depths(wall_walk):
    return [picture.depth for picture in wall_walk]


def shrunk(array, scaled, net):
    """Resized to one size, then cut at the middle to another."""
    small = cv2.resize(array, scaled, interpolation=cv2.INTER_AREA)
    left, top = ((a - b) // 2 for a, b in zip(scaled, net, strict=True))
    return small[top : top + net[1], left : left + net[0]]


def miniature(truth, depths, scaled, net):
    """(V, ...) pictures, depth, K and poses of a network that sees the photographs so."""
    cameras, pictures = truth
    left, top = ((a - b) // 2 for a, b in zip(scaled, net, strict=True))
    own = cameras.resized(*scaled).cropped(left, top, width=net[0], height=net[1])
    images = np.stack([shrunk(rgb, scaled, net) for rgb in pictures])
    return images, np.stack([shrunk(z, scaled, net) for z in depths]), own


def noisy(poses):
    """Turned by half a degree or so."""
    turns = np.random.default_rng(3).normal(size=(len(poses), 3)) * np.deg2rad(0.4)
    changed = poses.copy()
    changed[:, :3] = Rotation.from_rotvec(turns).as_matrix() @ changed[:, :3]
    return changed


def world_points(cameras, depth):
    return np.stack([
        (cameras.rays(row) * depth[row][..., None]) @ pose[:3, :3].T + pose[:3, 3]
        for row, pose in enumerate(cameras.world_from_cam)
    ])  # fmt: skip


def vggt(folder, truth, depths):
    images, depth, own = miniature(truth, depths, (126, 98), (126, 98))
    arrays = {
        "pose_enc": np.zeros((len(own), 9), np.float32),
        "depth": depth[..., None].astype(np.float32),
        "depth_conf": np.ones(depth.shape, np.float32),
        "world_points": world_points(own, depth).astype(np.float32),
        "world_points_conf": np.ones(depth.shape, np.float32),
        "images": images.transpose(0, 3, 1, 2).astype(np.float32) / 255,
        "extrinsic": noisy(own.cam_from_world)[:, :3].astype(np.float32),
        "intrinsic": own.K.astype(np.float32),
        "pose_enc_list": np.array(None, dtype=object),
    }
    np.savez(folder / "predictions.npz", **arrays)
    return folder / "predictions.npz"


def depth_anything(folder, truth, depths):
    """Without pictures: sizes alone tell how the photographs were reduced."""
    _, depth, own = miniature(truth, depths, (126, 98), (126, 98))
    (folder / "exports/mini_npz").mkdir(parents=True)
    np.savez_compressed(
        folder / "exports/mini_npz/results.npz", depth=depth, conf=np.ones(depth.shape),
        extrinsics=own.cam_from_world[:, :3], intrinsics=own.K,
    )  # fmt: skip
    return folder


def mapanything(folder, truth, depths):
    """Resized and cut; poses map to the world."""
    images, depth, own = miniature(truth, depths, (150, 112), (126, 112))
    np.savez(
        folder / "predictions.npz", extrinsic=own.world_from_cam, intrinsic=own.K,
        world_points=world_points(own, depth), conf=np.ones(depth.shape),
        depth=depth[..., None], images=images / np.float32(255),
        final_mask=np.ones(depth.shape, bool),
    )  # fmt: skip
    return folder / "predictions.npz"


def dust3r(folder, truth, depths):
    """Loose arrays, points in the world, one focal length of a picture that is cut."""
    images, depth, own = miniature(truth, depths, (160, 120), (160, 112))
    arrays = {
        "poses": own.world_from_cam, "focals": own.K[:, 0, 0], "imgs": images / np.float32(255),
        "pts3d": world_points(own, depth), "conf": np.ones(depth.shape),
    }  # fmt: skip
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    return folder


def opengl(folder, truth, depths):
    """Another convention than the names say."""
    _, depth, own = miniature(truth, depths, (126, 98), (126, 98))
    np.savez(
        folder / "own.npz", extrinsics=own.world_from_cam @ FLIP, intrinsics=own.K, depth=depth
    )
    return folder / "own.npz"


def colmap(folder, truth, depths):
    """demo_colmap.py of VGGT: points that one picture sees each."""
    cameras, _ = truth
    points = world_points(cameras, np.stack(depths))[:, ::8, ::8]
    count = points.shape[1] * points.shape[2]
    y, x = np.mgrid[:120:8, :160:8] + 0.5
    write_colmap(
        folder / "sparse", cameras, points=points.reshape(-1, 3),
        point_index=np.arange(count * len(cameras)),
        view_index=np.repeat(np.arange(len(cameras)), count),
        xy=np.tile(np.column_stack([x.ravel(), y.ravel()]), (len(cameras), 1)),
    )  # fmt: skip
    return folder


SLOW = [pytest.param(layout, marks=pytest.mark.slow) for layout in (
    depth_anything, dust3r, colmap, mapanything,
)]  # fmt: skip


@pytest.mark.parametrize("layout", [vggt, opengl, *SLOW])
def test_what_a_network_saved_becomes_a_project(layout, truth, depths, room, tmp_path):
    (tmp_path / "net").mkdir()
    poses = layout(tmp_path / "net", truth, depths)
    out = tmp_path / "out"
    if layout is vggt:
        run_command("capture", room / "images", "--poses", poses, "--out", out)
    else:
        capture_posed(room / "images", out, poses=poses)
    report = json.loads((out / "capture.json").read_text())
    told = " ".join(item["message"] for item in report["findings"])
    assert layout is not vggt or "median error" in report["mapping"]
    scene, cameras = open_project(out), truth[0]
    assert scene.names == cameras.names
    assert not pose_findings(scene)
    assert ("do not fit the photographs" in told) == (layout is opengl)
    assert ("have been stretched" in told) == (layout in (depth_anything, opengl))
    found = scene.cameras
    np.testing.assert_allclose(found.K[:, 0, 0], cameras.K[:, 0, 0], rtol=0.03)
    # The world is levelled: where the photographs were taken, the points are, too.
    moved = found.cam_from_world @ align_poses(found.cam_from_world, cameras.cam_from_world)
    extent = np.linalg.norm(np.ptp(cameras.centers, axis=0))
    away = np.linalg.norm(np.linalg.inv(moved)[:, :3, 3] - cameras.centers, axis=1)
    assert away.max() < 0.05 * extent
    points = scene.points
    seen = [np.abs(far(points, found, row, depths) - 1) for row in range(len(found))]
    assert len(points.positions) > 1000 and np.median(np.concatenate(seen)) < 0.03


def far(points, cameras: Cameras, row, depths):
    """Depth of the points that a view sees over the true one."""
    mine = points.view_index == row
    z = cameras[row].project(points.positions[points.point_index[mine]])[1][0]
    x, y = points.xy[mine].astype(int).T
    return z / depths[row][y, x]


def test_a_wrong_count_is_refused(truth, depths, room, tmp_path, capsys):
    poses = vggt(tmp_path, truth, depths)
    # Its weights may lie beside it.
    (tmp_path / "model.safetensors").touch()
    shutil.copytree(room / "images", tmp_path / "fewer")
    next(iter(sorted((tmp_path / "fewer").iterdir()))).unlink()
    line = refused_poses(capsys, tmp_path / "fewer", poses.parent)
    assert "10 cameras without names" in line and "9 pictures" in line


def test_pictures_in_another_order_are_refused(truth, tmp_path, capsys):
    """Faint ones, as those of a slow film: each resembles its neighbours."""
    faint = np.stack([100 + rgb // 6 for rgb in truth[1]])
    others = np.roll(faint, 1, axis=0)
    line = refused_poses(capsys, *saved(tmp_path, truth[0], faint, images=others))
    assert "picture 1 is to be 0.png, which looks like number 2" in line


def test_pictures_of_several_shapes_need_those_of_the_network(truth, tmp_path, capsys):
    shapes = [rgb[: 120 - 40 * (row == 3)] for row, rgb in enumerate(truth[1])]
    line = refused_poses(capsys, *saved(tmp_path, truth[0], shapes, depth=np.ones((10, 70, 84))))
    assert "of 84x70 pixels, and the photographs are of several shapes" in line


def test_a_name_that_two_cameras_share_is_no_pictures(truth, room, tmp_path, capsys):
    cameras = replace(truth[0], names=tuple(f"{'ab'[row % 2]}/{row // 2}.png" for row in range(10)))
    write_colmap(tmp_path / "net/sparse", cameras)
    line = refused_poses(capsys, room / "images", tmp_path / "net")
    assert "cameras of a/0.png" in line


def test_poses_alone_of_pictures_without_features_become_a_project(truth, tmp_path):
    ramp = np.repeat(np.mgrid[:120, :160].sum(axis=0)[..., None], 3, axis=2)
    pictures = [(ramp * steep // 8).astype(np.uint8) for steep in (2, 3, 4)]
    images, poses = saved(tmp_path, truth[0][:3], pictures)
    run_command("capture", images, "--poses", poses, "--out", tmp_path / "out")
    assert len(open_project(tmp_path / "out")) == 3


EYES, KS = np.tile(np.eye(4), (3, 1, 1)), np.tile(np.diag([9.0, 9, 1]), (3, 1, 1))
LOST = np.where(np.arange(3)[:, None, None] == 1, np.nan, EYES)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("x.npz", {"extrinsics": np.array([None])}, "type object"),
        ("x.npz", {"depth": np.ones((2, 4, 4))}, "no poses"),
        ("x.npz", {"extrinsics": EYES}, "no intrinsics"),
        ("x.npz", {"extrinsics": 2 * EYES[:, :3], "intrinsics": KS}, "no rotation"),
        ("nan.npz", {"extrinsics": LOST, "intrinsics": KS}, "nan.npz: unreadable (pose 1"),
        ("scene.glb", b"glTF", "ends early"),
        ("model.pt", b"glTF", "needs pickle"),
        ("x.txt", b"glTF", "'.txt'"),
        ("points.ply", b"glTF", "without cameras"),
    ],
)
def test_other_files_are_refused_for_what_they_lack(name, content, reason, room, tmp_path, capsys):
    file = tmp_path / name
    file.write_bytes(content) if isinstance(content, bytes) else np.savez(file, **content)
    line = refused_poses(capsys, room / "images", file)
    assert reason in line and "expected poses" in line


def test_cameras_of_depth_anything_are_decoded(truth):
    import torch

    from gvtools.capture.posed_photographs import decode_cameras
    from gvtools.networks.depth_anything.encoder import encode_cameras

    cameras = truth[0]
    K = cameras.K.copy()
    K[:, :2, 2] = 80, 60
    encoding = encode_cameras(
        torch.from_numpy(cameras.cam_from_world), torch.from_numpy(K), (120, 160)
    )
    found = decode_cameras(encoding, (120, 160), names=cameras.names)
    np.testing.assert_allclose(found.K, K, atol=1e-9)
    np.testing.assert_allclose(found.cam_from_world, cameras.cam_from_world, atol=1e-9)


def test_weights_of_depth_anything_compute_the_poses(room, tmp_path):
    """Random ones: what comes is a project with a warning, not the room."""
    run_command(
        "capture", room / "images", "--out", tmp_path / "out", "--poses",
        write_micro_weights(tmp_path / "weights"),
    )  # fmt: skip
    report = json.loads((tmp_path / "out/capture.json").read_text())
    assert len(report["registered"]) == 10 and len(open_project(tmp_path / "out")) == 10
    assert any("do not fit the photographs" in item["message"] for item in report["findings"])


V, WIDTH, HEIGHT = 3, 32, 24


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    poses = np.tile(np.eye(4), (V, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("y", [[-20], [5], [30]], degrees=True).as_matrix()
    poses[:, :3, 3] = np.arange(9).reshape(3, 3)
    K = np.array([[40.0, 0, WIDTH / 2], [0, 44.0, HEIGHT / 2], [0, 0, 1]])
    names = tuple(f"{row}.png" for row in range(V))
    return Cameras.alike(K, poses, size=(WIDTH, HEIGHT), names=names)


@pytest.fixture(scope="module")
def depth():
    return np.random.default_rng(1).uniform(1, 4, (V, HEIGHT, WIDTH)).astype(np.float32)


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
        line = refused_poses(capsys, room / "images", tmp_path / "scene.glb")
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
    arrays = {"extrinsics": cameras.cam_from_world, "intrinsics": cameras.K[0].reshape(K)}
    np.savez(tmp_path / "x.npz", **arrays)
    assert_same(read_predictions(tmp_path / "x.npz"), cameras)
