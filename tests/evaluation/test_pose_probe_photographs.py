"""The pose probe on held-out photographs of a real room."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvtools.evaluation.pose_probe import (
    PoseProbe,
    summarise,
)
from gvtools.evaluation.posed_picture import PosedPicture

pytest_plugins = ("wall_fixtures",)


def sevenscenes(folder: Path, spec: str) -> list[PosedPicture]:
    from gvtools.scenes.project import open_project
    from gvtools.scenes.selection import select

    scene = open_project(folder)
    pictures = []
    for name in select(scene.names, spec):
        frame, camera = scene[name].load(), scene[name].camera
        pictures.append(PosedPicture(name, camera, frame.rgb, frame.depth, frame.mask))
    return pictures


@pytest.mark.slow
@pytest.mark.data
def test_held_out_photographs_from_five_views(shared: Path) -> None:
    folder = shared / "data" / "sevenscenes_reg"
    probe = PoseProbe(sevenscenes(folder, "every:20"))
    summary = summarise([probe.locate(one) for one in sevenscenes(folder, "every:20+10")])
    # Recorded poses of this scene agree among themselves to about half a degree and 2 cm.
    assert summary.success_share == 1, summary.failures
    assert summary.rotation_error_deg is not None and summary.rotation_error_deg.median < 3
    assert summary.center_error is not None and summary.center_error.median < 0.06


@pytest.mark.data
@pytest.mark.slow
def test_held_out_photographs_and_shifted_projections(shared: Path) -> None:
    from gvtools.memory.spatial_memory import SpatialMemory

    folder = shared / "data" / "sevenscenes_reg"
    context = sevenscenes(folder, "every:2")
    targets = sevenscenes(folder, "every:2+1")
    probe = PoseProbe(context)
    summary = summarise([probe.locate(one) for one in targets])
    assert summary.success_share is not None and summary.success_share >= 0.95, summary.failures
    assert summary.rotation_error_deg is not None and summary.rotation_error_deg.median <= 1
    assert summary.center_error is not None and summary.center_error.median <= 0.03

    memory = SpatialMemory(0.01)
    for one in context:
        assert one.depth is not None
        memory.observe(one.rgb, one.depth, one.camera, round=0)
    for step, turn in (((0.0, 0, 0.2), (0, 0, 0)), ((0.0, 0, 0), (0, 5, 0))):
        move = np.eye(4)
        move[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        move[:3, 3] = step
        found = []
        for one in targets[::5]:
            pose = move @ one.camera.cam_from_world
            seen = memory.project(dataclasses.replace(one.camera, cam_from_world=pose))
            rgb = np.rint(255 * seen.rgb[0]).astype(np.uint8)
            found.append(probe.locate(PosedPicture(one.name, one.camera, rgb, mask=seen.valid[0])))
        shifted = summarise(found)
        assert shifted.success_share == 1, shifted.failures
        assert shifted.rotation_error_deg is not None and shifted.center_error is not None
        assert shifted.rotation_error_deg.median == pytest.approx(max(turn), abs=0.3)
        assert shifted.center_error.median == pytest.approx(max(step), abs=0.01)
