from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from walls import camera_at, photograph

from gvtools.errors import OptionError
from gvtools.memory.back_projection import back_project
from gvtools.scenes.reduced import reduced
from gvtools.scenes.scene import Frame, Scene, SparsePoints, View

pytest_plugins = ("wall_fixtures",)


@pytest.fixture
def scene(textures) -> Scene:
    picture = photograph(camera_at((0, 0, 0), name="a.png"), textures)
    small = camera_at((0.1, 0, 0), name="b.png").resized(80, 60)
    mask = np.ones(picture.rgb.shape[:2], bool)
    mask[:, :100] = False
    views = (
        View("a.png", picture.camera, lambda: Frame(picture.rgb, picture.depth, mask), True),
        View("b.png", small, lambda: Frame(np.zeros((60, 80, 3), np.uint8))),
    )
    xy = np.array([[200.0, 60.0], [40.0, 30.0]])
    points = SparsePoints(
        np.zeros((1, 3)), np.zeros((1, 3), np.uint8), np.zeros(1, np.float32),
        np.array([0, 0], np.int32), np.array([0, 1], np.int32), xy,
    )  # fmt: skip
    return Scene(Path("scene"), "colmap", views, points)


def test_cameras_pictures_depth_and_points_shrink_together(scene):
    out = reduced(scene, 160)
    first = out.views[0]
    assert (first.camera.width[0], first.camera.height[0]) == (160, 120)
    frame = first.load()
    assert frame.rgb.shape == (120, 160, 3)
    assert frame.depth is not None and frame.mask is not None
    assert frame.depth.shape == frame.mask.shape == (120, 160)
    assert out.points is not None
    np.testing.assert_allclose(out.points.xy, [[100, 30], [40, 30]])
    # Small pictures stay as they are.
    assert out.views[1] is scene.views[1]
    assert "1 pictures are reduced" in out.findings[-1].message


def test_the_reduced_view_shows_the_same_surfaces(scene):
    whole, small = scene.views[0], reduced(scene, 160).views[0]
    clouds = []
    for view in (whole, small):
        frame = view.load()
        assert frame.depth is not None
        points = back_project(frame.rgb, frame.depth, view.camera)
        clouds.append(points.positions)
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(clouds[0]).query(clouds[1])
    # Nearest pixels are up to half an old pixel off the new centre, within the surface.
    assert np.percentile(distance, 95) < 0.02


def test_colours_are_averages(scene):
    frame, small = scene.views[0].load(), reduced(scene, 160).views[0].load()
    expected = frame.rgb.reshape(120, 2, 160, 2, 3).mean(axis=(1, 3))
    assert np.abs(small.rgb - expected).max() <= 1


def test_nothing_to_reduce_is_the_scene_itself(scene):
    assert reduced(scene, None) is scene
    assert reduced(scene, 320) is scene
    with pytest.raises(OptionError, match="at least 64"):
        reduced(scene, 10)
