"""Poses of another form than the file's are told from the photographs of scenes without tracks."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walls import blotches, camera_at, photograph, write_project

from gvtools.scenes.pose_forms import pose_findings
from gvtools.scenes.project import open_project

FLIP, MIRROR = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([1.0, 1.0, -1.0, 1.0])


def rolled(pose):
    """A camera-to-world pose whose quaternion w, x, y, z is read as x, y, z, w."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    changed = pose.copy()
    changed[:3, :3] = Rotation.from_quat([w, x, y, z]).as_matrix()
    return changed


@pytest.fixture(scope="module")
def room(wall_walk, tmp_path_factory):
    """Six views without tracks: ``transforms.json``."""
    return write_project(tmp_path_factory.mktemp("room") / "room", wall_walk[:6])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda pose: pose, None),
        (lambda pose: pose @ FLIP, "taken for each other"),
        (np.linalg.inv, "invert them"),
        (lambda pose: np.linalg.inv(pose @ FLIP), "invert them"),
        (lambda pose: rolled(pose @ FLIP) @ FLIP, "have the scalar first"),
        (lambda pose: MIRROR @ pose @ MIRROR, "left-handed"),
    ],
)
def test_the_form_of_poses_is_told_by_the_photographs(room, change, reason):
    data = json.loads(room.read_text())
    for frame in data["frames"]:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    file = room.with_name("changed.json")
    file.write_text(json.dumps(data))
    found = [item.message for item in pose_findings(open_project(file))]
    assert len(found) == (reason is not None)
    assert all("do not fit the photographs" in line and reason in line for line in found)


def test_axes_of_cameras_that_go_sideways(tmp_path):
    # Epipolar lines are nearly those of the other axes; what is seen lies behind these cameras.
    textures = [blotches(np.random.default_rng(3 + wall)) for wall in range(3)]
    places = [((0.5 * i - 0.5, 0, 0), (0, 6 - 6 * i, 0)) for i in range(3)]
    cameras = [camera_at(at, turn=turn, name=f"{at[0]:.1f}.png") for at, turn in places]
    file = write_project(tmp_path / "room", [photograph(each, textures) for each in cameras])
    assert pose_findings(open_project(file)) == []
    data = json.loads(file.read_text())
    for frame in data["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ FLIP).tolist()
    file.write_text(json.dumps(data))
    (found,) = pose_findings(open_project(file))
    assert "taken for each other" in found.message


def test_focal_lengths_of_pictures_that_were_cropped(tmp_path):
    textures = [blotches(np.random.default_rng(3 + wall)) for wall in range(3)]
    places = [
        ((0.5 * i - 1.2, -0.2 * i, 0.35 * i), (5 * i - 5, 25 - 22 * i, 8 * i)) for i in range(3)
    ]
    cameras = [camera_at(at, turn=turn, scale=1.6, name=f"{at[0]:.1f}.png") for at, turn in places]
    file = write_project(tmp_path / "room", [photograph(each, textures) for each in cameras])
    assert pose_findings(open_project(file)) == []
    data = json.loads(file.read_text())
    (file.parent / "bent.json").write_text(json.dumps({**data, "k1": 0.3}))
    for frame in data["frames"]:
        frame |= {key: 0.8 * frame[key] for key in ("fl_x", "fl_y")}
    file.write_text(json.dumps(data))
    for path, said in ((file, "focal lengths +2"), (file.parent / "bent.json", "k1 +0.")):
        (found,) = pose_findings(open_project(path))
        assert "another lens fits" in found.message and said in found.message
