"""Scenes with reduced pictures, with pictures of one size, and with some views' points alone."""
# mypy: no-check-untyped-defs

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
from scenes_workspace import HEIGHT, LENSES, WIDTH, ramp

from gvtools.cameras import Cameras
from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.resized import reduced, resized, seen_by
from gvtools.scenes.scene import Frame, Scene, SparsePoints, View
from gvtools.scenes.undistort import undistortion


def scene(width: int = 90, height: int = 60) -> Scene:
    """Two views of points at depth 2, whose pictures ramp across and down."""
    ramp = np.zeros((height, width, 3), np.uint8)
    ramp[..., 0] = np.arange(width)
    ramp[..., 1] = np.arange(height)[:, None]
    depth = np.full((height, width), 2.0, np.float32)
    depth[:, : width // 2] = 3.0
    views = []
    for name, shift in (("a", 0.0), ("b", -0.1)):
        pose = np.eye(4)
        pose[0, 3] = shift
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
        ("INVALID", [], SIZE, "unknown camera model"),
        ("PINHOLE", [90, 90, 48], SIZE, "has 3 parameters"),
        ("PINHOLE", [90, np.nan, 48, 36], SIZE, "NaN"),
        ("PINHOLE", [90, -90, 48, 36], SIZE, "not positive"),
        ("PINHOLE", [90, 90, 48, 36], (0, 10), "impossible size"),
        ("PINHOLE", [90, 90, 48, 36], (2**40, 10), "impossible size"),
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
