"""Plane-sweep depth of two photographs: side by side, one above the other, turned, and real."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from walls import camera_at, photograph

from gvtools.depth.options import StereoOptions
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
from gvtools.procedural.stereo_sample import write_motorcycle
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Frame, Scene, View

pytest_plugins = ("wall_fixtures",)


@pytest.mark.parametrize("step", [(0.2, 0, 0), pytest.param((0, -0.15, 0), marks=pytest.mark.slow)])
@pytest.mark.parametrize("second_turn", [(0, 0, 0), (1.5, -2, 1)])
def test_depth_is_exact_in_both_views(textures, step, second_turn):
    views, depths = [], []
    for i, (center, turn) in enumerate((((0, 0, 0), (0, 0, 0)), (step, second_turn))):
        picture = photograph(camera_at(center, turn=turn, name=f"{i}.png"), textures)
        assert picture.depth is not None
        depths.append(picture.depth)
        views.append(View(f"{i}.png", picture.camera, partial(Frame, picture.rgb)))
    scene = Scene(Path("pair"), "colmap", tuple(views))
    source = PlaneSweepStereo(scene, options=StereoOptions(), views=scene.names)
    for view, truth in zip(scene, depths, strict=True):
        found = source.depth(scene, view, view.load()).depth
        known = found > 0
        # A strip as wide as the disparity is seen by one camera alone.
        assert known.mean() > 0.8
        error = np.abs(found / truth - 1)[known]
        assert np.median(error) < 0.001 and (error > 0.05).mean() < 0.01


def test_the_motorcycle_pair_has_its_recorded_depth(tmp_path):
    write_motorcycle(tmp_path)
    scene = open_project(tmp_path)
    view = scene.views[0]
    frame = view.load()
    assert frame.depth is not None
    source = PlaneSweepStereo(scene, options=StereoOptions(), views=scene.names)
    found = source.depth(scene, view, frame).depth
    both = (found > 0) & (frame.depth > 0)
    error = np.abs(found[both] / frame.depth[both] - 1)
    assert both.sum() > 0.8 * (frame.depth > 0).sum()
    assert np.median(error) < 0.003 and (error > 0.1).mean() < 0.06
