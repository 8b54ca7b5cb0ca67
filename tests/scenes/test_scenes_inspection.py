# mypy: no-check-untyped-defs
from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scenes_workspace import HEIGHT, WIDTH, depth_picture, save, sevenscenes, workspace

from gvtools.depth.choice import choose_source
from gvtools.errors import ProjectError
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.inspection import inspect, reprojection_errors
from gvtools.scenes.rgbd_layouts import SEVENSCENES


def move_detections(reconstruction, root, images, *, by):
    """Write the model with the detections of some images moved."""
    for image in list(reconstruction.images.values())[:images]:
        for index, point in enumerate(image.points2D):
            if point.has_point3D():
                image.points2D[index].xy = point.xy + np.array(by, float)
    reconstruction.write_binary(root / "sparse/0")


def test_report_of_a_model(tmp_path):
    reconstruction = workspace(tmp_path)
    move_detections(reconstruction, tmp_path, 4, by=(0.3, 0.4))
    scene = read_colmap(tmp_path)
    report = inspect(scene)
    assert report.ok
    assert (report.views, report.views_opened) == (4, 4)
    assert report.sparse_points == 40
    assert report.observations == 160
    # Half a pixel in the recorded picture, nearly so in the undistorted one.
    assert report.reprojection_px == pytest.approx(0.5, abs=0.1)
    np.testing.assert_allclose(reprojection_errors(scene).mean(), report.reprojection_px)
    assert report.depth is None
    json.dumps(report.to_dict())


def test_report_of_a_scan(tmp_path):
    root = sevenscenes(tmp_path, frames=5)
    save(root / "frame-000004.depth.png", depth_picture(4.0))
    report = inspect(SEVENSCENES.read(root))
    assert report.metric
    assert report.path_length == pytest.approx(0.4)
    assert report.extent == pytest.approx(0.4)
    assert report.sizes == {"96x72": 5}
    assert report.depth.views == 5
    assert report.depth.coverage == pytest.approx(1 - 2 / (HEIGHT * WIDTH))
    assert (report.depth.minimum, report.depth.median, report.depth.maximum) == pytest.approx(
        (2, 2, 4)
    )
    assert report.reprojection_px is None


def test_truncated_picture_is_found_by_opening(tmp_path):
    root = sevenscenes(tmp_path)
    said = "frame-000001.color.png: unreadable", "2 files (", "frame-000002.color.png): unreadable"
    for number, expected in ((1, said[:1]), (2, said[1:])):
        path = root / f"frame-{number:06}.color.png"
        save(path, np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
        path.write_bytes(path.read_bytes()[:-3000])
        report = inspect(SEVENSCENES.read(root))
        assert not report.ok
        assert report.views_opened == 3 - number
        (error,) = (item.message for item in report.findings if item.level == "error")
        assert all(part in error for part in expected)


def depth_findings(scene):
    return [
        (item.level, item.message)
        for item in inspect(scene).findings
        if "depth" in item.message and item not in scene.findings
    ]


def test_depth_that_a_run_computes_is_told(tmp_path):
    scene = SEVENSCENES.read(sevenscenes(tmp_path))
    assert not depth_findings(scene)
    bare = tuple(replace(view, has_depth=False) for view in scene)
    ((level, message),) = depth_findings(replace(scene, views=bare))
    assert level == "info"
    assert message.startswith("none of the 3 views has recorded depth; a run computes")
    ((level, message),) = depth_findings(replace(scene, views=(bare[0], *scene.views[1:])))
    assert level == "info"
    assert message.startswith(
        "recorded depth in 2 of the 3 views; a run computes that of the others"
    )
    ((level, message),) = depth_findings(replace(scene, views=bare[:1]))
    assert level == "warning"
    assert "one photograph" in message
    with pytest.raises(ProjectError, match="at least 2 views"):
        choose_source(replace(scene, views=bare[:1]), scene.names[:1], "auto")


@pytest.mark.parametrize("wrong", [1, 4])
def test_intrinsics_that_no_camera_has_and_poses_that_points_contradict_are_warned_of(
    tmp_path, wrong
):
    reconstruction = workspace(tmp_path)
    move_detections(reconstruction, tmp_path, wrong, by=(30, 40))
    messages = [finding.message for finding in inspect(read_colmap(tmp_path)).findings]
    assert any(f"on average in {wrong} of 4 views" in message for message in messages)
    assert not any("no camera has" in message for message in messages)
    scene = read_colmap(tmp_path)
    K = scene.views[0].camera.K.copy()
    K[0, 0, 2] = -1
    odd = replace(scene.views[0], camera=replace(scene.views[0].camera, K=K))
    found = inspect(replace(scene, views=(odd, *scene.views[1:]), points=None)).findings
    assert any("1 views have intrinsics that no camera has" in item.message for item in found)
