# mypy: no-check-untyped-defs
from __future__ import annotations

import numpy as np
import pytest
from scenes_workspace import HEIGHT, LENSES, WIDTH, ramp, save, workspace

from gvtools.errors import ProjectError
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.colmap_model import _image_end
from gvtools.scenes.images import write_depth_map
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
        (folder / "images.bin").write_bytes(count + data[_image_end(data, 8) :])
    with pytest.raises(Exception, match="does not exist"):
        pycolmap.Reconstruction(folder)
    scene = read_colmap(tmp_path)
    assert len(scene) == reconstruction.num_images() - 1
    said = [found.message for found in scene.findings if found.level == "warning"]
    assert any("40 track elements name images that the model does not hold" in s for s in said)
    assert len(scene.points.positions) == 40 and reprojection_errors(scene).max() < 1e-3
