# mypy: no-check-untyped-defs
"""Readers on real scenes: our cameras against the models' own figures, and scans against photos."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.inspection import inspect, reprojection_errors
from gvtools.scenes.project import open_project
from gvtools.scenes.rgbd import RgbdOptions

pytestmark = pytest.mark.data

CLIP = RgbdOptions(
    color_K=np.array([[522.9, 0, 317.9], [0, 522.9, 234.5], [0, 0, 1]]),
    depth_K=np.array([[585, 0, 320], [0, 585, 240], [0, 0, 1]]),
    color_from_depth=np.array([[1, 0, 0, -0.0222], [0, 1, 0, 0.0088], [0, 0, 1, 0], [0, 0, 0, 1]]),
)


def inspected(scene, **options):
    """The report of a scene whose cameras contradict nothing."""
    report = inspect(scene, **options)
    assert report.ok
    assert not any("nearly equal cameras" in finding.message for finding in report.findings)
    return report


def models_own_error(folder):
    """Mean over observations, through pycolmap's distorted cameras."""
    import pycolmap

    model = pycolmap.Reconstruction(folder)
    errors = []
    for image in model.images.values():
        seen = [point for point in image.points2D if point.has_point3D()]
        world = np.array([model.points3D[point.point3D_id].xyz for point in seen])
        pose = image.cam_from_world().matrix()
        projected = image.camera.img_from_cam(world @ pose[:, :3].T + pose[:, 3])
        errors.append(np.linalg.norm(projected - np.array([p.xy for p in seen]), axis=1))
    return np.concatenate(errors).mean()


@pytest.mark.parametrize("form", ["sparse/0", pytest.param("sparse_txt", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("name", "published"), [("fox_colmap", 0.595), ("sceaux_colmap", 0.310), ("fern_colmap", 0.722)]
)
def test_reprojection_stays_at_the_models_own_error(shared, name, published, form):
    own = models_own_error(shared / "data" / name / form)
    assert own == pytest.approx(published, abs=0.001)
    scene = read_colmap(shared / "data" / name / form)
    report = inspected(scene)
    assert report.reprojection_px == pytest.approx(own, abs=0.05)
    # Back in the recorded camera, the detections of the pinhole views give the model's own figure.
    assert np.isfinite(reprojection_errors(scene)).all()


def test_fox_cameras_agree_between_colmap_and_transforms(shared):
    import pycolmap

    colmap = open_project(shared / "data/fox_colmap")
    ngp = open_project(shared / "data/fox_transforms")
    assert colmap.names == ngp.names
    assert len(ngp) == 50
    assert any("17 of 67 frames have no picture" in finding.message for finding in ngp.findings)
    a, b = colmap.cameras.centers, ngp.cameras.centers
    fit = pycolmap.estimate_sim3d(a, b)
    residual = np.linalg.norm(np.array([fit * center for center in a]) - b, axis=1)
    radius = np.linalg.norm(b - b.mean(axis=0), axis=1).max()
    assert residual.max() / radius < 0.01
    assert np.sqrt((residual**2).mean()) / radius < 0.003
    # The two solutions differ by one constant turn, so axes were converted the same way.
    turn = colmap.cameras.world_from_cam[:, :3, :3].transpose(0, 2, 1) @ (
        fit.rotation.matrix().T @ ngp.cameras.world_from_cam[:, :3, :3]
    )
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angle.max() < 1.0


def test_kitchen_scan_is_read_whole(shared):
    scene = open_project(shared / "data/sevenscenes_reg")
    assert (len(scene), scene.metric, scene.kind) == (100, True, "rgbd")
    assert any("100 of 100 rotations" in finding.message for finding in scene.findings)
    report = inspected(replace(scene, views=scene.views[::10]))
    assert report.depth.coverage == pytest.approx(0.72, abs=0.03)


def contrast_at_depth_edges(frame):
    """Median colour gradient, within a pixel, where depth jumps between valid neighbours."""
    from scipy import ndimage

    grey = ndimage.gaussian_filter(frame.rgb.mean(axis=2), 1)
    gradient = np.hypot(ndimage.sobel(grey, axis=0), ndimage.sobel(grey, axis=1))
    gradient = ndimage.maximum_filter(gradient, 3)
    inverse = np.where(frame.depth > 0, 1 / np.maximum(frame.depth, 0.1), np.nan)
    edge = np.zeros(inverse.shape, bool)
    across, down = np.abs(np.diff(inverse, axis=1)) > 0.06, np.abs(np.diff(inverse, axis=0)) > 0.06
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return np.median(gradient[edge])


def test_registration_moves_depth_edges_onto_colour_edges(shared):
    folder = shared / "data/sevenscenes_clip"
    plain = open_project(folder, rgbd=RgbdOptions(color_K=CLIP.color_K))
    registered = open_project(folder, rgbd=CLIP)
    for name in registered.names[::10]:
        before = contrast_at_depth_edges(plain[name].load())
        assert contrast_at_depth_edges(registered[name].load()) > 1.25 * before
