# mypy: no-check-untyped-defs
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError, ShapeError
from gvtools.scenes.colmap_writer import write_colmap

VIEWS, POINTS = 5, 60


def cameras(names=()):
    K = np.repeat(np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])[None], VIEWS, axis=0)
    K[3, 0, 0] = 400
    pose = np.repeat(np.eye(4)[None], VIEWS, axis=0)
    pose[:, 0, 3] = np.arange(VIEWS) * 0.1
    return Cameras(K, pose, np.full(VIEWS, 640), np.full(VIEWS, 480), tuple(names))


def tracks(scene):
    rng = np.random.default_rng(1)
    positions = rng.uniform(-1, 1, (POINTS, 3)) + np.array([0, 0, 4])
    colors = rng.integers(0, 256, (POINTS, 3), dtype=np.uint8)
    xy, _ = scene.project(positions)
    view, point = np.nonzero(rng.random((VIEWS, POINTS)) < 0.7)
    shuffled = rng.permutation(len(view))
    view, point = view[shuffled], point[shuffled]
    return {
        "points": positions,
        "colors": colors,
        "point_index": point,
        "view_index": view,
        "xy": xy[view, point],
    }


def test_pycolmap_reads_back_what_was_written(tmp_path):
    import pycolmap

    written = cameras([f"dir/im{i}.png" for i in range(VIEWS)])
    data = tracks(written)
    write_colmap(tmp_path / "sparse" / "0", written, **data)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert len(model.cameras) == 2
    assert model.num_reg_images() == VIEWS
    for i in range(VIEWS):
        image = model.images[i + 1]
        assert image.name == written.names[i]
        np.testing.assert_allclose(
            image.cam_from_world().matrix(), written.cam_from_world[i, :3], atol=1e-14
        )
        np.testing.assert_allclose(image.camera.calibration_matrix(), written.K[i], atol=1e-12)
    seen = {
        (point - 1, element.image_id - 1): tuple(
            model.images[element.image_id].points2D[element.point2D_idx].xy
        )
        for point in model.points3D
        for element in model.points3D[point].track.elements
    }
    expected = {
        (int(p), int(v)): tuple(xy)
        for p, v, xy in zip(data["point_index"], data["view_index"], data["xy"], strict=True)
    }
    assert seen.keys() == expected.keys()
    for key, xy in expected.items():
        np.testing.assert_allclose(seen[key], xy, atol=1e-9)
    for i in range(POINTS):
        np.testing.assert_allclose(model.points3D[i + 1].xyz, data["points"][i], atol=1e-12)
        np.testing.assert_array_equal(model.points3D[i + 1].color, data["colors"][i])
    assert model.compute_mean_reprojection_error() < 1e-9


def test_same_input_gives_same_bytes_and_no_leftovers(tmp_path):
    written = cameras()
    for name in ("a", "b"):
        write_colmap(tmp_path / name, written, **tracks(written))
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert files == ["cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin"]
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_names_and_matrices_that_a_model_cannot_hold(tmp_path):
    data = tracks(cameras())
    with pytest.raises(ShapeError, match="share a name"):
        write_colmap(tmp_path, cameras(["a", "a", *"xyz"]), **data)
    skewed = cameras()
    skewed.K[0, 0, 1] = 3
    with pytest.raises(ShapeError, match="skew"):
        write_colmap(tmp_path, skewed, **data)


def test_full_disk_leaves_the_earlier_model(tmp_path, monkeypatch):
    import pycolmap

    data = tracks(cameras())
    write_colmap(tmp_path, cameras(), **data)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    real = pycolmap.Reconstruction.write_binary

    def short(self, folder):
        real(self, folder)
        with (Path(folder) / "images.bin").open("r+b") as file:
            file.truncate(100)

    monkeypatch.setattr(pycolmap.Reconstruction, "write_binary", short)
    with pytest.raises(ProjectError, match=r"images\.bin"):
        write_colmap(tmp_path, cameras(), **data)
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
