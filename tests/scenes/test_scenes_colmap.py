from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from scenes_workspace import HEIGHT, LENSES, WIDTH, ramp, save, workspace

from gvtools.cameras import Cameras
from gvtools.errors import GvError, ProjectError
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.colmap_model import _record_end
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.images import read_depth, stored_depth_size, write_depth_map
from gvtools.scenes.inspection import reprojection_errors
from gvtools.scenes.project import open_as, open_project

UNTOUCHED = ("SIMPLE_PINHOLE", "PINHOLE")


@pytest.mark.parametrize("model", sorted(LENSES))
def test_every_perspective_model_reprojects_its_own_points(tmp_path, model):
    reconstruction = workspace(tmp_path, model)
    scene = read_colmap(tmp_path)
    # pycolmap made the detections with the distorted camera; our pinhole must hit them exactly.
    errors = reprojection_errors(scene)
    assert len(errors) == reconstruction.compute_num_observations() > 100
    assert errors.max() < 1e-3
    camera, frame = scene.cameras, scene.views[0].load()
    assert frame.rgb.shape == (camera.height[0], camera.width[0], 3)
    untouched = model in UNTOUCHED
    assert any("undistorted" in finding.message for finding in scene.findings) != untouched
    if untouched:
        np.testing.assert_array_equal(frame.rgb, ramp())
        np.testing.assert_array_equal(
            camera.K[0], next(iter(reconstruction.cameras.values())).calibration_matrix()
        )


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("classic", [False, True])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "model"])
def test_places_and_forms_give_one_scene(tmp_path, text, classic, place):
    reconstruction = workspace(tmp_path, text=text, classic=classic, place=place)
    scene = read_colmap(tmp_path / place if place == "model" else tmp_path)
    assert read_colmap(tmp_path / place).names == scene.names
    assert scene.kind == "colmap"
    assert not scene.metric
    for view in scene:
        image = reconstruction.find_image_with_name(view.name)
        np.testing.assert_allclose(
            view.camera.cam_from_world[0, :3], image.cam_from_world().matrix(), atol=1e-12
        )
    assert reprojection_errors(scene).max() < 1e-3


def test_rig_with_several_cameras_composes_sensor_and_rig(tmp_path):
    reconstruction = workspace(tmp_path, num_rigs=2, num_cameras_per_rig=2)
    scene = read_colmap(tmp_path)
    assert len(scene) == reconstruction.num_images() == 16
    assert reprojection_errors(scene).max() < 1e-3


def test_images_in_subfolders_and_natural_order(tmp_path):
    reconstruction = workspace(tmp_path)
    names = ["b/img10.png", "b/img9.png", "a/img2.png", "a/img 11.png"]
    for image, name in zip(reconstruction.images.values(), names, strict=True):
        (tmp_path / "images" / image.name).rename(save(tmp_path / "images" / name, ramp()))
        image.name = name
    reconstruction.write_binary(tmp_path / "sparse" / "0")
    binary = read_colmap(tmp_path)
    assert binary.names == ("a/img2.png", "a/img 11.png", "b/img9.png", "b/img10.png")
    # A reader of text models that stops at the first blank would take "a/img" for a name.
    (tmp_path / "text").mkdir()
    reconstruction.write_text(tmp_path / "text")
    text = read_colmap(tmp_path / "text")
    assert text.names == binary.names
    np.testing.assert_allclose(text.cameras.centers, binary.cameras.centers, atol=1e-12)


def test_unused_cameras_absent_and_unregistered_images_are_reported(tmp_path):
    import pycolmap

    reconstruction = workspace(tmp_path)
    spare = pycolmap.Camera(model="PINHOLE", width=5, height=5, params=[5.0, 5, 2, 2], camera_id=77)
    reconstruction.add_camera_with_trivial_rig(spare)
    reconstruction.write_binary(tmp_path / "sparse" / "0")
    (tmp_path / "images" / sorted(i.name for i in reconstruction.images.values())[1]).unlink()
    save(tmp_path / "images" / "extra" / "other.JPG", ramp())
    scene = read_colmap(tmp_path)
    assert len(scene) == 3
    messages = " | ".join(finding.message for finding in scene.findings)
    assert "1 cameras of the model are used by no image" in messages
    assert "1 of 4 frames have no picture: dropped" in messages
    assert "3 of 4 pictures registered" in messages
    assert "40 track elements belong to views that are not read" in messages
    assert reprojection_errors(scene).max() < 1e-3


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE", "FOV"])
def test_mask_and_depth_go_through_the_mapping_of_the_image(tmp_path, model):
    reconstruction = workspace(tmp_path, model)
    image = next(iter(reconstruction.images.values()))
    # Depth and mask repeat what the picture shows, so that after undistortion all must agree.
    depth = ramp()[..., 0].astype(np.float32) + 1
    write_depth_map(tmp_path / "stereo/depth_maps" / f"{image.name}.photometric.bin", depth + 50)
    write_depth_map(tmp_path / "stereo/depth_maps" / f"{image.name}.geometric.bin", depth)
    save(
        tmp_path / "masks" / f"{image.name}.png",
        np.where(ramp()[..., 1] > 127, 255, 0).astype("u1"),
    )
    scene = read_colmap(tmp_path)
    view = scene[image.name]
    frame = view.load()
    assert view.has_depth
    assert sum(other.has_depth for other in scene) == 1
    assert frame.depth is not None
    assert frame.mask is not None
    step = 255 / WIDTH
    assert np.abs(frame.depth - 1 - frame.rgb[..., 0]).max() <= step + 1
    sure = np.abs(frame.rgb[..., 1].astype(int) - 127) > 255 / HEIGHT + 1
    np.testing.assert_array_equal(frame.mask[sure], frame.rgb[..., 1][sure] > 127)
    messages = " | ".join(finding.message for finding in scene.findings)
    assert "depth maps: 1 geometric" in messages
    assert "3 of 4 frames have no mask" in messages


def test_masks_and_images_may_be_given(tmp_path):
    reconstruction = workspace(tmp_path / "project", "PINHOLE")
    name = next(iter(reconstruction.images.values())).name
    (tmp_path / "project" / "images").rename(tmp_path / "pictures")
    save(tmp_path / "ignore" / f"{name}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    (tmp_path / "project/stereo/depth_maps").mkdir(parents=True)
    np.save(tmp_path / f"project/stereo/depth_maps/{name}.npy", np.full((HEIGHT, WIDTH), 2.5))
    with pytest.raises(ProjectError, match="without images"):
        read_colmap(tmp_path / "project")
    scene = read_colmap(
        tmp_path / "project", images=tmp_path / "pictures", masks=tmp_path / "ignore"
    )
    frame = scene[name].load()
    assert not frame.mask.any()
    assert (frame.depth == 2.5).all()


def test_fisheye_without_coefficients_is_still_undistorted(tmp_path):
    # pycolmap calls such a camera undistorted, but its projection is no pinhole's.
    workspace(tmp_path, "OPENCV_FISHEYE", camera_params=[60.0, 60, 48, 36, 0, 0, 0, 0])
    scene = read_colmap(tmp_path)
    assert any("OPENCV_FISHEYE 96x72 undistorted" in f.message for f in scene.findings)
    assert reprojection_errors(scene).max() < 1e-3


def test_the_largest_model_is_read_and_any_other_can_be_chosen(tmp_path):
    small = workspace(tmp_path)
    (tmp_path / "sparse/0").rename(tmp_path / "sparse/1")
    image = next(iter(small.images.values()))
    small.deregister_frame(image.frame_id)
    (tmp_path / "sparse/0").mkdir()
    small.write_binary(tmp_path / "sparse/0")
    largest = read_colmap(tmp_path)
    assert len(largest) == 4
    assert any("model 1 is read" in finding.message for finding in largest.findings)
    assert image.name not in open_project(tmp_path, model=0).names
    assert open_as(tmp_path, {"model": 0}).names == open_project(tmp_path, model=0).names
    with pytest.raises(ProjectError, match="no COLMAP model of number 7; it holds 0, 1"):
        open_project(tmp_path, model=7)


def test_picture_of_another_size_is_an_error_finding_and_raises_when_loaded(tmp_path):
    workspace(tmp_path)
    scene = read_colmap(tmp_path)
    path = scene.views[1].files[0]
    save(path, ramp(50, 40))
    scene = read_colmap(tmp_path)
    assert [f.level for f in scene.findings if "50x40" in f.message] == ["error"]
    with pytest.raises(ProjectError, match="50x40 pixels; its camera expects 96x72"):
        scene.views[1].load()


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV_FISHEYE"])
def test_smaller_pictures_of_the_same_aspect_scale_their_cameras_and_detections(tmp_path, model):
    workspace(tmp_path, model)
    whole = read_colmap(tmp_path)
    for path in (tmp_path / "images").iterdir():
        save(path, ramp(WIDTH // 2, HEIGHT // 2))
    scene = read_colmap(tmp_path)
    np.testing.assert_allclose(scene.cameras.K[:, 0, 0], whole.cameras.K[:, 0, 0] / 2, rtol=0.05)
    assert reprojection_errors(scene).max() < 1e-3
    line = f"{len(scene)} pictures of 48x36 for cameras of 96x72: intrinsics scaled"
    assert line in [finding.message for finding in scene.findings]


@pytest.mark.parametrize(("focal", "scale"), [(90, 1), (95, 1), (90, 2)])
def test_a_text_model_that_contradicts_the_binary_one_beside_it_is_said(tmp_path, focal, scale):
    import pycolmap

    reconstruction = workspace(tmp_path, "PINHOLE")
    for camera in reconstruction.cameras.values():
        camera.focal_length_x = focal
    reconstruction.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.zeros(3)))
    reconstruction.write_text(tmp_path / "sparse/0")
    for frame in sorted(reconstruction.frames)[:scale]:
        reconstruction.deregister_frame(frame)
    (tmp_path / "sparse_txt").mkdir()
    reconstruction.write_text(tmp_path / "sparse_txt")
    said = [found.message for found in read_colmap(tmp_path).findings]
    line = "cameras.bin is read, and cameras.txt beside it differs: camera 1 is PINHOLE [96.0, "
    assert any(line in message for message in said) == (focal != 90)
    line = "images.bin is read, and images.txt beside it differs: image 1 is pose ["
    assert any(line in message for message in said) == (scale != 1)
    assert any(f"sparse_txt, a model of {4 - scale} images" in message for message in said)


@pytest.mark.parametrize("classic", [False, True])
@pytest.mark.parametrize("text", [False, True])
def test_tracks_that_name_pictures_taken_out(tmp_path, text, classic):
    import pycolmap

    reconstruction = workspace(tmp_path, text=text, classic=classic)
    folder = tmp_path / "sparse" / "0"
    if text:
        lines = (folder / "images.txt").read_text().splitlines()
        head = [line for line in lines if line.startswith("#")]
        (folder / "images.txt").write_text("\n".join([*head, *lines[len(head) + 2 :], ""]))
    else:
        data = (folder / "images.bin").read_bytes()
        count = (int.from_bytes(data[:8], "little") - 1).to_bytes(8, "little")
        (folder / "images.bin").write_bytes(count + data[_record_end(data, 8, "images") :])
    with pytest.raises(Exception, match="does not exist"):
        pycolmap.Reconstruction(folder)
    scene = read_colmap(tmp_path)
    assert len(scene) == reconstruction.num_images() - 1
    said = [found.message for found in scene.findings if found.level == "warning"]
    assert any("40 track elements name images that the model does not hold" in s for s in said)
    assert len(scene.points.positions) == 40 and reprojection_errors(scene).max() < 1e-3


VIEWS, POINTS = 5, 60


def one_line(error: pytest.ExceptionInfo[BaseException]) -> str:
    message = str(error.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("change", ["cut", "grown", "empty", "absurd count"])
def test_truncated_or_oversized_binary_file_is_refused(tmp_path, name, change):
    rigged = name in ("rigs", "frames")
    if rigged and change == "grown":
        return  # what follows the last record there does no harm
    workspace(tmp_path)
    path = tmp_path / "sparse/0" / f"{name}.bin"
    data = path.read_bytes()
    many = struct.pack("<Q", 2**40) + data[8:]
    changed = {"cut": data[:-5], "grown": data + b"\0" * 7, "empty": b"", "absurd count": many}
    path.write_bytes(changed[change])
    with pytest.raises(ProjectError) as error:
        read_colmap(tmp_path)
    assert rigged or name in one_line(error)
    assert change in ("cut", "grown") or "records that its head" in one_line(error)


@pytest.mark.parametrize(
    ("name", "pattern", "replacement", "told"),
    [
        ("images", r"^1 \S+ ", "1 ", "images.txt is malformed"),
        ("images", r"^1 \S+ ", "1 word ", "images.txt is malformed"),
        # A lost line: what is read as an image is a line of points.
        ("images", r"^1 .*\n", "", "damaged"),
        ("images", r"^1 ", "1e999 ", "images.txt is malformed"),
        ("cameras", r"^1 SIMPLE_RADIAL 96 72", "1 SIMPLE_RADIAL 96", "as many parameters"),
        ("cameras", r"SIMPLE_RADIAL", "SIMPEL_RADIAL", "Camera model does not exist"),
        ("cameras", r" -0\.1\S+", "", "as many parameters"),
        ("points3D", r"^1 \S+ \S+ \S+ .*$", "1 2 3", "3 values; expected id"),
        # One number less: pycolmap would read the others shifted.
        ("points3D", r"^1 \S+ ", "1 ", "values; expected id"),
    ],
)
def test_malformed_text_model_names_the_file(tmp_path, name, pattern, replacement, told):
    workspace(tmp_path, text=True, classic=True)
    path = tmp_path / "sparse/0" / f"{name}.txt"
    text, count = re.subn(pattern, replacement, path.read_text(), count=1, flags=re.MULTILINE)
    assert count == 1
    path.write_text(text)
    with pytest.raises(ProjectError, match=told) as error:
        read_colmap(tmp_path)
    one_line(error)


@pytest.mark.parametrize("count", [4, 5])
def test_text_model_without_point_lines_does_not_lose_every_second_image(tmp_path, count):
    workspace(tmp_path, text=True, classic=True)
    path = tmp_path / "sparse/0/images.txt"
    lines = [line for line in path.read_text().splitlines() if line.endswith(".png")]
    path.write_text("\n".join((lines * 2)[:count]) + "\n")
    (path.parent / "points3D.txt").write_text("")
    with pytest.raises(ProjectError, match="two lines"):
        read_colmap(tmp_path)


def test_points_cut_off_at_a_line_end_are_noticed(tmp_path):
    workspace(tmp_path, text=True)
    path = tmp_path / "sparse/0/points3D.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-3]))
    with pytest.raises(ProjectError, match="points that points3D does not hold"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("name", "offset", "value", "told"),
    [
        ("points3D", 8 + 8, np.inf, "1 sparse points hold NaN or infinity: dropped"),
        ("images", 8 + 4 + 4 * 8, np.nan, "1 of 4 images have NaN, .*: dropped"),  # tx of the first
        ("cameras", 8 + 24, np.nan, r"camera 1: SIMPLE_RADIAL 96x72 .* NaN|as many parameters"),
    ],
)
@pytest.mark.parametrize("text", [False, True])
def test_numbers_that_are_not_finite(tmp_path, name, offset, value, told, text):
    workspace(tmp_path, classic=True, text=text)
    path = tmp_path / f"sparse/0/{name}.{'txt' if text else 'bin'}"
    if text:
        lines = path.read_text().splitlines()
        row = next(i for i, line in enumerate(lines) if not line.startswith("#"))
        words = lines[row].split()
        words[{"points3D": 1, "images": 5, "cameras": 4}[name]] = str(value)
        path.write_text("\n".join([*lines[:row], " ".join(words), *lines[row + 1 :], ""]))
    else:
        data = bytearray(path.read_bytes())
        struct.pack_into("<d", data, offset, value)
        path.write_bytes(data)
    if name == "cameras":
        with pytest.raises(GvError, match=told):
            read_colmap(tmp_path)
        return
    scene = read_colmap(tmp_path)
    assert len(scene) == (3 if name == "images" else 4)
    assert any(re.match(told, finding.message) for finding in scene.findings)
    assert np.nanmax(reprojection_errors(scene)) < 1


@pytest.mark.parametrize("classic", [False, True])
@pytest.mark.parametrize(("stretch", "told"), [(2.0, "no rotation"), (1.0005, None)])
def test_quaternion_of_another_length(tmp_path, classic, stretch, told):
    reconstruction = workspace(tmp_path, classic=classic)
    pose = reconstruction.images[1].cam_from_world()
    stored = pose.rotation.quat[[3, 0, 1, 2]]  # pycolmap has x, y, z, w
    path = tmp_path / "sparse/0" / ("images.bin" if classic else "frames.bin")
    data = path.read_bytes()
    assert struct.pack("<4d", *stored) in data
    path.write_bytes(
        data.replace(struct.pack("<4d", *stored), struct.pack("<4d", *stretch * stored))
    )
    if told:
        with pytest.raises(GvError, match=told):
            read_colmap(tmp_path)
        return
    scene = read_colmap(tmp_path)
    assert any("1 of 4 rotations made orthonormal" in item.message for item in scene.findings)
    camera = scene[reconstruction.images[1].name].camera
    np.testing.assert_allclose(camera.cam_from_world[0, :3], pose.matrix(), atol=1e-9)


def test_no_model_no_image_and_half_a_model(tmp_path):
    import pycolmap

    with pytest.raises(ProjectError, match="no COLMAP model"):
        read_colmap(tmp_path)
    (tmp_path / "empty").mkdir()
    pycolmap.Reconstruction().write_binary(tmp_path / "empty")
    with pytest.raises(ProjectError, match="no registered image among 0"):
        read_colmap(tmp_path / "empty")
    workspace(tmp_path)
    (tmp_path / "sparse/0/frames.bin").unlink()
    with pytest.raises(ProjectError, match=r"rigs\.bin without frames\.bin"):
        read_colmap(tmp_path)
    (tmp_path / "sparse/0/points3D.bin").unlink()
    with pytest.raises(ProjectError, match="incomplete model"):
        read_colmap(tmp_path)


def test_depth_map_round_trip_is_what_pycolmap_reads(tmp_path):
    import pycolmap

    depth = np.random.default_rng(0).uniform(0.5, 9, (7, 11)).astype(np.float32)
    write_depth_map(tmp_path / "deep" / "a.bin", depth)
    peer = pycolmap.DepthMap()
    peer.read(tmp_path / "deep" / "a.bin")
    np.testing.assert_array_equal(peer.to_array(), depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "deep" / "a.bin"), depth)
    assert stored_depth_size(tmp_path / "deep" / "a.bin") == (11, 7)
    pycolmap.DepthMap.from_array(depth, 0, 10).write(tmp_path / "b.bin")
    np.testing.assert_array_equal(read_depth(tmp_path / "b.bin"), depth)


def test_depth_map_without_readings_and_damaged_ones(tmp_path):
    path = tmp_path / "a.bin"
    write_depth_map(path, [[1, -1, np.nan, np.inf, 0]])
    np.testing.assert_array_equal(read_depth(path), [[1, 0, 0, 0, 0]])
    data = path.read_bytes()
    for damaged in (data[:-1], data + b"\0", b"9999999&9999999&1&", b"nothing", b""):
        path.write_bytes(damaged)
        with pytest.raises(ProjectError) as error:
            read_depth(path)
        assert "a.bin" in one_line(error)


def cameras(names=()):
    K = np.repeat(np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])[None], VIEWS, axis=0)
    K[3, 0, 0] = 400
    pose = np.repeat(np.eye(4)[None], VIEWS, axis=0)
    pose[:, 0, 3] = np.arange(VIEWS) * 0.1
    return Cameras.alike(K, pose, size=(640, 480), names=tuple(names))


def tracks(scene):
    rng = np.random.default_rng(1)
    positions = rng.uniform(-1, 1, (POINTS, 3)) + np.array([0, 0, 4])
    colors = rng.integers(0, 256, (POINTS, 3), dtype=np.uint8)
    xy, _ = scene.project(positions)
    view, point = np.nonzero(rng.random((VIEWS, POINTS)) < 0.7)
    shuffled = rng.permutation(len(view))
    view, point = view[shuffled], point[shuffled]
    return {
        "points": positions,
        "colors": colors,
        "point_index": point,
        "view_index": view,
        "xy": xy[view, point],
    }


def test_pycolmap_reads_back_what_was_written(tmp_path):
    import pycolmap

    written = cameras([f"dir/im{i}.png" for i in range(VIEWS)])
    data = tracks(written)
    write_colmap(tmp_path / "sparse" / "0", written, **data)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert len(model.cameras) == 2
    assert model.num_reg_images() == VIEWS
    for i in range(VIEWS):
        image = model.images[i + 1]
        assert image.name == written.names[i]
        np.testing.assert_allclose(
            image.cam_from_world().matrix(), written.cam_from_world[i, :3], atol=1e-14
        )
        np.testing.assert_allclose(image.camera.calibration_matrix(), written.K[i], atol=1e-12)
    seen = {
        (point - 1, element.image_id - 1): tuple(
            model.images[element.image_id].points2D[element.point2D_idx].xy
        )
        for point in model.points3D
        for element in model.points3D[point].track.elements
    }
    expected = {
        (int(p), int(v)): tuple(xy)
        for p, v, xy in zip(data["point_index"], data["view_index"], data["xy"], strict=True)
    }
    assert seen.keys() == expected.keys()
    for key, xy in expected.items():
        np.testing.assert_allclose(seen[key], xy, atol=1e-9)
    for i in range(POINTS):
        np.testing.assert_allclose(model.points3D[i + 1].xyz, data["points"][i], atol=1e-12)
        np.testing.assert_array_equal(model.points3D[i + 1].color, data["colors"][i])
    assert model.compute_mean_reprojection_error() < 1e-9


def test_full_disk_leaves_the_earlier_model(tmp_path, monkeypatch):
    import pycolmap

    data = tracks(cameras())
    write_colmap(tmp_path, cameras(), **data)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    real = pycolmap.Reconstruction.write_binary

    def short(self, folder):
        real(self, folder)
        with (Path(folder) / "images.bin").open("r+b") as file:
            file.truncate(100)

    monkeypatch.setattr(pycolmap.Reconstruction, "write_binary", short)
    with pytest.raises(ProjectError, match=r"images\.bin"):
        write_colmap(tmp_path, cameras(), **data)
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
