"""Gaussians in other axes, and with exposures in their colours."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
import torch
from reference_gaussians import harmonics as reference
from scipy.spatial.transform import Rotation
from splat_scene import HEIGHT, NEAR, WIDTH, K, pose, rough_gaussians, walk

from gvtools.appearance.camera_corrections import Exposures, expose
from gvtools.appearance.gaussians import ATTRIBUTES, FIRST_OPACITY, Gaussians
from gvtools.appearance.splat.project_kernels import HARMONICS, LOGIT, SH, VALUES
from gvtools.appearance.splat.splat import Lens, Splat
from gvtools.cameras import Cameras
from gvtools.errors import MemoryFileError
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.splats import harmonics, turn_gaussians

AXES = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()


@pytest.fixture(scope="module")
def coloured():
    """Anisotropic Gaussians whose colours depend on the direction."""
    values = rough_gaussians().values.copy()
    rng = np.random.default_rng(3)
    values[:, 3:6] += rng.normal(scale=0.5, size=(len(values), 3))
    values[:, 6:10] = rng.normal(size=(len(values), 4))
    values[:, LOGIT] = 0
    values[:, SH + 3 :] += rng.normal(scale=0.1, size=(len(values), values.shape[1] - SH - 3))
    return values


def picture(values: np.ndarray, cam_from_local: np.ndarray) -> np.ndarray:
    lens = Lens.of(cam_from_local, K, size=(WIDTH, HEIGHT), near=NEAR)
    return Splat(np.ascontiguousarray(values, np.float32), lens).image


def test_harmonics_are_those_of_splat_files():
    drawn = np.random.default_rng(0).normal(size=(50, 3))
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    np.testing.assert_allclose(harmonics(drawn, 2), reference(torch.from_numpy(drawn)), atol=1e-12)


def test_turned_gaussians_give_the_same_picture(coloured):
    camera = pose(0.3)
    turn = np.eye(4)
    turn[:3, :3] = AXES
    before = picture(coloured, camera)
    assert before[4].mean() > 0.3
    after = picture(turn_gaussians(coloured, AXES), camera @ turn.T)
    np.testing.assert_allclose(after, before, atol=2e-4)


def test_exposed_gaussians_are_as_bright_as_each_camera_has_them(coloured):
    poses = walk(9)
    gains = np.outer(np.linspace(-0.15, 0.15, 9), [1.0, 0.6, -1.0])
    exposures = Exposures(poses, gains, depth=3.0)
    frame = LocalFrame.at([100.0, -20.0, 5.0], AXES)
    count = len(poses)
    cameras = Cameras(
        np.tile(K, (count, 1, 1)), frame.cam_from_world(poses),
        np.full(count, WIDTH), np.full(count, HEIGHT), tuple(map(str, range(count))),
    )  # fmt: skip
    values = coloured.copy()
    # Colours in the middle, which no gain drives out of range.
    values[:, SH + 3 :] *= 0.3
    given = Gaussians(values, frame=frame)
    result = expose(given, exposures, cameras)
    np.testing.assert_array_equal(result.values[:, :SH], values[:, :SH])
    assert result.frame is frame
    errors, without = [], []
    for each in poses:
        plain = picture(values, each)[:3]
        bright = plain * exposures.at(each)[:, None, None]
        errors.append(np.square(picture(result.values, each)[:3] - bright).mean())
        without.append(np.square(plain - bright).mean())
    assert np.mean(errors) < np.mean(without) / 3


@pytest.fixture
def some() -> Gaussians:
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    frame = LocalFrame.at([5e6, -3.0, 0.1], turn * np.sign(np.linalg.det(turn)))
    return Gaussians(rng.normal(size=(7, VALUES)).astype(np.float32), frame=frame)


def test_the_cloud_shares_the_memory_of_the_values(some):
    cloud = some.cloud
    assert set(cloud.point) == set(ATTRIBUTES)
    for name, (first, last, shape) in ATTRIBUTES.items():
        array = cloud.point[name].numpy()
        assert array.shape == (7, *shape)
        mine = some.values[:, first:last]
        # Of Open3D's splats the scales alone are no logarithms.
        expected = np.exp(mine) if name == "scale" else mine
        np.testing.assert_allclose(array.reshape(7, -1), expected, rtol=1e-6)
        assert np.shares_memory(array, some.values) == (name != "scale")
    cloud.point["opacity"][:] = 3.0
    assert (some.values[:, LOGIT] == 3).all()


def test_the_ply_has_the_columns_of_splat_files(tmp_path, some):
    ply = pytest.importorskip("plyfile")
    path = tmp_path / "splats.ply"
    assert o3d.t.io.write_point_cloud(str(path), some.cloud)
    vertex = ply.PlyData.read(path)["vertex"]
    for column, name in enumerate(["x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0",
                                   "rot_1", "rot_2", "rot_3", "opacity", "f_dc_0"]):  # fmt: skip
        np.testing.assert_allclose(vertex[name], some.values[:, column], atol=1e-6, err_msg=name)
    # Splat files have all harmonics of red, then those of green, then those of blue.
    for color in range(3):
        for term in range(8):
            column = some.values[:, SH + 3 + 3 * term + color]
            np.testing.assert_array_equal(vertex[f"f_rest_{8 * color + term}"], column)


def test_round_gaussians_have_the_sizes_and_colours_asked_for():
    red = Gaussians.at([[1, 2, 3]], [[255, 0, 128]], sizes=[0.25])
    assert red.values.dtype == np.float32
    np.testing.assert_allclose(np.exp(red.values[0, 3:6]), 0.25, rtol=1e-6)
    np.testing.assert_array_equal(red.values[0, 6:10], [1, 0, 0, 0])
    assert 1 / (1 + np.exp(-red.values[0, LOGIT])) == pytest.approx(FIRST_OPACITY)
    np.testing.assert_allclose(
        0.5 + HARMONICS[0] * red.values[0, SH : SH + 3], [1, 0, 128 / 255], atol=1e-6
    )
    assert not red.values[0, SH + 3 :].any()


def test_a_file_gives_back_the_same_bytes(tmp_path, some):
    some.save(tmp_path / "some.npz")
    back = Gaussians.load(tmp_path / "some.npz")
    assert back.values.tobytes() == some.values.tobytes()
    assert back.frame.same_as(some.frame)
    assert repr(back) == "Gaussians(7 Gaussians)"


@pytest.mark.parametrize("damage", ["missing", "cut", "text", "flipped", "array"])
def test_a_damaged_file_is_refused_in_one_line(tmp_path, some, damage):
    path = tmp_path / "some.npz"
    some.save(path)
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "array":
        with path.open("wb") as file:
            np.save(file, some.values)
    elif damage == "flipped":
        middle = data.index(b"NUMPY") + 400
        path.write_bytes(data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :])
    else:
        path.write_bytes({"cut": data[: len(data) // 2], "text": b"hello"}[damage])
    with pytest.raises(MemoryFileError, match=r"some\.npz: no readable Gaussians") as error:
        Gaussians.load(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "change",
    [
        {"values": np.zeros((3, VALUES - 1))},
        {"values": np.full((2, VALUES), np.nan)},
        {"axes": np.ones((3, 3))},
        {"origin": None},
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path, change):
    arrays = {"values": np.zeros((2, VALUES)), "origin": np.zeros(3), "axes": np.eye(3), **change}
    path = tmp_path / "other.npz"
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(MemoryFileError, match=r"other\.npz"):
        Gaussians.load(path)
