from __future__ import annotations

import numpy as np
import pycolmap
import pytest
import skimage.data
from PIL import Image
from scipy.ndimage import map_coordinates

from gvtools.procedural.sample_workspace import WrittenSample
from gvtools.procedural.stereo_sample import (
    depth_from_disparity,
    motorcycle_cameras,
    write_motorcycle,
)
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.scene import Scene


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> WrittenSample:
    return write_motorcycle(tmp_path_factory.mktemp("stereo") / "motorcycle")


@pytest.fixture(scope="module")
def scene(sample: WrittenSample) -> Scene:
    return read_colmap(sample.folder)


def _difference(scene: Scene, *, dx: float = 0, dy: float = 0) -> float:
    """Mean colour difference between left pixels and where depth puts them in the right image."""
    left, right = (view.load() for view in scene)
    assert left.depth is not None
    rows, columns = (place[::9] for place in np.nonzero(left.depth))
    points = scene.cameras.rays(0)[rows, columns] * left.depth[rows, columns, None]
    x, y = scene.cameras.project(points)[0][1].T - 0.5
    inside = (x >= 4) & (x <= right.rgb.shape[1] - 5)
    at = [y[inside] + dy, x[inside] + dx]
    channels = np.moveaxis(right.rgb.astype(float), -1, 0)
    colors = [map_coordinates(each, at, order=1, mode="nearest") for each in channels]
    return float(np.abs(np.transpose(colors) - left.rgb[rows, columns][inside]).mean())


def test_calibration_is_right_to_a_fraction_of_a_pixel(scene: Scene) -> None:
    true = _difference(scene)
    assert true < 8
    for dx, dy in ((-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5)):
        assert _difference(scene, dx=dx, dy=dy) > 1.1 * true
    for dx, dy in ((-4, 0), (4, 0), (0, 4)):
        assert _difference(scene, dx=dx, dy=dy) > 2 * true


def test_projection_gives_back_the_published_disparity() -> None:
    disparity = skimage.data.stereo_motorcycle()[2]
    depth = depth_from_disparity(disparity)
    cameras = motorcycle_cameras(disparity.shape[1], disparity.shape[0])
    rows, columns = np.nonzero(depth)
    points = cameras.rays(0)[rows, columns] * depth[rows, columns, None]
    xy, z = cameras.project(points)
    np.testing.assert_allclose(xy[0, :, 0] - xy[1, :, 0], disparity[rows, columns], atol=1e-4)
    np.testing.assert_allclose(xy[0, :, 1], xy[1, :, 1], atol=1e-9)
    np.testing.assert_allclose(z[0], z[1])
    assert np.isfinite(disparity).sum() == len(rows)

    # None where nothing is measured.
    disparity = np.array([[np.nan, np.inf, -np.inf, 30.0, -31.1]])
    depth = depth_from_disparity(disparity)
    assert (depth[0, [0, 1, 2, 4]] == 0).all()
    # Middlebury's formula: Z = baseline x focal length / (disparity + offset), in millimetres.
    millimetres = 193.001 * 994.978 / (30 + 31.086)
    assert depth[0, 3] == pytest.approx(millimetres / 1000, rel=1e-5)


def test_workspace_reads_back_and_is_kept(sample: WrittenSample, scene: Scene) -> None:
    assert scene.names == sample.context + sample.targets
    assert [view.has_depth for view in scene] == [True, False]
    left, right, _ = skimage.data.stereo_motorcycle()
    for name, expected in (("left.png", left), ("right.png", right)):
        with Image.open(sample.folder / "images" / name) as image:
            np.testing.assert_array_equal(np.asarray(image), expected)
    depth = scene["left.png"].load().depth
    assert depth is not None
    assert 0.9 < (depth > 0).mean() < 0.95
    assert depth[depth > 0].min() > 1.5 and depth.max() < 6
    picture = sample.folder / "images" / "left.png"
    before = picture.stat().st_mtime_ns
    assert write_motorcycle(sample.folder) == sample
    assert picture.stat().st_mtime_ns == before


def test_sparse_points_lie_on_the_measured_surface(sample: WrittenSample, scene: Scene) -> None:
    model = pycolmap.Reconstruction(sample.folder / "sparse" / "0")
    assert model.num_points3D() == 1500
    assert model.compute_mean_reprojection_error() < 1e-6
    depth = scene["left.png"].load().depth
    assert depth is not None
    images = {image.name: image for image in model.images.values()}
    right = scene["right.png"].load().rgb
    errors, differences = [], []
    for point in model.points3D.values():
        assert {model.images[e.image_id].name for e in point.track.elements} == set(images)
        x, y = images["left.png"].project_point(point.xyz)
        errors.append(abs(depth[int(y), int(x)] / point.xyz[2] - 1))
        x, y = images["right.png"].project_point(point.xyz)
        differences.append(np.abs(right[int(y), int(x)].astype(int) - point.color).mean())
    assert max(errors) < 1e-5
    assert np.median(differences) < 20
