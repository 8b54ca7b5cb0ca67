# mypy: no-check-untyped-defs
from __future__ import annotations

import json
import math
import reprlib
from typing import Any

import numpy as np
import pytest
from scenes_workspace import (
    HEIGHT,
    PINHOLE,
    WIDTH,
    frame,
    messages,
    pose_matrix,
    ramp,
    save,
    transforms,
)

from gvtools.cameras import Cameras
from gvtools.errors import GvError, ProjectError
from gvtools.scenes.project import open_project
from gvtools.scenes.selection import select
from gvtools.scenes.transforms import read_transforms, read_transforms_cameras, write_transforms
from pipelines.cli import main


def test_opengl_axes_names_and_order(tmp_path):
    for name in ("img10.png", "img9.png"):
        save(tmp_path / "images" / name, ramp())
    frames = [frame("./images/img10.png", 1.0), frame("images/img9.png", 0.5)]
    scene = read_transforms(transforms(tmp_path, frames, **PINHOLE))
    assert scene.names == ("img9.png", "img10.png")
    np.testing.assert_allclose(scene.cameras.world_from_cam[1], pose_matrix(1.0), atol=1e-12)
    np.testing.assert_allclose(scene.cameras.K[0], [[90, 0, 48], [0, 91, 36], [0, 0, 1]])
    np.testing.assert_array_equal(scene.views[0].load().rgb, ramp())
    assert not scene.metric


def test_blender_files_name_no_suffix_and_give_an_angle(tmp_path):
    rgba = np.dstack([ramp(), np.full((HEIGHT, WIDTH), 255, np.uint8)])
    rgba[:10, :, 3] = 0
    save(tmp_path / "train" / "r_0.png", rgba)
    path = transforms(tmp_path, [frame("./train/r_0")], camera_angle_x=0.6)
    scene = read_transforms(path)
    assert scene.names == ("r_0.png",)
    focal = 0.5 * WIDTH / np.tan(0.3)
    np.testing.assert_allclose(
        scene.cameras.K[0], [[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]
    )
    assert scene.views[0].load().mask.sum() == (HEIGHT - 10) * WIDTH
    assert "alpha channel: read as a mask" in messages(scene)


@pytest.mark.parametrize(
    ("keys", "model"),
    [
        ({"k1": 0.05, "k2": -0.07, "p1": 0.002, "p2": -0.002}, "OPENCV"),
        ({"k1": 0.05, "k3": 0.01, "camera_model": "OPENCV"}, "FULL_OPENCV"),
        ({"k1": 0.02, "k4": 0.001, "camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"k1": 0.02, "is_fisheye": True}, "OPENCV_FISHEYE"),
        ({"distortion_params": [0.05, -0.07, 0, 0, 0.002, -0.002]}, "OPENCV"),
    ],
)
def test_distortion_mask_and_depth_share_the_mapping(tmp_path, keys, model):
    save(tmp_path / "images/a.png", ramp())
    save(tmp_path / "depth/a.png", ramp()[..., 0].astype(np.uint16) * 10 + 1000)
    save(tmp_path / "masks/a.png", np.where(ramp()[..., 1] > 127, 255, 0).astype(np.uint8))
    one = frame(depth_file_path="depth/a.png", mask_path="masks/a.png")
    scene = read_transforms(
        transforms(tmp_path, [one], depth_unit_scale_factor=0.01, **PINHOLE, **keys)
    )
    assert f"{model} 96x72 undistorted" in messages(scene)
    loaded = scene.views[0].load()
    from_depth = (loaded.depth / 0.01 - 1000) / 10
    assert np.abs(from_depth - loaded.rgb[..., 0]).max() <= 255 / WIDTH + 1
    sure = np.abs(loaded.rgb[..., 1].astype(int) - 127) > 255 / HEIGHT + 1
    np.testing.assert_array_equal(loaded.mask[sure], loaded.rgb[..., 1][sure] > 127)


def test_a_file_of_frames_by_another_name_is_named(tmp_path):
    save(tmp_path / "images/a.png", ramp())
    transforms(tmp_path, [frame()], **PINHOLE).rename(tmp_path / "transforms_original.json")
    with pytest.raises(ProjectError, match=r"transforms_original.json lists frames with poses"):
        open_project(tmp_path)


def test_absent_frames_masks_and_depth_are_reported(tmp_path):
    save(tmp_path / "images/a.png", ramp())
    frames = [frame(mask_path="m.png", depth_file_path="d.png"), frame("images/b.png")]
    scene = read_transforms(transforms(tmp_path, frames, **PINHOLE))
    assert len(scene) == 1
    assert "1 of 2 frames have no picture: dropped (b.png; expected " in messages(scene)
    assert "1 of 1 frames have no mask (a.png)" in messages(scene)
    assert "1 of 1 frames have no depth map (a.png)" in messages(scene)
    (tmp_path / "images/a.png").unlink()
    with pytest.raises(ProjectError, match=r"none of 2 frames .* have no picture.* --images"):
        read_transforms(tmp_path)


@pytest.mark.parametrize(
    ("value", "said"), [(0, "take everything out"), (1, "leave everything in"), (None, "")]
)
def test_masks_that_tell_nothing_are_said(tmp_path, value, said):
    mask = np.full((HEIGHT, WIDTH), value or 0, np.uint8)
    mask[:3] = 1 if value is None else value
    for name in ("a.png", "b.png"):
        save(tmp_path / "images" / name, ramp())
        save(tmp_path / "masks" / f"{name}.png", mask)
    frames = [frame(f"images/{name}") for name in ("a.png", "b.png")]
    scene = read_transforms(transforms(tmp_path, frames, **PINHOLE), masks=tmp_path / "masks")
    assert ("masks " in messages(scene)) == bool(said) and said in messages(scene)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "expected twice as wide as high"),
        ({"k4": 0.1}, "k4 = 0.1 of a perspective camera"),
        ({"b1": 0.1}, "b1 = 0.1 of a perspective camera"),
        ({"distortion_params": [0.1]}, "at least 6 items"),
        ({"transform_matrix": [[1, 2], [3]]}, "expected a transform_matrix of 4x4 numbers"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "frame 0"),
        ({"file_path": ""}, "file_path is ''"),
    ],
)
def test_malformed_frames_say_what_and_where(tmp_path, change, told):
    save(tmp_path / "images/a.png", ramp())
    path = transforms(tmp_path, [{**frame(), **change}], **PINHOLE)
    with pytest.raises(GvError, match=told) as error:
        read_transforms(path)
    assert "transforms.json, frame 0" in str(error.value)
    assert "\n" not in str(error.value)


WRONG: dict[str, tuple[Any, ...]] = {
    "fl_x": (0, "90", True, math.nan),
    "w": (0, 96.5, "96", None, 10**30),
    "cx": ({},),
    "depth_unit_scale_factor": (0, "1", math.inf),
    "mask_path": (5, ["m.png"]),
    "is_fisheye": ("false", 2),
}


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(
    ("key", "value"),
    [(key, value) for key, values in WRONG.items() for value in values],
    ids=reprlib.repr,
)
def test_wrong_values_name_the_frame_the_key_and_the_value(tmp_path, capsys, key, value, shared):
    save(tmp_path / "images/a.png", ramp())
    save(tmp_path / "images/b.png", ramp())
    frames = [frame(), frame("images/b.png")]
    common = dict(PINHOLE)
    if shared and key not in ("mask_path", "depth_file_path"):
        common[key] = value
    else:
        frames[1][key] = value
    path = transforms(tmp_path, frames, **common)
    assert main(["check", str(path)]) == 2
    told = capsys.readouterr().err
    first = "frame 1 (b.png)" if key in frames[1] else "frame 0 (a.png)"
    assert f"transforms.json, {first}: {key} is {reprlib.repr(value)}; expected " in told
    assert told.count("\n") == 1
    assert "unexpected" not in told


def test_a_pose_and_depth_of_the_whole_file_are_no_frames_own(tmp_path):
    save(tmp_path / "images/a.png", ramp())
    one = frame(camera_angle_x=None)  # beside fl_x it is not looked at
    shared = {**PINHOLE, "depth_file_path": "images/a.png", "mask_path": "images/a.png"}
    scene = read_transforms(transforms(tmp_path, [one], **shared))
    assert not scene.views[0].has_depth and scene.views[0].load().mask is None
    pose = one.pop("transform_matrix")
    with pytest.raises(ProjectError, match="no transform_matrix"):
        read_transforms(transforms(tmp_path, [one], **shared, transform_matrix=pose))


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"frames": []}', '{"frames": [1]}', '{"w": ' + "9" * 400 + "}"]
)
def test_malformed_files(tmp_path, text):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(ProjectError, match=r"\.json: unreadable \(.+\); expected a transforms"):
        read_transforms(tmp_path)


ANGLES = {"camera_angle_x": 2 * math.atan(48 / 90), "camera_angle_y": 2 * math.atan(36 / 120)}
FOVS = {"x_fov": math.degrees(ANGLES["camera_angle_x"]), "y_fov": 33.4}
FROM_FOV = 36 / math.tan(math.radians(16.7))


@pytest.mark.parametrize(
    ("shared", "own", "expected"),
    [
        (ANGLES, {}, (90, 120)),
        ({}, ANGLES, (90, 120)),
        ({"camera_angle_y": ANGLES["camera_angle_y"]}, {}, (120, 120)),
        (FOVS, {}, (90, FROM_FOV)),
        ({"y_fov": 33.4}, {}, (FROM_FOV, FROM_FOV)),
        ({"fl_x": 100, **ANGLES}, {}, (100, 120)),  # each axis by what tells it
        ({"fl_x": 100}, {"fl_y": 120}, (100, 120)),
        # A frame's own wins, in whatever form; the pixels keep the shape that the file's have.
        ({"fl_x": 100, "fl_y": 100}, {"camera_angle_x": ANGLES["camera_angle_x"]}, (90, 90)),
        ({"fl_x": 100, "fl_y": 200}, {"camera_angle_x": ANGLES["camera_angle_x"]}, (90, 180)),
        ({"fl_x": 100, "fl_y": 200, "camera_angle_x": 1.0}, {"fl_y": 120}, (60, 120)),
    ],
)
@pytest.mark.parametrize("size", [{}, {"w": WIDTH, "h": HEIGHT}])
def test_focal_lengths_in_every_form(tmp_path, shared, own, expected, size):
    save(tmp_path / "images/a.png", ramp())
    path = transforms(tmp_path, [frame(**own)], **shared, **size)
    K = read_transforms(path).cameras.K[0]
    np.testing.assert_allclose((K[0, 0], K[1, 1]), expected)
    assert K[:2, 2].tolist() == [48, 36]


@pytest.mark.parametrize(
    ("shape", "expected", "line"),
    [
        ((48, 36), (45, 45.5, 24, 18), "the middle of pictures 2 times as large"),
        ((192, 144), (180, 182, 96, 72), "the middle of pictures 0.5 times as large"),
        ((96, 72), (90, 91, 48, 36), ""),
        ((60, 45), (56.25, 56.875, 30, 22.5), "the middle of pictures 1.6 times as large"),
        ((60, 60), (90, 91, 48, 36), "far from the middle"),
    ],
)
def test_intrinsics_without_a_size_are_of_the_size_of_their_middle(tmp_path, shape, expected, line):
    save(tmp_path / "images/a.png", ramp(*shape))
    keys = {key: PINHOLE[key] for key in ("fl_x", "fl_y", "cx", "cy")}
    scene = read_transforms(transforms(tmp_path, [frame()], **keys))
    assert scene.cameras.K[0][[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == list(expected)
    warned = [item.message for item in scene.findings if item.level == "warning"]
    assert (line in warned[0]) if line else not warned


@pytest.mark.parametrize(
    ("shared", "line"),
    [
        ({"camera_angle_x": 1.2}, "camera_angle_x says a focal length of 70.161 pixels, fl_x 90"),
        ({"y_fov": 50}, "y_fov says a focal length of 77.202 pixels, fl_y 91"),
        ({"camera_angle_x": ANGLES["camera_angle_x"]}, ""),
        ({"camera_angle_x": 1.2, "is_fisheye": True}, ""),
    ],
)
def test_focal_lengths_that_contradict_each_other_are_said(tmp_path, shared, line):
    save(tmp_path / "images/a.png", ramp())
    scene = read_transforms(transforms(tmp_path, [frame()], **PINHOLE, **shared))
    assert line in messages(scene) if line else "says a focal length" not in messages(scene)


def test_splits_are_folders_of_names_and_each_picture_is_of_one(tmp_path, capsys):
    rgba = np.dstack([ramp(), np.full((HEIGHT, WIDTH), 255, np.uint8)])
    held = {"train": "train/r_0", "test": "test/r_0", "val": "shots/r_1"}
    for split, name in held.items():
        save(tmp_path / f"{name}.png", rgba)
        frames = [frame(f"./{name}"), frame("./test/r_0")]
        data = {"camera_angle_x": 0.6, "frames": frames[: 1 + (split == "val")]}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(data))
    scene = open_project(tmp_path)
    assert scene.names == ("test/r_0.png", "train/r_0.png", "val/shots/r_1.png")
    assert select(scene.names, "train") == ("train/r_0.png",)
    assert select(scene.names, "not:train") == ("test/r_0.png", "val/shots/r_1.png")
    assert main(["check", str(tmp_path)]) == 0
    told = "splits: train (1 frames), test (1 frames), val (1 frames); select them by name: "
    assert told + "--context train --targets test" in capsys.readouterr().out
    assert len(read_transforms_cameras(tmp_path)) == 3


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"integer_depth_scale": 0.0005}, 1.0),
        ({"integer_depth_scale": 10 / 65535, "depth_unit_scale_factor": 1.0}, 2000 * 10 / 65535),
        ({}, 2.0),
    ],
)
def test_depth_as_apps_for_phones_name_it(tmp_path, keys, expected):
    save(tmp_path / "images/a.png", ramp())
    save(tmp_path / "a.depth.png", np.full((HEIGHT, WIDTH), 2000, np.uint16))
    path = transforms(tmp_path, [frame(depth_path="a.depth.png")], **PINHOLE, **keys)
    scene = read_transforms(path)
    np.testing.assert_allclose(scene.views[0].load().depth, expected, rtol=1e-6)
    assert ("0.001 a step is assumed" in messages(scene)) == (not keys)


@pytest.mark.parametrize(
    ("beside", "own", "shared", "said"),
    [
        ("m.png", {"depth": "m.png"}, {}, "depth names files that are not read"),
        ("m.png", {"mask": "m.png"}, {}, "mask names files that are not read"),
        ("", {"depth_path": "a", "depth_file_path": "b"}, {}, "differ: the second is taken"),
        ("", {}, {"camera_model": "PINHOLE", "k1": 0.1}, "camera_model PINHOLE, and yet k1"),
        ("", {}, {"test_filenames": ["a.png"]}, "test_filenames: not read; give such names"),
        ("transforms_test.json", {}, {}, "transforms_test.json beside transforms.json: not read"),
        ("images/dynamic_mask_a.png", {}, {}, "dynamic_mask_NAME.png lies beside them"),
        ("depths/a.png", {}, {}, "depth_file_path"),
        ("Mask/a.png", {}, {}, "--masks"),
        ("normals/a.png", {}, {}, ""),
    ],
)
def test_what_is_not_read_is_said(tmp_path, beside, own, shared, said):
    save(tmp_path / "images/a.png", ramp())
    if beside:
        (tmp_path / beside).parent.mkdir(exist_ok=True)
        (tmp_path / beside).write_bytes((tmp_path / "images/a.png").read_bytes())
    found = messages(read_transforms(transforms(tmp_path, [frame(**own)], **PINHOLE, **shared)))
    assert said in found and (said or "not read" not in found)


@pytest.mark.parametrize("factor", [0.5, 2])
def test_pictures_of_another_size_and_the_same_aspect_scale_their_camera(tmp_path, factor):
    small = int(WIDTH * factor), int(HEIGHT * factor)
    save(tmp_path / "images/a.png", ramp(*small))
    save(tmp_path / "m.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    scene = read_transforms(transforms(tmp_path, [frame(mask_path="m.png")], **PINHOLE))
    assert scene.cameras.K[0][0].tolist() == [90 * factor, 0, 48 * factor]
    assert scene.views[0].load().rgb.shape[1::-1] == small
    assert scene.views[0].load().mask is None or scene.views[0].load().mask.all()
    assert f"{small[0]}x{small[1]} for cameras of 96x72: intrinsics scaled" in messages(scene)


def test_no_focal_length(tmp_path):
    save(tmp_path / "images/a.png", ramp())
    with pytest.raises(ProjectError, match="no focal length; expected fl_x, "):
        read_transforms(transforms(tmp_path, [frame()], w=WIDTH, h=HEIGHT))


def test_written_file_reads_back(tmp_path):
    from scipy.spatial.transform import Rotation

    pose = np.repeat(np.eye(4)[None], 3, axis=0)
    pose[:, :3, :3] = Rotation.random(3, rng=np.random.default_rng(0)).as_matrix()
    pose[:, :3, 3] = np.random.default_rng(1).normal(size=(3, 3))
    K = np.array([[90.0, 0, 48.25], [0, 91, 36], [0, 0, 1]])
    names = ("a.png", "b.png", "c.png")
    cameras = Cameras(
        np.stack([K, K * [[2], [2], [1]], K]), pose, [96, 192, 96], [72, 144, 72], names
    )
    for i, name in enumerate(names):
        save(tmp_path / "images" / name, ramp(int(cameras.width[i]), int(cameras.height[i])))
    write_transforms(
        tmp_path / "transforms.json",
        cameras,
        image_paths=[(tmp_path / "images" / names[0]).resolve(), "images/b.png", "images/c.png"],
    )
    written = json.loads((tmp_path / "transforms.json").read_text())
    assert written["frames"][0]["file_path"] == "images/a.png"
    scene = read_transforms(tmp_path)
    np.testing.assert_allclose(scene.cameras.K, cameras.K, atol=1e-12)
    np.testing.assert_allclose(scene.cameras.cam_from_world, pose, atol=1e-12)
    assert scene.names == names
    assert not list(tmp_path.glob("*.partial"))
