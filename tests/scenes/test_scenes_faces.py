"""Panoramas and wide fisheyes as perspective views; pictures resized and undistorted."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from scenes_workspace import HEIGHT, LENSES, WIDTH, ramp

from gvtools.cameras import Cameras, rigid_poses
from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.project import open_project
from gvtools.scenes.resized import reduced, resized, seen_by
from gvtools.scenes.scene import Frame, Scene, SparsePoints, View
from gvtools.scenes.selection import check_disjoint, select
from gvtools.scenes.undistort import (
    DIRECTIONS,
    face_rotation,
    perspective_views,
    picture_of,
    undistortion,
)

# mypy: no-check-untyped-defs


W, H = 256, 128
FISHEYE = [60.0, 60.0, 100.0, 100.0, 0.02, -0.01, 0.0, 0.0]
FISHEYE_SIZE = (200, 200)


def colour(directions):
    """(..., 3) uint8 of unit directions, smooth and different everywhere."""
    return np.rint(127.5 + 100 * directions).astype(np.uint8)


def panorama_directions():
    """By the textbook: longitude to the right of the middle, latitude up from it."""
    longitude = ((np.arange(W) + 0.5) / W - 0.5) * 2 * math.pi
    latitude = (0.5 - (np.arange(H) + 0.5) / H)[:, None] * math.pi
    across = np.cos(latitude)
    return np.stack(
        [across * np.sin(longitude), np.broadcast_to(-np.sin(latitude), (H, W)),
         across * np.cos(longitude)], -1,
    )  # fmt: skip


def fisheye_directions():
    """Each pixel's direction, by inverting the polynomial on a table; and its angle."""
    x = (np.arange(200) + 0.5 - 100) / 60
    x, y = np.meshgrid(x, x)
    table = np.linspace(0, 2.4, 20001)
    theta = np.interp(np.hypot(x, y), table * (1 + 0.02 * table**2 - 0.01 * table**4), table)
    turn = np.arctan2(y, x)
    flat = np.sin(theta)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), np.cos(theta)], -1), theta


def directions_of(face):
    """Unit directions of a face's pixels in the picture's camera, by its K and turn alone."""
    width, height = face.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(face.K).T @ face.rotation
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def test_faces_look_where_their_names_say():
    ahead = {name: face_rotation(name)[2] for name in DIRECTIONS}
    expected = {
        "front": [0, 0, 1], "right": [1, 0, 0], "back": [0, 0, -1], "left": [-1, 0, 0],
        "up": [0, -1, 0], "down": [0, 1, 0],
    }  # fmt: skip
    for name, direction in expected.items():
        np.testing.assert_array_equal(ahead[name], direction)
        np.testing.assert_allclose(np.linalg.det(face_rotation(name)), 1)
        if name in ("front", "right", "back", "left"):
            np.testing.assert_array_equal(face_rotation(name)[1], [0, 1, 0])


def test_faces_of_a_panorama_show_what_lies_in_their_directions():
    faces = perspective_views("EQUIRECTANGULAR", [W, H], (W, H), what="test")
    assert [face.face for face in faces] == list(DIRECTIONS)
    picture = colour(panorama_directions())
    distance = 2 + panorama_directions()[..., 1].astype(np.float32)
    for face in faces:
        directions = directions_of(face)
        error = face.image(picture).astype(float) - colour(directions)
        assert np.abs(error).max() <= 3
        assert face.inside is None
        z = (2 + directions[..., 1]) * (directions @ face.rotation[2])
        np.testing.assert_allclose(face.depth(distance), z, atol=0.03)


def test_a_panorama_is_averaged_where_a_face_is_coarser():
    # One pixel of ten bright: a sample without averaging would be 0 or 255 at the poles.
    picture = np.zeros((H, W, 3), np.uint8)
    picture[:, ::2] = 255
    up = perspective_views("EQUIRECTANGULAR", [W, H], (W, H), what="test")[4]
    middle = up.image(picture)[28:54, 28:54, 0].astype(float)
    assert abs(middle.mean() - 127.5) < 6
    assert middle.std() < 45


def test_faces_of_a_fisheye_beyond_90_degrees():
    faces = perspective_views("OPENCV_FISHEYE", FISHEYE, FISHEYE_SIZE, what="test")
    assert {face.face for face in faces} == {"front", "right", "left", "up", "down"}
    directions, theta = fisheye_directions()
    edge = theta[100, -1]
    assert edge > math.radians(95)
    picture = colour(directions)
    depth = np.where(directions[..., 2] > 0, 3 * directions[..., 2], 0).astype(np.float32)
    for face in faces:
        shown = directions_of(face)
        angle = np.arccos(np.clip(shown[..., 2], -1, 1))
        inside = np.ones(shown.shape[:2], bool) if face.inside is None else face.inside
        # The corners of the picture, outside of its image circle, are no part of any face.
        np.testing.assert_array_equal(inside[angle < edge - 0.02], True)
        np.testing.assert_array_equal(inside[angle > edge + 0.02], False)
        error = face.image(picture).astype(float) - colour(shown)
        assert np.abs(error[inside]).max() <= 4
        z = 3 * (shown @ face.rotation[2])
        recorded = angle < math.radians(80)
        np.testing.assert_allclose(face.depth(depth)[recorded], z[recorded], rtol=1e-3)
        assert (face.depth(depth)[angle > math.radians(91)] == 0).all()


@pytest.fixture
def project(tmp_path):
    """Three panoramas, the second turned by 30 degrees about the vertical, with masks and depth."""
    turn = math.radians(30)
    poses = [np.eye(4) for _ in range(3)]
    poses[1][:3, :3] = [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0],
                        [-math.sin(turn), 0, math.cos(turn)]]  # fmt: skip
    for i, pose in enumerate(poses):
        pose[0, 3] = i
        Image.fromarray(colour(panorama_directions())).save(tmp_path / f"p{i}.png")
        np.save(tmp_path / f"p{i}.npy", np.full((H, W), 2.0, np.float32))
    mask = np.full((H, W), 255, np.uint8)
    mask[-20:] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    frames = [
        {
            "file_path": f"p{i}.png",
            "depth_file_path": f"p{i}.npy",
            "mask_path": "mask.png",
            "transform_matrix": pose.tolist(),
        }
        for i, pose in enumerate(poses)
    ]
    told = {"camera_model": "EQUIRECTANGULAR", "depth_unit_scale_factor": 1.0, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    return tmp_path


def test_transforms_of_panoramas_are_read(project):
    scene = open_project(project)
    assert len(scene) == 18
    assert scene.names[0] == "p0@back.png"
    front = scene["p1@front.png"]
    assert front.has_depth
    # The OpenGL camera looks along -z of its own frame; the picture's middle is ahead of it.
    ahead = front.camera.world_from_cam[0, :3, 2]
    np.testing.assert_allclose(ahead, [-0.5, 0, -math.cos(math.radians(30))], atol=1e-12)
    np.testing.assert_allclose(front.camera.centers[0], [1, 0, 0], atol=1e-12)
    right = scene["p1@right.png"].camera.world_from_cam[0, :3, 2]
    np.testing.assert_allclose(right, front.camera.world_from_cam[0, :3, 0], atol=1e-12)
    down = scene["p1@down.png"].load()
    middle = down.mask.shape[0] // 2
    assert not down.mask[middle, middle]
    frame = front.load()
    assert frame.mask.all()
    half = frame.depth.shape[0] // 2
    np.testing.assert_allclose(frame.depth[half, half], 2, rtol=1e-3)
    np.testing.assert_allclose(frame.depth[0, 0], 2 / math.sqrt(3), rtol=0.02)


def test_splits_count_pictures(project):
    names = open_project(project).names
    held = select(names, "every:2")
    assert {picture_of(name) for name in held} == {"p0.png", "p2.png"}
    assert len(held) == 12
    given = select(names, "not:every:2")
    check_disjoint(given, held)
    assert select(names, "p1.png") == given
    assert select(names, "p1@up.png") == ("p1@up.png",)
    with pytest.raises(OptionError, match="overlap"):
        check_disjoint(["p1@up.png"], ["p1@down.png"])
    with pytest.raises(OptionError, match="there are 3"):
        select(names, "first:4")


def test_a_colmap_model_of_panoramas_keeps_its_tracks(tmp_path):
    camera = pycolmap.Camera(camera_id=1, model="EQUIRECTANGULAR", width=W, height=H, params=[W, H])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    points = np.random.default_rng(1).normal(size=(40, 3)) * 4
    (tmp_path / "images").mkdir()
    centres = ([0.0, 0, 0], [0.3, 0.1, 0.2])
    for number, centre in enumerate(centres, start=1):
        xy = np.array([camera.img_from_cam(point - centre) for point in points])
        image = pycolmap.Image(name=f"p{number}.png", keypoints=xy, camera_id=1, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), -np.array(centre))
        model.add_image_with_trivial_frame(image, pose)
        Image.fromarray(colour(panorama_directions())).save(tmp_path / "images" / image.name)
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for number in (1, 2):
            track.add_element(number, row)
        model.add_point3D(point, track)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write(tmp_path / "sparse" / "0")
    scene = open_project(tmp_path)
    assert len(scene) == 12
    found = scene.points
    assert len(found.xy) == 80
    for view, point, xy in zip(found.view_index, found.point_index, found.xy, strict=True):
        projected, depth = scene.views[view].camera.project(found.positions[point][None])
        assert depth[0, 0] > 0
        np.testing.assert_allclose(projected[0, 0], xy, atol=1e-3)


# mypy: no-check-untyped-defs


def scene(width: int = 90, height: int = 60) -> Scene:
    """Two views of points at depth 2, whose pictures ramp across and down."""
    ramp = np.zeros((height, width, 3), np.uint8)
    ramp[..., 0] = np.arange(width)
    ramp[..., 1] = np.arange(height)[:, None]
    depth = np.full((height, width), 2.0, np.float32)
    depth[:, : width // 2] = 3.0
    views = []
    for name, shift in (("a", 0.0), ("b", -0.1)):
        pose = rigid_poses(np.eye(3), (shift, 0, 0))
        camera = Cameras.pinhole(width, height, focal=80.0, cam_from_world=pose, name=name)
        views.append(View(name, camera, lambda: Frame(ramp, depth, depth > 2.5), has_depth=True))
    positions = np.array([[0.0, 0.0, 2.0], [1.05, 0.0, 2.0], [0.2, 0.3, 2.0]])
    # The first and the third are seen by both, the second by "a" alone, near its right border.
    point, view = np.array([0, 0, 1, 2, 2], np.int32), np.array([0, 1, 0, 0, 1], np.int32)
    seen = [view.camera.project(positions)[0][0] for view in views]
    xy = np.stack([seen[v][p] for p, v in zip(point, view, strict=True)])
    points = SparsePoints(
        positions, np.full((3, 3), 9, np.uint8), np.ones(3, np.float32), point, view, xy
    )
    return Scene(root=None, kind="colmap", views=tuple(views), points=points)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [(30, 30), (45, 30), (120, 60), (60, 120)])
def test_cameras_points_and_pixels_stay_together(size):
    whole = scene()
    found = resized(whole, *size)
    frame, camera = found["a"].load(), found["a"].camera
    assert frame.rgb.shape == (size[1], size[0], 3)
    assert frame.depth is not None and frame.mask is not None
    assert frame.depth.shape == frame.mask.shape == size[::-1]
    assert (int(camera.width[0]), int(camera.height[0])) == size
    # A ray of the new picture meets the colours of the old one where the old camera sees it.
    ray = camera.rays()[size[1] // 2, size[0] // 2]
    xy = whole["a"].camera.project(ray[None])[0][0, 0]
    np.testing.assert_allclose(
        frame.rgb[size[1] // 2, size[0] // 2, :2], xy - 0.5, atol=0.51 + 0.5 * 90 / size[0]
    )
    # Detections stay where the camera projects their points.
    points = points_of(found)
    for point, view, at in zip(points.point_index, points.view_index, points.xy, strict=True):
        expected, _ = found.views[view].camera.project(points.positions[point][None])
        np.testing.assert_allclose(at, expected[0, 0], atol=1e-9)


def points_of(found: Scene) -> SparsePoints:
    assert found.points is not None
    return found.points


def test_the_window_is_central_and_what_lies_outside_has_no_points():
    found = resized(scene(), 30, 30)
    # Of 90 pixels the middle 60 remain, two of which become one.
    np.testing.assert_allclose(found["a"].load().rgb[0, 0], [15.5, 0.5, 0], atol=0.5)
    np.testing.assert_allclose(found["a"].camera.K[0], [[40, 0, 15], [0, 40, 15], [0, 0, 1]])
    assert points_of(found).positions.tolist() == points_of(scene()).positions[[0, 2]].tolist()
    assert points_of(found).point_index.tolist() == [0, 0, 1, 1]


def test_points_that_held_out_views_saw_are_left_out():
    whole = scene()
    both = seen_by(whole, ["a", "b"])
    assert points_of(both).positions.tolist() == points_of(whole).positions[[0, 2]].tolist()
    assert points_of(both).point_index.tolist() == [0, 0, 1, 1]
    assert len(points_of(seen_by(whole, ["a"])).positions) == 0
    assert len(points_of(whole).positions) == 3
    assert seen_by(whole.subset(["a"]), ["a"]).points is None


def test_cameras_pictures_depth_and_points_shrink_together():
    whole = scene(180, 120)
    out = reduced(whole, 90)
    first, frame = out.views[0], out.views[0].load()
    assert (first.camera.width[0], first.camera.height[0]) == (90, 60)
    assert frame.rgb.shape == (60, 90, 3)
    assert frame.depth is not None and frame.mask is not None
    assert frame.depth.shape == frame.mask.shape == (60, 90)
    np.testing.assert_allclose(points_of(out).xy, points_of(whole).xy / 2)
    assert "2 pictures are reduced" in out.findings[-1].message
    expected = whole.views[0].load().rgb.reshape(60, 2, 90, 2, 3).mean(axis=(1, 3))
    assert np.abs(frame.rgb - expected).max() <= 1


def test_nothing_to_reduce_is_the_scene_itself():
    whole = scene()
    assert reduced(whole, None) is whole
    assert reduced(whole, 90) is whole
    with pytest.raises(OptionError, match="at least 64"):
        reduced(whole, 10)


SIZE = (WIDTH, HEIGHT)


@pytest.mark.parametrize("model", sorted(LENSES))
def test_nearest_follows_the_mapping_of_the_picture(model):
    lens = undistortion(model, LENSES[model], SIZE, what="test")
    picture = ramp()
    bilinear = lens.image(picture)
    width, height = lens.size
    assert bilinear.shape == (height, width, 3)
    for channel, steps in ((0, WIDTH), (1, HEIGHT)):
        near = lens.nearest(picture[..., channel])
        # On a ramp, nearest and bilinear differ by half a pixel's step at most, and not on average.
        difference = near.astype(float) - bilinear[..., channel]
        assert np.abs(difference).max() <= 0.5 * 255 / steps + 1
        assert abs(difference.mean()) < 0.25


def test_points_are_those_of_the_simple_radial_closed_form():
    f, cx, cy, k = 90, 48, 36, -0.15
    lens = undistortion("SIMPLE_RADIAL", [f, cx, cy, k], SIZE, what="test")
    ray = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    recorded = ray * (1 + k * (ray**2).sum(axis=1, keepdims=True)) * f + (cx, cy)
    expected = ray * f + lens.K[:2, 2]
    np.testing.assert_allclose(lens.points(recorded), expected, atol=1e-3)


def test_points_outside_the_picture_are_kept_and_impossible_ones_are_nan():
    lens = undistortion("SIMPLE_RADIAL", LENSES["SIMPLE_RADIAL"], SIZE, what="test")
    kept = lens.points([[-3, 30], [WIDTH + 4, HEIGHT + 2]])
    assert np.isfinite(kept).all()
    # With k < 0 no ray reaches farther than f * 2 / 3 * sqrt(1 / (3 |k|)) from the centre.
    assert np.isnan(lens.points([[48 + 95, 36]])).all()
    assert lens.points(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    ("model", "params", "size", "told"),
    [
        ("EQUIRECTANGULAR", [200, 100], (200, 100), "EQUIRECTANGULAR is spherical"),
        ("PINHOLES", [1], SIZE, "unknown camera model 'PINHOLES'"),
        ("PINHOLE", [90, 90, 48], SIZE, "has 3 parameters"),
        ("PINHOLE", [90, np.nan, 48, 36], SIZE, "NaN"),
        ("PINHOLE", [90, -90, 48, 36], SIZE, "not positive"),
        ("PINHOLE", [90, 90, 48, 36], (0, 10), "impossible size"),
    ],
)
def test_impossible_cameras(model, params, size, told):
    with pytest.raises(ProjectError, match=told) as error:
        undistortion(model, params, size, what="camera 7")
    assert str(error.value).startswith("camera 7: ")
    assert "\n" not in str(error.value)


def test_colours_are_those_of_pycolmap():
    lens = undistortion("OPENCV", (80, 80, 48, 32, -0.2, 0.05, 0.01, 0.0), (96, 64), what="test")
    noise = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    picture = cv2.GaussianBlur(noise, (0, 0), 1.0)
    options = pycolmap.UndistortCameraOptions()
    bitmap, _ = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(picture), lens.source)
    apart = np.abs(lens.image(picture).astype(int) - bitmap.to_array())[lens._source_pixel >= 0]
    assert np.quantile(apart, 0.99) <= 1
