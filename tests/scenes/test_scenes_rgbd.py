# mypy: no-check-untyped-defs
from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from rgbd_folders import redwood, scannet, tum
from scenes_workspace import HEIGHT, WIDTH, messages, pose_matrix, ramp, save, sevenscenes
from scipy.spatial.transform import Rotation

from gvtools.cameras import rigid_poses
from gvtools.errors import GvError, OptionError, ProjectError, ShapeError
from gvtools.scenes.images import read_depth
from gvtools.scenes.project import open_project
from gvtools.scenes.rgbd import RgbdOptions
from gvtools.scenes.rgbd_layouts import PUBLISHED, REDWOOD, SCANNET, SEVENSCENES, TUM

# --- 7-Scenes ---------------------------------------------------------------------------------


def test_sevenscenes_poses_units_and_pixel_centres(tmp_path):
    scene = SEVENSCENES.read(sevenscenes(tmp_path))
    assert scene.metric
    assert scene.names == tuple(f"frame-{i:06d}.color.png" for i in range(3))
    # The file counts pixel centres as integers, we as integer + 0.5.
    np.testing.assert_allclose(scene.cameras.K[0], [[90, 0, 48], [0, 90, 36], [0, 0, 1]])
    for i in range(3):
        np.testing.assert_allclose(
            scene.cameras.world_from_cam[i], pose_matrix(0.1 * i), atol=1e-12
        )
    frame = scene.views[0].load()
    assert frame.depth[0, 0] == frame.depth[0, 1] == 0
    np.testing.assert_allclose(frame.depth[1:], 2.0, rtol=1e-6)
    np.testing.assert_array_equal(frame.rgb, ramp())


def test_sevenscenes_incomplete_frames_are_dropped_and_counted(tmp_path):
    root = sevenscenes(tmp_path, frames=5)
    (root / "frame-000001.pose.txt").unlink()
    (root / "frame-000002.color.png").unlink()
    (root / "frame-000003.depth.png").unlink()
    scene = SEVENSCENES.read(root)
    assert len(scene) == 3
    assert [view.has_depth for view in scene] == [True, False, True]
    assert "1 of 5 frames have no pose: dropped (frame-000001.color.png)" in messages(scene)
    assert "1 of 5 frames have no picture: dropped (frame-000002.color.png; " in messages(scene)
    assert "1 of 3 frames have no depth map (frame-000003.color.png)" in messages(scene)


def test_sevenscenes_intrinsics_in_the_parent_or_nowhere(tmp_path):
    root = sevenscenes(tmp_path / "seq-01")
    (root / "camera-intrinsics.txt").rename(tmp_path / "camera-intrinsics.txt")
    assert SEVENSCENES.read(root).cameras.K[0, 0, 0] == 90
    (tmp_path / "camera-intrinsics.txt").unlink()
    with pytest.raises(ProjectError, match=r"no camera-intrinsics\.txt"):
        SEVENSCENES.read(root)
    K = [[80, 0, 47.5], [0, 80, 35.5], [0, 0, 1]]
    assert SEVENSCENES.read(root, options=RgbdOptions(color_K=K)).cameras.K[0, 0, 0] == 80


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda pose: pose * np.array([[2.0], [2], [2], [1]]), r"scale 2"),
        (lambda pose: pose * np.array([1, 1, -1.0, 1]), "determinant -1"),
        (lambda pose: pose[:2], "2x4 numbers\\); expected 4x4 or 3x4"),
    ],
)
def test_impossible_poses_name_their_file(tmp_path, change, told):
    root = sevenscenes(tmp_path)
    np.savetxt(root / "frame-000001.pose.txt", change(pose_matrix()))
    with pytest.raises(GvError, match=told) as error:
        SEVENSCENES.read(root)
    assert "frame-000001.pose.txt" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", [np.nan, -np.inf])
@pytest.mark.parametrize("make", [sevenscenes, redwood, scannet, tum])
def test_a_pose_that_is_no_number_is_one_lost_frame(tmp_path, make, value):
    make(tmp_path / "scan")
    before = len(open_project(tmp_path / "scan"))
    for file in (tmp_path / "scan").rglob("*0.pose.txt"):
        np.savetxt(file, np.full((4, 4), value))
    for file in (*tmp_path.rglob("pose/2.txt"), *tmp_path.rglob("trajectory.log")):
        lines = file.read_text().splitlines()
        file.write_text("\n".join([lines[0], f"{value} {value} {value} {value}", *lines[2:]]))
    for file in tmp_path.rglob("groundtruth.txt"):
        lines = file.read_text().splitlines()
        file.write_text("\n".join([*lines[:-1], lines[-1].split()[0] + f" {value}" * 7]))
    scene = open_project(tmp_path / "scan")
    assert len(scene) == before - 1
    told = "have NaN in their pose" if np.isnan(value) else "were lost by the tracker"
    assert ("1 poses hold NaN or infinity: dropped" if make is tum else told) in messages(scene)


@pytest.mark.parametrize("order", [1, -1, 0])
def test_tum_without_its_lists(tmp_path, order):
    expected = TUM.read(tum(tmp_path))
    lines = [(tmp_path / f"{kind}.txt").read_text().splitlines() for kind in ("rgb", "depth")]
    if order:
        pairs = [" ".join(pair[::order]) for pair in zip(*lines, strict=True)]
        (tmp_path / "associations.txt").write_text("\n".join(pairs))
    (tmp_path / "rgb.txt").unlink()
    (tmp_path / "depth.txt").unlink()
    (tmp_path / "groundtruth.txt").rename(tmp_path / "gt.txt")
    scene = open_project(tmp_path)
    assert "groundtruth.txt is absent: poses are of gt.txt" in messages(scene)
    assert scene.names == expected.names and all(view.has_depth for view in scene)
    source = "associations.txt" if order else "the names of the files"
    assert f"times are of {source}" in messages(scene)


@pytest.mark.parametrize("place", ["", "intrinsics", "single", "_info.txt", "scan.txt"])
def test_scannets_cameras_at_the_usual_other_places(tmp_path, place):
    expected = SCANNET.read(scannet(tmp_path / "as it is"))
    root = scannet(tmp_path / "scan")
    if place in ("", "intrinsics"):
        (root / place).mkdir(exist_ok=True)
        for file in (root / "intrinsic").iterdir():
            file.rename(root / place / file.name)
        (root / "intrinsic").rmdir()
    else:
        shutil.rmtree(root / "intrinsic")
        color, depth = "180 0 95.5 0 180 71.5 0 0 1", "90 0 47.5 0 0 90 35.5 0 0 0 1 0 0 0 0 1"
        wide = "180 0 95.5 0 0 180 71.5 0 0 0 1 0 0 0 0 1"
        keys = "fx_color = 180\nfy_color = 180\nmx_color = 95.5\nmy_color = 71.5\n"
        info = f"m_calibrationColorIntrinsic = {wide}\nm_calibrationDepthIntrinsic = {depth}\n"
        name = "intrinsic.txt" if place == "single" else place
        np.savetxt(root / name, np.array(color.split(), float).reshape(3, 3))
        if place != "single":
            (root / name).write_text(info if place == "_info.txt" else keys)
        (root / "color").rename(root / "rgb")
        (root / "pose").rename(root / "poses")
    scene = open_project(root)
    assert scene.names == expected.names and all(view.has_depth for view in scene)
    np.testing.assert_array_equal(scene.cameras.K, expected.cameras.K)
    assert "differs from" not in messages(scene)
    np.savetxt(root / "K.txt", 2 * np.eye(3))
    if place in ("", "intrinsics", "single"):
        assert "K.txt differs from intrinsic" in messages(open_project(root))


@pytest.mark.parametrize("name", ["Pose", "c2w", "extrinsics"])
def test_poses_in_folders_of_other_names(tmp_path, name):
    root = scannet(tmp_path / "scan")
    expected = SCANNET.read(root)
    (root / "color").rename(root / "RGB")
    (root / "depth").rename(root / "depth_maps")
    (root / "pose").rename(root / name)
    if name == "extrinsics":  # of either way
        with pytest.raises(ProjectError, match=r"if extrinsics/ holds them, camera-to-world, call"):
            open_project(root)
    else:
        found = open_project(root).cameras.cam_from_world
        np.testing.assert_array_equal(found, expected.cameras.cam_from_world)


@pytest.mark.parametrize("codes", [[[90, 5, 0], [0, 90, 0], [0, 0, 1]], [[0, 0, 0]] * 3])
def test_impossible_intrinsics(tmp_path, codes):
    root = sevenscenes(tmp_path)
    np.savetxt(root / "camera-intrinsics.txt", codes)
    with pytest.raises(ProjectError, match="fx, fy > 0"):
        SEVENSCENES.read(root)


def test_depth_of_another_size(tmp_path):
    root = sevenscenes(tmp_path)
    half = np.arange(HEIGHT * WIDTH // 4, dtype=np.uint16).reshape(HEIGHT // 2, -1) + 1000
    save(root / "frame-000000.depth.png", half)
    save(root / "frame-000001.depth.png", np.full((50, 50), 1000, np.uint16))
    scene = SEVENSCENES.read(root)
    np.testing.assert_allclose(
        scene.views[0].load().depth, np.repeat(np.repeat(half, 2, 0), 2, 1) / 1000, rtol=1e-6
    )
    with pytest.raises(ProjectError, match="50x50 for a picture of 96x72"):
        scene.views[1].load()
    assert [f.level for f in scene.findings if "50x50" in f.message] == ["error"]


def test_depth_maximum_unit_and_eight_bit_depth(tmp_path):
    root = sevenscenes(tmp_path)
    save(root / "frame-000001.depth.png", np.full((HEIGHT, WIDTH), 99, np.uint8))
    scene = SEVENSCENES.read(root, options=RgbdOptions(depth_unit=1e-2, depth_max=15.0))
    assert not scene.views[0].load().depth.any()  # 20 m everywhere
    with pytest.raises(ProjectError, match="8 bits"):
        scene.views[1].load()
    assert "depth map with 8 bits" in messages(scene)


def test_registration_through_options_and_sidecar(tmp_path):
    root = sevenscenes(tmp_path)
    K = [[90, 0, 47.5], [0, 90, 35.5], [0, 0, 1]]
    shift = rigid_poses(np.eye(3), (0.2, 0, 0))  # 90 * 0.2 / 2 m = 9 pixels to the right
    given = SEVENSCENES.read(root, options=RgbdOptions(depth_K=K, color_from_depth=shift))
    depth = given.views[0].load().depth
    assert not depth[:, :9].any()
    np.testing.assert_allclose(depth[1:, 10:], 2, rtol=1e-5)
    (root / "rgbd.json").write_text(
        json.dumps({"depth_K": K, "color_from_depth": shift.tolist(), "depth_unit": 5e-4})
    )
    read = SEVENSCENES.read(root, options=RgbdOptions(depth_unit=1e-3))
    np.testing.assert_array_equal(read.views[0].load().depth, depth)
    assert "options read from rgbd.json" in messages(read)
    assert "registered into the colour camera" in messages(read)


def test_wrong_options(tmp_path):
    root = sevenscenes(tmp_path)
    with pytest.raises(OptionError, match=r"rgbd\.depth_unit -1; expected more than 0"):
        RgbdOptions(depth_unit=-1)
    with pytest.raises(OptionError, match="without depth_K"):
        SEVENSCENES.read(root, options=RgbdOptions(color_from_depth=np.eye(4)))
    with pytest.raises(ShapeError, match="no rotation"):
        SEVENSCENES.read(
            root, options=RgbdOptions(depth_K=np.eye(3), color_from_depth=np.diag([2, 2, 2, 1]))
        )
    (root / "rgbd.json").write_text('{"depth_units": 0.001}')
    with pytest.raises(OptionError, match=r"did you mean 'rgbd\.depth_unit'"):
        SEVENSCENES.read(root)
    (root / "rgbd.json").write_text("{")
    with pytest.raises(OptionError, match=r"rgbd\.json: no readable JSON"):
        SEVENSCENES.read(root)


@pytest.mark.parametrize(("layout", "write"), [(SEVENSCENES, sevenscenes), (SCANNET, scannet)])
@pytest.mark.parametrize("times", [0.5, 2, 2.02])  # ScanNet's pictures are 1296x968, maps 640x480
def test_intrinsics_of_another_size_are_scaled_and_said(tmp_path, layout, write, times):
    root = write(tmp_path / "recording")
    before = layout.read(root)
    for path in [*root.glob("camera-intrinsics.txt"), *root.glob("intrinsic/intrinsic_*.txt")]:
        K = np.loadtxt(path)
        K[:2, 2] += 0.5
        K[:2] *= times
        K[:2, 2] -= 0.5
        np.savetxt(path, K)
    scene = layout.read(root)
    np.testing.assert_allclose(scene.cameras.K, before.cameras.K, rtol=5e-3)
    assert f"the middle of pictures {times:g}"[:-1] in messages(scene)
    depths = [x.views[0].load().depth for x in (scene, before)]
    np.testing.assert_allclose(*depths, atol=0.01)


# --- TUM --------------------------------------------------------------------------------------


def test_tum_association_scale_and_poses(tmp_path):
    scene = TUM.read(tum(tmp_path / "rgbd_dataset_freiburg3_x"))
    assert len(scene) == 3
    line = "1 of 4 frames have no pose within 0.02 s (the nearest is "
    assert line in messages(scene)
    assert all(view.has_depth for view in scene)
    np.testing.assert_allclose(scene.views[0].load().depth, 2.0, rtol=1e-6)  # 10000 / 5000
    np.testing.assert_allclose(scene.cameras.world_from_cam[0], pose_matrix(0.3), atol=1e-8)
    np.testing.assert_allclose(
        scene.cameras.K[0], [[535.4, 0, 320.6], [0, 539.2, 248.1], [0, 0, 1]]
    )


def test_tum_intrinsics_by_file_by_name_or_by_default(tmp_path):
    named = TUM.read(tum(tmp_path / "rgbd_dataset_freiburg1_desk"))
    assert "published for freiburg1" in messages(named)
    assert "FULL_OPENCV 640x480 undistorted" in messages(named)
    plain = TUM.read(tum(tmp_path / "office"))
    np.testing.assert_allclose(plain.cameras.K[0, :2, 2], [320, 240])
    assert "driver's default" in messages(plain)
    flat = {"fx": 500, "fy": 501, "cx": 310, "cy": 230, "width": 640}
    for written in ({"intrinsic_matrix": [500, 0, 0, 0, 501, 0, 310, 230, 1]}, flat):
        (tmp_path / "office" / "camera.json").write_text(json.dumps(written))
        np.testing.assert_allclose(
            TUM.read(tmp_path / "office").cameras.K[0],
            [[500, 0, 310.5], [0, 501, 230.5], [0, 0, 1]],
        )


@pytest.mark.parametrize("text", ['{"K": 3}', "\x00"])
def test_a_damaged_camera_file_is_refused_and_two_that_differ_are(tmp_path, text):
    root = tum(tmp_path / "office")
    cut = root / "camera_primesense.json"
    cut.write_text('{"width": 640, "intrinsic_matrix": [525.0, 0')
    with pytest.raises(ProjectError, match=r"camera_primesense.json: .* expected Open3D's form"):
        TUM.read(root)
    cut.unlink()
    (root / "camera.json").write_text(text)
    with pytest.raises(ProjectError, match=r"camera.json: .* expected Open3D's form"):
        TUM.read(root)
    K = [500.0, 0, 0, 0, 500, 0, 320, 240, 1]
    (root / "camera.json").write_text(json.dumps({"intrinsic_matrix": K}), encoding="utf-16")
    given = np.array(K).reshape(3, 3).T
    np.testing.assert_allclose(TUM.read(root).cameras.K[0, :2, :2], given[:2, :2])
    np.savetxt(root / "camera-intrinsics.txt", given)
    assert len(TUM.read(root)) > 0
    np.savetxt(root / "camera-intrinsics.txt", 2 * given - np.diag([0, 0, 1]))
    with pytest.raises(ProjectError, match=r"camera-intrinsics.txt and camera.json differ"):
        TUM.read(root)


def test_tum_freiburg1_distortion_is_opencvs(tmp_path):
    scene = TUM.read(tum(tmp_path / "rgbd_dataset_freiburg1_desk"))
    (fx, fy, cx, cy), (k1, k2, p1, p2, k3) = PUBLISHED["freiburg1"]
    frame, K = scene.views[0].load(), scene.cameras.K[0]
    height, width = frame.rgb.shape[:2]
    y, x = np.mgrid[20 : height - 20 : 40, 20 : width - 20 : 40]
    u, v = (x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1]
    r2 = u * u + v * v
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    du = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    dv = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    # The picture is a ramp, so its colours tell which recorded pixel each one came from.
    recorded_x, recorded_y = fx * du + cx + 0.5, fy * dv + cy + 0.5
    np.testing.assert_allclose(frame.rgb[y, x, 0] / 255 * 640, recorded_x, atol=2.6)
    np.testing.assert_allclose(frame.rgb[y, x, 1] / 255 * 480, recorded_y, atol=2.1)


def test_tum_malformed_lists_name_the_line(tmp_path):
    root = tum(tmp_path / "sequence")
    text = (root / "groundtruth.txt").read_text()
    (root / "groundtruth.txt").write_text(text + "100.2 1 2 3 0 0 0\n")
    with pytest.raises(ProjectError, match=r"groundtruth\.txt:5: 7 numbers; expected 8"):
        TUM.read(root)
    (root / "groundtruth.txt").write_text(text.replace("0.300000000", "x", 1))
    with pytest.raises(ProjectError, match=r"groundtruth\.txt:2"):
        TUM.read(root)
    (root / "groundtruth.txt").write_text(text.replace(" 0.998750260", " 2", 1))
    with pytest.raises(ProjectError, match=r"groundtruth\.txt:2: a quaternion of length"):
        TUM.read(root)


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt"])
def test_tum_lists_of_windows_programs(tmp_path, name):
    root = tum(tmp_path / "sequence")
    text = (root / name).read_text().replace("/", "\\").replace("\n", "\r\n")
    (root / name).write_bytes(b"\xef\xbb\xbf" + text.encode())
    scene = TUM.read(root)
    assert len(scene) == 3
    assert all(view.has_depth for view in scene)


@pytest.mark.parametrize(("layout", "write"), [(TUM, tum), (REDWOOD, redwood)])
def test_a_default_camera_is_a_warning_at_every_door(tmp_path, layout, write):
    root = write(tmp_path / "recording")
    (root / "camera.json").unlink(missing_ok=True)
    scene = layout.read(root)
    assert [f.level for f in scene.findings if "driver's default" in f.message] == ["warning"]
    width, height = int(scene.cameras.width[0]), int(scene.cameras.height[0])
    focal = 525 * width / 640
    middle = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    np.testing.assert_allclose(scene.cameras.K[0], middle)
    middle[0][2], middle[1][1], middle[1][2] = (width - 1) / 2, 91, (height - 1) / 2
    np.savetxt(root / "camera-intrinsics.txt", middle)
    scene = layout.read(root)
    assert scene.cameras.K[0, 1, 1] == 91
    assert "intrinsics: camera-intrinsics.txt" in messages(scene)


# --- Redwood ----------------------------------------------------------------------------------


def test_redwood_pairs_poses_and_column_major_intrinsics(tmp_path):
    scene = REDWOOD.read(redwood(tmp_path))
    assert len(scene) == 3
    assert all(view.has_depth for view in scene)
    np.testing.assert_allclose(scene.cameras.K[0], [[91, 0, 48], [0, 92, 36], [0, 0, 1]])
    np.testing.assert_allclose(scene.cameras.world_from_cam[2], pose_matrix(0.2), atol=1e-8)
    assert "poses are read from trajectory.log, not odometry.log" in messages(scene)


def test_redwood_pose_numbers_choose_the_picture(tmp_path):
    scene = REDWOOD.read(redwood(tmp_path, numbers=(2, 0)))
    assert scene.names == ("00001-000077.jpg", "00003-000277.jpg")
    np.testing.assert_allclose(scene.cameras.world_from_cam[1], pose_matrix(0.2), atol=1e-8)
    assert "1 of 3 frames have no pose: dropped (00002-000177.jpg)" in messages(scene)


@pytest.mark.parametrize(
    ("file", "form"), [("poses.npy", (4, 4)), ("poses.npy", (3, 4)), ("traj.txt", (16,))]
)
def test_poses_of_all_pictures_in_one_file(tmp_path, file, form):
    root = redwood(tmp_path / "recording")
    before = REDWOOD.read(root)
    for path in root.glob("*.log"):
        path.unlink()
    poses = np.array([np.delete(pose, 3, 0) for pose in before.cameras.world_from_cam])
    whole = before.cameras.world_from_cam
    rows = {(4, 4): whole, (3, 4): poses, (16,): whole.reshape(3, 16)}[form]
    (np.save if file.endswith(".npy") else np.savetxt)(root / file, rows)
    scene = open_project(root)
    np.testing.assert_allclose(scene.cameras.cam_from_world, before.cameras.cam_from_world)
    assert f"poses: {file}" in messages(scene)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".tiff", ".pfm"])
def test_depth_of_other_files_is_in_metres_where_it_holds_fractions(tmp_path, suffix):
    root = scannet(tmp_path / "scan")
    before = SCANNET.read(root).views[0].load()
    for path in sorted(root.glob("depth/*.png")):
        metres = read_depth(path, unit=0.001)
        path.unlink()
        other = path.with_suffix(suffix)
        if suffix == ".pfm":
            head = b"Pf\n%d %d\n-1\n" % metres.shape[::-1]
            other.write_bytes(head + metres[::-1].astype("<f4").tobytes())
        elif suffix == ".tiff":
            Image.fromarray(metres).save(other)
        else:
            np.save(other, metres) if suffix == ".npy" else np.savez(other, depth=metres)
    for path in sorted(root.glob("pose/*.txt")):  # a matrix each
        np.save(path.with_suffix(".npy"), np.loadtxt(path))
        path.unlink()
    for path in sorted(root.glob("color/*.jpg")):
        with Image.open(path) as picture:
            picture.save(path.with_suffix(".webp"), lossless=True)
        path.unlink()
    frame = SCANNET.read(root).views[0].load()
    np.testing.assert_array_equal(frame.rgb, before.rgb)
    np.testing.assert_allclose(frame.depth, before.depth)


def replica(root):
    """As NICE-SLAM publishes it, its cameras in the folder above."""
    for i in range(3):
        save(root / f"results/frame{i:06d}.jpg", ramp())
        save(root / f"results/depth{i:06d}.png", np.full((HEIGHT, WIDTH), 13107, np.uint16))
    np.savetxt(root / "traj.txt", [pose_matrix(i / 10).ravel() for i in range(3)])
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 91, "fy": 92, "cx": 47.5, "cy": 35.5, "scale": 6553.5}
    (root.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))


def rtabmap(root):
    """Pictures by ID, of which the second has no pose, and the fourth pose no picture."""
    rows = ["#timestamp x y z qx qy qz qw id"]
    for i in range(4):
        x, y, z = pose_matrix(i / 10)[:3, 3]
        turn = Rotation.from_matrix(pose_matrix(i / 10)[:3, :3]).as_quat()
        rows += [" ".join(map(str, [100 + i, x, y, z, *turn, i + 8]))] if i != 1 else []
        if i < 3:
            save(root / f"flat_rgb/{i + 8}.jpg", ramp())
            save(root / f"flat_depth/{i + 8}.png", np.full((HEIGHT, WIDTH), 2000, np.uint16))
            (root / "flat_calib").mkdir(exist_ok=True)
            (root / f"flat_calib/{i + 8}.yaml").write_text(
                f"%YAML:1.0\n---\nimage_width: {WIDTH}\nimage_height: {HEIGHT}\ncamera_matrix:\n"
                f"   data: [ {91 + i}, 0., 47.5, 0., 92, 35.5, 0., 0., 1. ]\n"
                "distortion_coefficients:\n   data: [ 0., 0., 0., 0., 0. ]\n"
            )
    (root / "flat_camera_poses.txt").write_text("\n".join(rows))


def test_neural_rgbd_has_poses_of_opengl_and_nan_where_tracking_was_lost(tmp_path):
    root = redwood(tmp_path / "recording")
    before = REDWOOD.read(root).cameras.world_from_cam
    for path in root.glob("*.log"):
        path.unlink()
    poses = before @ np.diag([1.0, -1, -1, 1])
    poses[1] = np.nan
    np.savetxt(root / "poses.txt", poses.reshape(-1, 4))
    (root / "focal.txt").write_text("91.5")
    scene = open_project(root)
    np.testing.assert_allclose(scene.cameras.world_from_cam, before[[0, 2]], atol=1e-9)
    np.testing.assert_allclose(scene.cameras.K[0, :2, 2], [WIDTH / 2 + 0.5, HEIGHT / 2 + 0.5])
    assert scene.cameras.K[0, 0, 0] == 91.5 and "NaN in their pose" in messages(scene)


def bundlefusion(root):
    """As 7-Scenes, with the sensor's own head."""
    sevenscenes(root)
    (root / "camera-intrinsics.txt").unlink()
    K = np.array([[91, 0, 47.5, 0], [0, 92, 35.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    numbers = " ".join(map(str, K.ravel()))
    (root / "info.txt").write_text(f"m_calibrationColorIntrinsic = {numbers}\n")


@pytest.mark.parametrize("write", [replica, rtabmap, bundlefusion])
def test_layouts_of_other_scanners(tmp_path, write):
    root = tmp_path / "scan"
    root.mkdir()
    write(root)
    scene = open_project(root)
    assert "the PrimeSense driver's default" not in messages(scene)
    np.testing.assert_allclose(scene.cameras.K[0], [[91, 0, 48], [0, 92, 36], [0, 0, 1]])
    frame = scene.views[-1].load()
    np.testing.assert_allclose(np.median(frame.depth), 2, rtol=1e-4)
    if write is rtabmap:
        assert scene.names == ("8.jpg", "10.jpg")
        assert scene.cameras.K[1, 0, 0] == 93
    if write is not bundlefusion:
        np.testing.assert_allclose(
            np.linalg.inv(scene.cameras.cam_from_world[-1]), pose_matrix(0.2), atol=1e-6
        )


def test_intrinsics_that_are_given_win_over_each_pictures_own(tmp_path):
    rtabmap(tmp_path)
    own = open_project(tmp_path)
    assert "each picture's own" in messages(own)
    K = [[80, 0, 47.5], [0, 80, 35.5], [0, 0, 1]]
    (tmp_path / "rgbd.json").write_text(json.dumps({"color_K": K}))
    given = open_project(tmp_path)
    assert given.cameras.K[:, 0, 0].tolist() == [80, 80]
    assert "each picture's own" not in messages(given)
    # Their distortion stays that of the files.
    for path in tmp_path.glob("flat_calib/*.yaml"):
        path.write_text(
            path.read_text().replace("[ 0., 0., 0., 0., 0. ]", "[ 0.3, 0., 0., 0., 0. ]")
        )
    K = [[91, 0, 47.5], [0, 92, 35.5], [0, 0, 1]]  # of the first picture
    (tmp_path / "rgbd.json").write_text(json.dumps({"color_K": K}))
    bent = open_project(tmp_path).views[0].load().rgb
    (tmp_path / "rgbd.json").unlink()
    np.testing.assert_array_equal(bent, open_project(tmp_path).views[0].load().rgb)
    assert not np.array_equal(bent, given.views[0].load().rgb)


def test_rtabmap_pictures_named_by_time(tmp_path):
    rtabmap(tmp_path)
    for folder in ("flat_rgb", "flat_depth", "flat_calib"):
        for path in list((tmp_path / folder).iterdir()):
            path.rename(path.with_name(f"{int(path.stem) + 92}.000000{path.suffix}"))
    scene = open_project(tmp_path)
    assert scene.names == ("100.000000.jpg", "102.000000.jpg")
    assert scene.cameras.K[1, 0, 0] == 93


def test_redwood_trajectory_that_does_not_fit(tmp_path):
    root = redwood(tmp_path)
    text = (root / "trajectory.log").read_text()
    (root / "trajectory.log").write_text(text.replace("2 2 3", "9 9 9").replace("1 1 2", "0 0 0"))
    assert len(REDWOOD.read(root)) == 3  # one pose a picture, whatever the numbers
    (root / "trajectory.log").write_text("\n".join(text.splitlines()[:13]))
    with pytest.raises(ProjectError, match=r"trajectory\.log: .*expected blocks of three"):
        REDWOOD.read(root)
    for wrong in (text.replace("1 1 2", "nan 1 2"), text.replace("1 1 2", "1 2")):
        (root / "trajectory.log").write_text(wrong)
        with pytest.raises(ProjectError, match=r"trajectory\.log: .*expected blocks of three"):
            REDWOOD.read(root)
    (root / "trajectory.log").write_text(text.split("1 1 2")[0].replace("0 0 1", "7 7 8"))
    with pytest.raises(ProjectError, match="1 poses numbered 7 for 3 pictures"):
        REDWOOD.read(root)


# --- ScanNet ----------------------------------------------------------------------------------


def test_scannet_registers_depth_into_the_larger_picture_and_drops_lost_frames(tmp_path):
    scene = SCANNET.read(scannet(tmp_path))
    assert scene.names == ("0.jpg", "2.jpg", "10.jpg")
    assert "1 of 4 frames were lost by the tracker: dropped (1.jpg)" in messages(scene)
    depth = scene.views[0].load().depth
    assert depth.shape == (144, 192)
    np.testing.assert_allclose(depth[4:], 2, rtol=1e-5)  # no pinholes at twice the resolution
    assert (depth[:2, :4] == 0).all()


def test_scannet_moved_depth_camera_is_pointed_out(tmp_path):
    root = scannet(tmp_path)
    moved = rigid_poses(np.eye(3), (0.1, 0, 0))
    np.savetxt(root / "intrinsic/extrinsic_color.txt", moved)
    scene = SCANNET.read(root)
    assert "camera-from-rig" in messages(scene)
    depth = scene.views[0].load().depth  # 180 * 0.1 / 2 m = 9 pixels
    assert not depth[:, :9].any()
    assert depth[10:, 10:].all()
