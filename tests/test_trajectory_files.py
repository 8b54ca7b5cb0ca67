from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from trajectory_writers import write_kitti, write_tum

from gvtools.cameras import Cameras, invert_rigid, rigid_poses
from gvtools.errors import ProjectError
from gvtools.trajectory_files import read_poses, read_trajectory


def _cameras(count: int = 6, names: tuple[str, ...] = ()) -> Cameras:
    rng = np.random.default_rng(0)
    turns = Rotation.random(count, rng=rng).as_matrix()
    pose = invert_rigid(rigid_poses(turns, rng.standard_normal((count, 3)) * 1e6))
    K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    return Cameras.alike(K, pose, size=(640, 480), names=names)


@pytest.mark.parametrize(("layout", "write"), [("tum", write_tum), ("kitti", write_kitti)])
def test_poses_are_read_as_they_were_written(tmp_path, layout, write):
    cameras = _cameras()
    write(tmp_path / "path.txt", cameras)
    for asked in (layout, "auto"):
        again = read_trajectory(tmp_path / "path.txt", cameras[0], layout=asked)
        np.testing.assert_allclose(again.centers, cameras.centers, rtol=1e-13)
        np.testing.assert_allclose(
            again.cam_from_world[:, :3, :3], cameras.cam_from_world[:, :3, :3], atol=1e-14
        )
        assert np.array_equal(again.K, cameras.K)
        assert again.width.tolist() == [640] * 6


def test_intrinsics_are_matched_row_by_row_or_taken_from_the_first(tmp_path):
    cameras = _cameras(3)
    cameras.K[:, 0, 0] = (400, 500, 600)
    path = tmp_path / "path.txt"
    write_tum(path, cameras)
    assert read_trajectory(path, cameras).K[:, 0, 0].tolist() == [400, 500, 600]
    assert read_trajectory(path, cameras[:2]).K[:, 0, 0].tolist() == [400, 400, 400]


def test_the_scenes_cameras_tell_the_order_of_quaternions(tmp_path):
    cameras = _cameras(12)
    write_tum(tmp_path / "last.txt", cameras)
    lines = [line.split() for line in (tmp_path / "last.txt").read_text().splitlines()]
    rows = [" ".join([*words[:4], words[7], *words[4:7]]) for words in lines if words[0] != "#"]
    first, named = tmp_path / "first.txt", tmp_path / "named.txt"
    first.write_text("\n".join(rows))
    named.write_text("\n".join(["# time tx ty tz qw qx qy qz", *rows]))
    with pytest.raises(ProjectError, match=r"with the scalar first 0; name the columns"):
        read_trajectory(first, cameras[0], beside=cameras)
    for path in (tmp_path / "last.txt", named):
        read = read_trajectory(path, cameras[0], beside=cameras)
        np.testing.assert_allclose(read.world_from_cam, cameras.world_from_cam, atol=1e-9)


@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("cm", 0.01), ("m", 1.0)])
def test_places_in_the_unit_that_the_head_names(tmp_path, unit, metres):
    file = tmp_path / "path.csv"
    head = f"time [s], x [{unit}], y [{unit}], z [{unit}], qx, qy, qz, qw\n"
    file.write_text(head + "0, 100, 200, 300, 0, 0, 0, 1\n1, 100, 200, 400, 0, 0, 0, 1\n")
    track = read_poses(file)
    np.testing.assert_allclose(track.poses[1, :3, 3], metres * np.array([100, 200, 400]))
    assert any("read as m" in note for note in track.notes) == (unit != "m")


def test_a_path_goes_in_the_order_of_its_times(tmp_path):
    write_tum(tmp_path / "a.txt", _cameras())
    lines = (tmp_path / "a.txt").read_text().splitlines()
    (tmp_path / "b.txt").write_text("\n".join([*lines[3:], *lines[:3]]))
    given, found = (read_trajectory(tmp_path / name, _cameras()[0]) for name in ("a.txt", "b.txt"))
    assert found.names == given.names
    np.testing.assert_array_equal(found.cam_from_world, given.cam_from_world)


def test_repeated_timestamps_get_names_of_their_own(tmp_path):
    path = tmp_path / "path.txt"
    path.write_text("".join(f"7.5 {x} 0 0 0 0 0 1\n" for x in range(3)), encoding="ascii")
    read = read_trajectory(path, _cameras(1))
    assert read.names == ("7.5", "7.5_1", "7.5_2")
    np.testing.assert_allclose(read.centers[:, 0], [0, 1, 2])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no poses"),
        ("1 2 3\n", r":1: 3 numbers"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", r":2: 7 numbers; expected 8"),
        ("1 0 0 0 0 0 0 1\n\n2 0 0 x 0 0 0 1\n", r":3: could not convert.*'x'"),
        ("1 0 0 0 0 0 0 2\n", r":1: a quaternion of length 2"),
        ("1 0 0 nan 0 0 0 1\n", r":1: NaN"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n", r":1: the pose's 3x3 part is no rotation \(scale 2"),
    ],
)
def test_wrong_files_are_refused_with_the_line(tmp_path, text, words):
    path = tmp_path / "path.txt"
    path.write_text(text, encoding="ascii")
    with pytest.raises(ProjectError, match=words):
        read_trajectory(path, _cameras(1))
    with pytest.raises(ProjectError, match="null"):
        read_poses("a\0b")
