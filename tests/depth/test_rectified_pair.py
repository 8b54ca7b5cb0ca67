"""Rectified stereo against exact depth: side by side, swapped, one above the other, turned."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from walls import WIDTH, camera_at, photograph

from gvtools.cameras import concatenate
from gvtools.depth.rectified_pair import RectifiedPair, is_rectifiable
from gvtools.errors import ProjectError
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.scenes.stereo_sample import write_motorcycle

pytest_plugins = ("wall_fixtures",)


def pair(textures, step, *, turn=(0, 0, 0), second_turn=None) -> tuple[Scene, list[np.ndarray]]:
    """A scene of two photographs, and their exact depth."""
    views, depths = [], []
    for i, (center, turned) in enumerate(
        (((0, 0, 0), turn), (step, second_turn if second_turn is not None else turn))
    ):
        picture = photograph(camera_at(center, turn=turned, name=f"{i}.png"), textures)
        assert picture.depth is not None
        depths.append(picture.depth)
        views.append(View(f"{i}.png", picture.camera, partial(Frame, picture.rgb)))
    return Scene(Path("pair"), "colmap", tuple(views)), depths


@pytest.mark.parametrize("step", [(0.2, 0, 0), (-0.2, 0, 0), (0, 0.15, 0), (0, -0.15, 0)])
@pytest.mark.parametrize("second_turn", [(0, 0, 0), (1.5, -2, 1)])
def test_depth_is_exact_in_both_views(textures, step, second_turn):
    scene, depths = pair(textures, step, second_turn=second_turn)
    source = RectifiedPair(scene, scene.names)
    for view, truth in zip(scene, depths, strict=True):
        assert source.covers(view)
        found = source.depth(scene, view, view.load())
        known = found.depth > 0
        # A strip as wide as the disparity is seen by one camera alone.
        assert known.mean() > 0.45
        error = np.abs(found.depth / truth - 1)[known]
        assert np.median(error) < 0.01
        assert (error > 0.05).mean() < 0.03
        assert found.depth.shape == truth.shape
        assert (found.confidence > 0).all() and (found.confidence <= 1).all()
        assert found.source == "rectified-pair"


def test_what_is_no_pair_is_refused(textures):
    ahead, _ = pair(textures, (0, 0, 0.3))
    assert not is_rectifiable(ahead.cameras)
    crossed, _ = pair(textures, (0.2, 0, 0), second_turn=(0, 15, 0))
    assert not is_rectifiable(crossed.cameras)
    side, _ = pair(textures, (0.2, 0, 0))
    assert is_rectifiable(side.cameras)
    other = side.cameras[1].resized(WIDTH // 2, 120)
    assert not is_rectifiable(concatenate([side.cameras[0], other]))
    with pytest.raises(ProjectError, match="side by side"):
        RectifiedPair(ahead, ahead.names)


def test_the_motorcycle_pair_has_its_recorded_depth(tmp_path):
    """A real pair, with and without sparse points to tell the range."""
    write_motorcycle(tmp_path)
    scene = open_project(tmp_path)
    view = scene.views[0]
    frame = view.load()
    assert frame.depth is not None
    for known in (scene, replace(scene, points=None)):
        found = RectifiedPair(known, known.names).depth(known, view, frame).depth
        both = (found > 0) & (frame.depth > 0)
        error = np.abs(found / np.where(frame.depth > 0, frame.depth, 1) - 1)[both]
        assert np.median(error) < 0.005
        assert (error > 0.1).mean() < 0.06
