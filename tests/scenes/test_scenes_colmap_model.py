# mypy: no-check-untyped-defs
from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from scenes_workspace import workspace

from gvtools.cameras import Cameras
from gvtools.errors import GvError, ProjectError
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.images import read_depth, stored_depth_size, write_depth_map
from gvtools.scenes.inspection import reprojection_errors

VIEWS, POINTS = 5, 60


def one_line(error: pytest.ExceptionInfo[BaseException]) -> str:
    message = str(error.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("change", ["cut", "grown", "empty", "absurd count"])
def test_truncated_or_oversized_binary_file_is_refused(tmp_path, name, change):
    rigged = name in ("rigs", "frames")
    if rigged and change == "grown":
        return  # what follows the last record there does no harm
    workspace(tmp_path)
    path = tmp_path / "sparse/0" / f"{name}.bin"
    data = path.read_bytes()
    many = struct.pack("<Q", 2**40) + data[8:]
    changed = {"cut": data[:-5], "grown": data + b"\0" * 7, "empty": b"", "absurd count": many}
    path.write_bytes(changed[change])
    with pytest.raises(ProjectError) as error:
        read_colmap(tmp_path)
    assert rigged or name in one_line(error)
    assert change in ("cut", "grown") or "records that its head" in one_line(error)


@pytest.mark.parametrize(
    ("name", "pattern", "replacement", "told"),
    [
        ("images", r"^1 \S+ ", "1 ", "images.txt is malformed"),
        ("images", r"^1 \S+ ", "1 word ", "images.txt is malformed"),
        # A lost line: what is read as an image is a line of points.
        ("images", r"^1 .*\n", "", "damaged"),
        ("images", r"^1 ", "1e999 ", "images.txt is malformed"),
        ("cameras", r"^1 SIMPLE_RADIAL 96 72", "1 SIMPLE_RADIAL 96", "as many parameters"),
        ("cameras", r"SIMPLE_RADIAL", "SIMPEL_RADIAL", "Camera model does not exist"),
        ("cameras", r" -0\.1\S+", "", "as many parameters"),
        ("points3D", r"^1 \S+ \S+ \S+ .*$", "1 2 3", "3 values; expected id"),
        # One number less: pycolmap would read the others shifted.
        ("points3D", r"^1 \S+ ", "1 ", "values; expected id"),
    ],
)
def test_malformed_text_model_names_the_file(tmp_path, name, pattern, replacement, told):
    workspace(tmp_path, text=True, classic=True)
    path = tmp_path / "sparse/0" / f"{name}.txt"
    text, count = re.subn(pattern, replacement, path.read_text(), count=1, flags=re.MULTILINE)
    assert count == 1
    path.write_text(text)
    with pytest.raises(ProjectError, match=told) as error:
        read_colmap(tmp_path)
    one_line(error)


@pytest.mark.parametrize("count", [4, 5])
def test_text_model_without_point_lines_does_not_lose_every_second_image(tmp_path, count):
    workspace(tmp_path, text=True, classic=True)
    path = tmp_path / "sparse/0/images.txt"
    lines = [line for line in path.read_text().splitlines() if line.endswith(".png")]
    path.write_text("\n".join((lines * 2)[:count]) + "\n")
    (path.parent / "points3D.txt").write_text("")
    with pytest.raises(ProjectError, match="two lines"):
        read_colmap(tmp_path)


def test_points_cut_off_at_a_line_end_are_noticed(tmp_path):
    workspace(tmp_path, text=True)
    path = tmp_path / "sparse/0/points3D.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-3]))
    with pytest.raises(ProjectError, match="points that points3D does not hold"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("name", "offset", "value", "told"),
    [
        ("points3D", 8 + 8, np.inf, "1 sparse points hold NaN or infinity: dropped"),
        ("images", 8 + 4 + 4 * 8, np.nan, "1 of 4 images have NaN, .*: dropped"),  # tx of the first
        ("cameras", 8 + 24, np.nan, r"camera 1: SIMPLE_RADIAL 96x72 .* NaN|as many parameters"),
    ],
)
@pytest.mark.parametrize("text", [False, True])
def test_numbers_that_are_not_finite(tmp_path, name, offset, value, told, text):
    workspace(tmp_path, classic=True, text=text)
    path = tmp_path / f"sparse/0/{name}.{'txt' if text else 'bin'}"
    if text:
        lines = path.read_text().splitlines()
        row = next(i for i, line in enumerate(lines) if not line.startswith("#"))
        words = lines[row].split()
        words[{"points3D": 1, "images": 5, "cameras": 4}[name]] = str(value)
        path.write_text("\n".join([*lines[:row], " ".join(words), *lines[row + 1 :], ""]))
    else:
        data = bytearray(path.read_bytes())
        struct.pack_into("<d", data, offset, value)
        path.write_bytes(data)
    if name == "cameras":
        with pytest.raises(GvError, match=told):
            read_colmap(tmp_path)
        return
    scene = read_colmap(tmp_path)
    assert len(scene) == (3 if name == "images" else 4)
    assert any(re.match(told, finding.message) for finding in scene.findings)
    assert np.nanmax(reprojection_errors(scene)) < 1


@pytest.mark.parametrize("classic", [False, True])
@pytest.mark.parametrize(("stretch", "told"), [(2.0, "no rotation"), (1.0005, None)])
def test_quaternion_of_another_length(tmp_path, classic, stretch, told):
    reconstruction = workspace(tmp_path, classic=classic)
    pose = reconstruction.images[1].cam_from_world()
    stored = pose.rotation.quat[[3, 0, 1, 2]]  # pycolmap has x, y, z, w
    path = tmp_path / "sparse/0" / ("images.bin" if classic else "frames.bin")
    data = path.read_bytes()
    assert struct.pack("<4d", *stored) in data
    path.write_bytes(
        data.replace(struct.pack("<4d", *stored), struct.pack("<4d", *stretch * stored))
    )
    if told:
        with pytest.raises(GvError, match=told):
            read_colmap(tmp_path)
        return
    scene = read_colmap(tmp_path)
    assert any("1 of 4 rotations made orthonormal" in item.message for item in scene.findings)
    camera = scene[reconstruction.images[1].name].camera
    np.testing.assert_allclose(camera.cam_from_world[0, :3], pose.matrix(), atol=1e-9)


def test_no_model_no_image_and_half_a_model(tmp_path):
    import pycolmap

    with pytest.raises(ProjectError, match="no COLMAP model"):
        read_colmap(tmp_path)
    (tmp_path / "empty").mkdir()
    pycolmap.Reconstruction().write_binary(tmp_path / "empty")
    with pytest.raises(ProjectError, match="no registered image among 0"):
        read_colmap(tmp_path / "empty")
    workspace(tmp_path)
    (tmp_path / "sparse/0/frames.bin").unlink()
    with pytest.raises(ProjectError, match=r"rigs\.bin without frames\.bin"):
        read_colmap(tmp_path)
    (tmp_path / "sparse/0/points3D.bin").unlink()
    with pytest.raises(ProjectError, match="incomplete model"):
        read_colmap(tmp_path)


def test_depth_map_round_trip_is_what_pycolmap_reads(tmp_path):
    import pycolmap

    depth = np.random.default_rng(0).uniform(0.5, 9, (7, 11)).astype(np.float32)
    write_depth_map(tmp_path / "deep" / "a.bin", depth)
    peer = pycolmap.DepthMap()
    peer.read(tmp_path / "deep" / "a.bin")
    np.testing.assert_array_equal(peer.to_array(), depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "deep" / "a.bin"), depth)
    assert stored_depth_size(tmp_path / "deep" / "a.bin") == (11, 7)
    pycolmap.DepthMap.from_array(depth, 0, 10).write(tmp_path / "b.bin")
    np.testing.assert_array_equal(read_depth(tmp_path / "b.bin"), depth)


def test_depth_map_without_readings_and_damaged_ones(tmp_path):
    path = tmp_path / "a.bin"
    write_depth_map(path, [[1, -1, np.nan, np.inf, 0]])
    np.testing.assert_array_equal(read_depth(path), [[1, 0, 0, 0, 0]])
    data = path.read_bytes()
    for damaged in (data[:-1], data + b"\0", b"9999999&9999999&1&", b"nothing", b""):
        path.write_bytes(damaged)
        with pytest.raises(ProjectError) as error:
            read_depth(path)
        assert "a.bin" in one_line(error)


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
