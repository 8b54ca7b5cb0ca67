# mypy: no-check-untyped-defs
"""RGB-D recordings without poses become projects."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tiny_scan
from command_line import refused
from phone_exports import polycam
from rgbd_walk import FOCAL, HEIGHT, WIDTH, pictures, walk, write_redwood, write_sevenscenes
from rgbd_walk import write_tum as write_tum_walk

from gvtools.cameras import invert_rigid
from gvtools.capture.rgbd_project import capture_rgbd
from gvtools.errors import ProjectError
from gvtools.poses.recording import RgbdFrames, compare, residual, start_from_features
from gvtools.scenes.project import open_project
from gvtools.scenes.rgbd import RgbdOptions, rgbd_scene
from gvtools.scenes.rgbd_layouts import count_unposed, read_unposed
from pipelines.cli import main

COUNT = 12


@pytest.fixture(scope="session")
def walked() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses, pictures and depth of a walk."""
    poses = walk(COUNT)
    return poses, *pictures(poses)


@pytest.fixture(scope="session")
def recording(walked, tmp_path_factory):
    return write_sevenscenes(tmp_path_factory.mktemp("recording") / "room", *walked[1:])


@pytest.fixture(scope="session")
def captured(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("captured_rgbd") / "project"
    assert main(["capture", str(recording), "--out", str(out), "--quiet"]) == 0
    return out


def worst_centre(found: Path, truth: np.ndarray) -> float:
    """Metres, from the first frame on."""
    poses = open_project(found).cameras.world_from_cam
    # The world is the first frame's camera; a straight path cannot be aligned by its centres.
    return float(np.linalg.norm((invert_rigid(truth[0]) @ truth - poses)[:, :3, 3], axis=1).max())


def test_poses_are_found_from_colour_and_depth(walked, recording, captured) -> None:
    poses = walked[0]
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() > 0.8
    assert worst_centre(captured, poses) < 0.01
    scene = open_project(captured)
    assert scene.metric
    # The world is the first frame's camera.
    np.testing.assert_allclose(scene.cameras.world_from_cam[0], np.eye(4), atol=1e-9)
    report = json.loads((captured / "capture.json").read_text())
    assert report["registered"] == list(scene.names)
    assert len(scene) == report["pictures"] == COUNT
    assert report["loops"]
    assert report["residuals"]["median_mm"] < 10
    assert (captured / "capture.png").stat().st_size > 10_000
    for path in recording.glob("frame-*"):
        assert (captured / path.name).read_bytes() == path.read_bytes()
    assert not list(captured.parent.glob(".*"))
    # All their digits are kept.
    pose = np.loadtxt(captured / "frame-000005.pose.txt")
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)


def test_a_tum_recording_keeps_its_depth_unit_and_its_order(walked, tmp_path) -> None:
    poses, rgb, depth = walked
    source = write_tum_walk(tmp_path / "recording", rgb[:4], depth[:4])
    assert count_unposed(source) == 4
    with pytest.raises(ProjectError, match=r"4 RGB-D frames without poses; .* gvtools capture"):
        open_project(source)
    report = capture_rgbd(source, tmp_path / "project")
    assert worst_centre(tmp_path / "project", poses[:4]) < 0.01
    first = open_project(tmp_path / "project").views[0].load()
    assert first.depth is not None
    np.testing.assert_allclose(first.depth, depth[0] / 1000, atol=1e-3)
    np.testing.assert_array_equal(first.rgb, rgb[0])
    assert report.sources["frame-000001.color.png"] == "rgb/1000.033333.png"


def test_a_depth_camera_of_its_own_and_given_intrinsics_go_into_the_project(walked, tmp_path):
    source = write_redwood(tmp_path / "recording", walked[1][:3], walked[2][:3])
    np.savetxt(tmp_path / "moved.txt", np.eye(4))
    K = f"{FOCAL},{FOCAL},{WIDTH / 2 - 0.5},{HEIGHT / 2 - 0.5}"
    out = tmp_path / "project"
    given = ["--color-intrinsics", K, "--depth-intrinsics", K]
    given += ["--color-from-depth", str(tmp_path / "moved.txt"), "--depth-max", "6"]
    assert main(["capture", str(source), "--out", str(out), "--quiet", *given]) == 0
    assert worst_centre(out, walked[0][:3]) < 0.01
    sidecar = json.loads((out / "rgbd.json").read_text())
    assert sidecar["depth_K"][0][0] == FOCAL
    assert sidecar["depth_max"] == 6
    assert sidecar["color_from_depth"] == np.eye(4).tolist()
    np.testing.assert_allclose(
        open_project(out).cameras.K[0],
        np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], float),
    )


def test_distortion_reaches_the_project(walked, tmp_path) -> None:
    poses = walked[0]
    source = write_sevenscenes(tmp_path / "recording", walked[1][:3], walked[2][:3])
    lens = [0.02, -0.01, 0.001, -0.001, 0.0]
    (source / "rgbd.json").write_text(json.dumps({"distortion": lens}))
    capture_rgbd(source, tmp_path / "project")
    assert json.loads((tmp_path / "project/rgbd.json").read_text())["distortion"] == lens
    assert any("undistort" in item.message for item in open_project(tmp_path / "project").findings)
    assert worst_centre(tmp_path / "project", poses[:3]) < 0.03


def test_frames_that_do_not_connect_are_left_out_and_named(walked, tmp_path, capsys) -> None:
    poses, rgb, depth = walked
    rgb, depth = rgb[:6].copy(), depth[:6].copy()
    # Something that covers the lens.
    rgb[4], depth[4] = np.random.default_rng(0).integers(0, 255, rgb[4].shape), 350
    source = write_sevenscenes(tmp_path / "recording", rgb, depth)
    assert main(["capture", str(source), "--out", str(tmp_path / "project")]) == 0
    assert "1 of 6 frames could not be connected" in "".join(capsys.readouterr())
    report = json.loads((tmp_path / "project/capture.json").read_text())
    assert list(report["left_out"]) == ["frame-000004.color.png"]
    assert not (tmp_path / "project/frame-000004.color.png").exists()
    assert worst_centre(tmp_path / "project", poses[[0, 1, 2, 3, 5]]) < 0.01


def test_frames_that_cannot_be_read_are_left_out_and_named(walked, tmp_path, capsys) -> None:
    root = write_sevenscenes(tmp_path / "room", *(part[:6] for part in walked[1:]))
    colors, depths = sorted(root.glob("*.color.*")), sorted(root.glob("*.depth.png"))
    depths[2].write_bytes(depths[2].read_bytes()[:200])
    colors[4].write_bytes(b"")
    assert main(["capture", str(root), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert "2 of 6 frames have a picture or depth map that cannot be read" in said.out + said.err
    kept = [colors[index].name for index in (0, 1, 3, 5)]
    assert list(open_project(tmp_path / "out").names) == kept
    for path in colors[1:]:
        path.write_bytes(b"")
    line = refused(capsys, "capture", root, "--out", tmp_path / "none")
    assert "5 of 6 frames" in line and "copy these again" in line


def test_features_start_pairs_that_motion_alone_does_not(walked, recording) -> None:
    poses = walked[0]
    found = read_unposed(recording, RgbdOptions())
    assert found is not None
    frames = RgbdFrames(rgbd_scene(found))
    far = COUNT // 2
    truth = {0: poses[0], far: poses[far]}
    start = start_from_features(frames, far, 0)
    assert start is not None
    pair = compare(frames, far, 0, start=start)
    assert pair is not None
    shift, turn = residual(pair, truth)
    assert shift < 15
    assert turn < 0.5
    # What is turned away by far does not agree by chance.
    away = np.diag([-1.0, 1, -1, 1]) @ (invert_rigid(poses[0]) @ poses[far])
    assert compare(frames, far, 0, start=away) is None


def test_a_flat_wall_does_not_let_the_camera_slide(tmp_path) -> None:
    """All of the wall's depth agrees with any shift: colour alone tells the motion."""
    truth = np.tile(np.eye(4), (5, 1, 1))
    truth[:, 0, 3] = 1.5 + 0.03 * np.arange(5)
    rgb, depth = zip(*(tiny_scan.render(pose) for pose in truth), strict=True)
    assert np.ptp(depth) == 0
    # Without noise nothing at all would move depth sideways.
    noisy = np.stack(depth) + np.random.default_rng(0).normal(0, 0.01, np.shape(depth))
    source = write_sevenscenes(
        tmp_path / "scan", np.stack(rgb), np.rint(noisy * 1000).astype(np.uint16)
    )
    np.savetxt(source / "camera-intrinsics.txt", tiny_scan.INTRINSICS)
    capture_rgbd(source, tmp_path / "project")
    assert worst_centre(tmp_path / "project", truth) < 0.01


def test_what_cannot_be_captured_is_refused(walked, recording, captured, tmp_path, capsys) -> None:
    out, (_, rgb, depth) = tmp_path / "out", walked
    photographs, bag = tmp_path / "photographs", tmp_path / "damaged.bag"
    photographs.mkdir()
    (photographs / "a.jpg").write_bytes((recording / "frame-000000.color.png").read_bytes())
    polycam(tmp_path / "walk")
    single = write_sevenscenes(tmp_path / "single", rgb[:1], depth[:1])
    alone = write_sevenscenes(tmp_path / "alone", rgb[:1], depth[:1])
    (alone / "camera-intrinsics.txt").unlink()
    blind = np.stack([depth[0], np.zeros_like(depth[0])])
    strange = write_sevenscenes(tmp_path / "strange", rgb[:2], blind)
    bag.write_bytes(bytes(1000))
    for said, source, *more in (
        ("has poses already", captured),
        ("has poses already; expected a recording without; give it to", tmp_path / "walk"),
        ("--frames: of photographs", recording, "--frames", 5),
        ("no folder of colour and depth", photographs, "--depth-unit", 0.001),
        ("1 frames with picture and depth", single),
        ("no camera-intrinsics.txt", alone),
        ("no two of 2 frames agree", strange),
        ("Open3D cannot read it", bag),
    ):
        assert said in refused(capsys, "capture", source, *more, "--out", out)
    line = refused(capsys, "check", recording)
    assert "12 RGB-D frames without poses; find the cameras first: gvtools capture" in line
    assert not out.exists()
    assert not list(tmp_path.glob(".*"))


@pytest.mark.data
def test_redwood_frames_are_placed_to_a_centimetre(shared, tmp_path) -> None:
    source = shared / "data" / "redwood_rgbd5"
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    for name in ("color", "depth", "camera_primesense.json"):
        (hidden / name).symlink_to(source / name)
    capture_rgbd(hidden, tmp_path / "project")
    assert worst_centre(tmp_path / "project", open_project(source).cameras.world_from_cam) < 0.01
