"""Poses of another form than the file's, and depth registered into another camera."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walls import blotches, camera_at, photograph, write_project

from gvtools.cameras import Cameras, invert_rigid, rigid_poses
from gvtools.scenes.pose_forms import pose_findings
from gvtools.scenes.project import open_project
from gvtools.scenes.registration import register_depth

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


def said(file, change=lambda frames: None, **shared):
    """What is said of a project, its frames changed."""
    data = json.loads(file.read_text()) | shared
    change(data["frames"])
    changed = file.with_name("changed.json")
    changed.write_text(json.dumps(data))
    return [item.message for item in pose_findings(open_project(changed))]


def posed(change):
    """Frames with other matrices."""

    def changed(frames):
        for frame in frames:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    return changed


def zoomed(times, rows=slice(None)):
    """Frames of which some have other focal lengths."""

    def changed(frames):
        for frame in frames[rows]:
            frame |= {key: times * frame[key] for key in ("fl_x", "fl_y")}

    return changed


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
    found = said(room, posed(change))
    assert len(found) == (reason is not None)
    assert all("do not fit the photographs" in line and reason in line for line in found)


def renumbered(frames):
    paths = [frame["file_path"] for frame in frames]
    for frame, path in zip(frames, [*paths[1:], paths[0]], strict=True):
        frame["file_path"] = path


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (renumbered, "each fits the pose of the next one"),
        (zoomed(1.2, slice(1, None, 2)), "focal lengths of "),
        (zoomed(0.85, slice(1, None, 3)), "focal lengths of "),
    ],
)
def test_pictures_and_focal_lengths_of_other_frames(room, change, reason):
    (found,) = said(room, change)
    assert reason in found


def project(folder, places, *, scale=1.0):
    """Views of the room from three places, of which nothing is said."""
    textures = [blotches(np.random.default_rng(3 + wall)) for wall in range(3)]
    cameras = [camera_at(a, turn=t, scale=scale, name=f"{a[0]:.1f}.png") for a, t in places]
    file = write_project(folder / "room", [photograph(each, textures) for each in cameras])
    assert said(file) == []
    return file


def test_axes_of_cameras_that_go_sideways(tmp_path):
    # Epipolar lines are nearly those of the other axes; what is seen lies behind these cameras.
    file = project(tmp_path, [((0.5 * i - 0.5, 0, 0), (0, 6 - 6 * i, 0)) for i in range(3)])
    (found,) = said(file, posed(lambda pose: pose @ FLIP))
    assert "taken for each other" in found


def test_focal_lengths_of_pictures_that_were_cropped(tmp_path):
    places = [
        ((0.5 * i - 1.2, -0.2 * i, 0.35 * i), (5 * i - 5, 25 - 22 * i, 8 * i)) for i in range(3)
    ]
    file = project(tmp_path, places, scale=1.6)
    for found, told in ((said(file, zoomed(0.8)), "lengths +2"), (said(file, k1=0.3), "k1 +0.")):
        assert "another lens fits" in found[0] and told in found[0]


DEPTH_K = np.array([[100.0, 0, 64.5], [0, 100, 48.5], [0, 0, 1]])
COLOR_K = np.array([[90.0, 0, 63], [0, 91, 47], [0, 0, 1]])
SIZE = (96, 128)


def turned(degrees, translation):
    matrix = np.eye(4)
    turns = Rotation.from_euler("YZ", [degrees / 2, degrees], degrees=True)
    matrix[:3, :3], matrix[:3, 3] = turns.as_matrix(), translation
    return matrix


def plane_depth(K, cam_from_plane_frame, normal, offset, size):
    """z-depth of the plane normal . X = offset, given in the depth camera's frame."""
    height, width = size
    rays = Cameras.alike(K, np.eye(4), size=(width, height)).rays()
    rotation, shift = cam_from_plane_frame[:3, :3], cam_from_plane_frame[:3, 3]
    n = rotation @ normal
    return (offset + n @ shift) / (rays @ n)


@pytest.mark.parametrize("degrees", [0, 3, 12])
@pytest.mark.parametrize("normal", [(0, 0, 1), (0.4, -0.2, 1), (0, 1.2, 0.5)])
@pytest.mark.parametrize("zoom", [1, 2.5])
def test_a_plane_stays_a_closed_plane(degrees, normal, zoom):
    normal = np.array(normal, float) / np.linalg.norm(normal)
    move = turned(degrees, (-0.05, 0.02, 0.03))
    depth = plane_depth(DEPTH_K, np.eye(4), normal, 2.0, SIZE)
    seen = (depth > 0.3) & (depth < 12)
    depth = np.where(seen, depth, 0).astype(np.float32)
    K = COLOR_K * np.array([[zoom], [zoom], [1]])
    size = (int(SIZE[0] * zoom), int(SIZE[1] * zoom))
    result = register_depth(depth, DEPTH_K, K, color_from_depth=move, width=size[1], height=size[0])
    expected = plane_depth(K, move, normal, 2.0, size)
    filled = result > 0
    assert filled.mean() > 0.3
    np.testing.assert_allclose(result[filled], expected[filled], rtol=0.06)
    # Every colour pixel whose surface point was measured, well inside, has to be filled.
    height, width = size
    rays = Cameras.alike(K, np.eye(4), size=(width, height)).rays()
    points = (rays * expected[..., None]).reshape(-1, 3)
    back = invert_rigid(move)
    local = (points @ back[:3, :3].T + back[:3, 3]) @ DEPTH_K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        column = np.floor(local[:, 0] / local[:, 2]).reshape(size)
        row = np.floor(local[:, 1] / local[:, 2]).reshape(size)
    inside = (column >= 1) & (column < SIZE[1] - 1) & (row >= 1) & (row < SIZE[0] - 1)
    inside &= (expected > 0) & (local[:, 2] > 0).reshape(size)
    core = np.zeros(SIZE, bool)
    core[1:-1, 1:-1] = (
        seen[1:-1, 1:-1] & seen[:-2, 1:-1] & seen[2:, 1:-1] & seen[1:-1, :-2] & seen[1:-1, 2:]
    )
    measured = np.zeros(size, bool)
    measured[inside] = core[row[inside].astype(int), column[inside].astype(int)]
    assert measured.sum() > 1000
    steep = np.abs(normal[2]) < 0.5  # has neighbours farther apart than one surface allows
    if steep:
        assert filled[measured].mean() > 0.98
        assert np.median(np.abs(result - expected)[filled & measured]) < 1e-4
    else:
        assert filled[measured].all()
        np.testing.assert_allclose(result[measured], expected[measured], rtol=1e-5)


def test_silhouette_neither_grows_nor_leaks():
    depth = np.full(SIZE, 4.0, np.float32)
    depth[30:70, 40:90] = 1.5
    shift = rigid_poses(np.eye(3), (-0.06, 0, 0))
    result = register_depth(
        depth, DEPTH_K, DEPTH_K, color_from_depth=shift, width=SIZE[1], height=SIZE[0]
    )
    # Both planes face the cameras, so each only shifts, by f * b / z = 4 and 1.5 pixels.
    front = np.zeros(SIZE, bool)
    front[30:70, 36:86] = True
    np.testing.assert_allclose(result[front], 1.5, rtol=1e-6)
    assert (np.abs(result[~front] - 1.5) > 1).all()
    # What the square hid from the depth camera stays empty: columns 86 to 88.
    assert (result[30:70, 86:88] == 0).all()
    np.testing.assert_allclose(result[30:70, 89:126], 4, rtol=1e-6)
    assert (result[:, 127:] == 0).all()


def test_nothing_behind_the_camera():
    behind = rigid_poses(np.eye(3), (0, 0, -10))
    depth = np.full(SIZE, 2.0)
    result = register_depth(
        depth, DEPTH_K, DEPTH_K, color_from_depth=behind, width=SIZE[1], height=SIZE[0]
    )
    assert not result.any()
