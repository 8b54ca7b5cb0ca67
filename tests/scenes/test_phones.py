"""Exports of phone apps: pose, pixel and depth as they were written, and each app's traps."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from data_sets.miniature import Expected, compare
from phone_exports import polycam, record3d, record3d_export, scanner_app, stray_scanner
from PIL import Image
from scenes_workspace import messages

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.images import frame_seconds, read_frame
from gvtools.scenes.inspection import inspect
from gvtools.scenes.project import is_project, open_project
from gvtools.scenes.rgbd import RgbdOptions

Write = Callable[[Path], Expected]
EXPORTS: dict[str, tuple[str, Write, str]] = {
    "r3d": ("Record3D", record3d, "scan.r3d"),
    "r3d, one K": ("Record3D", lambda path: record3d(path, per_frame=False), "scan.r3d"),
    "EXR": ("Record3D", record3d_export, "scan"),
    "corrected": ("Polycam", polycam, "scan"),
    "recorded": ("Polycam", lambda path: polycam(path, corrected=False), "scan"),
    "all data": ("3D Scanner App", scanner_app, "scan"),
    "lenses": ("Stray Scanner", stray_scanner, "scan"),
    "one matrix": ("Stray Scanner", lambda path: stray_scanner(path, lenses=False), "scan"),
}


@pytest.mark.parametrize("export", EXPORTS)
def test_an_export_is_recognised_and_read_back(export: str, tmp_path: Path) -> None:
    kind, write, place = EXPORTS[export]
    expected = write(tmp_path / place)
    assert is_project(tmp_path / place)
    scene = open_project(tmp_path / place)
    assert scene.kind == kind
    compare(scene, expected)
    report = inspect(scene)
    assert report.kind == kind
    assert report.ok, report.findings
    assert all(file.is_file() for view in scene for file in view.files)
    assert "sky" not in messages(scene)
    for options in ({"images": tmp_path}, {"masks": tmp_path}, {"rgbd": RgbdOptions()}):
        with pytest.raises(OptionError, match=f"export of {kind} says how it is read"):
            open_project(tmp_path / place, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("export", "pattern"),
    [
        ("EXR", "EXR_RGBD/rgb/*.jpg"),
        ("corrected", "keyframes/corrected_images/*.jpg"),
        ("recorded", "keyframes/images/*.jpg"),
        ("all data", "frame_*.jpg"),
    ],
)
def test_frames_whose_picture_is_absent_or_damaged_are_left_out(export, pattern, tmp_path):
    _, write, place = EXPORTS[export]
    write(tmp_path / place)
    pictures = sorted((tmp_path / place).glob(pattern))
    pictures[1].write_bytes(b"\xff\xd8\xff")
    pictures[2].write_bytes(b"")
    scene = open_project(tmp_path / place)
    assert len(scene) == 2
    assert "1 of 4 frames have a damaged picture: dropped" in messages(scene)
    assert "1 of 4 frames have no picture: dropped" in messages(scene)
    for view in scene:
        view.load()


# --- Stray Scanner ----------------------------------------------------------------------------


def test_stray_players_shift_the_video_by_the_frame_that_its_edit_list_hides(tmp_path):
    rgb = stray_scanner(tmp_path).rgb
    video = tmp_path / "rgb.mp4"
    assert rgb is not None
    assert len(frame_seconds(video)) == len(rgb) - 1
    np.testing.assert_array_equal(read_frame(video, seconds=0).rgb, rgb[1])
    seconds = frame_seconds(video, edits=False)
    assert len(seconds) == len(rgb)
    for time, picture in reversed(list(zip(seconds, rgb, strict=True))):
        got = read_frame(video, seconds=time, edits=False).rgb
        np.testing.assert_array_equal(got, picture)


def test_stray_gaps_and_a_cut_off_last_row(tmp_path: Path) -> None:
    expected = stray_scanner(tmp_path)
    (tmp_path / "depth" / "000002.png").unlink()
    (tmp_path / "confidence" / "000003.png").unlink()
    table = tmp_path / "odometry.csv"
    lines = table.read_text().splitlines()
    del lines[2]  # of frame 1
    cut = lines[-1].split(",")
    table.write_text("\n".join([*lines[:-1], ",".join(cut[:6])]))
    scene = open_project(tmp_path)
    assert scene.names == ("000000", *(f"{i:06d}" for i in range(2, 7)))
    assert [view.has_depth for view in scene] == [True, False, True, True, True, True]
    assert expected.rgb is not None
    # The number counts, not the row: the video has all of the frames.
    for view in scene:
        np.testing.assert_array_equal(view.load().rgb, expected.rgb[int(view.name)])
    bare = scene["000003"].load().depth
    assert bare is not None
    assert (bare > 0).all()
    assert "1 of 7 frames have no pose: dropped (000007)" in messages(scene)
    assert "1 of 6 depth maps have no confidence map" in messages(scene)
    assert "rgb.mp4 has 8 frames for 7 poses" in messages(scene)


def test_stray_without_rows_or_a_video(tmp_path: Path) -> None:
    stray_scanner(tmp_path)
    text = (tmp_path / "odometry.csv").read_text()
    (tmp_path / "odometry.csv").write_text(text.splitlines()[0])
    with pytest.raises(ProjectError, match="no row with a frame number"):
        open_project(tmp_path)
    (tmp_path / "odometry.csv").write_text(text)
    (tmp_path / "rgb.mp4").write_bytes(b"none")
    with pytest.raises(ProjectError, match="expected a whole video"):
        open_project(tmp_path)


# --- 3D Scanner App ---------------------------------------------------------------------------


def test_scanner_app_records_more_frames_than_pictures(tmp_path: Path) -> None:
    scanner_app(tmp_path)
    (tmp_path / "frame_00002.json").unlink()
    (tmp_path / "conf_00004.png").unlink()
    scene = open_project(tmp_path)
    assert scene.names == ("frame_00000.jpg", "frame_00004.jpg", "frame_00006.jpg")
    assert "4 of 7 frames were recorded without a picture: not used" in messages(scene)
    assert "1 of 4 frames have no pose: dropped (frame_00002.jpg)" in messages(scene)
    assert "1 of 4 depth maps have no confidence map" in messages(scene)


def test_frames_of_another_program_are_none_of_scanner_app(tmp_path: Path) -> None:
    scanner_app(tmp_path)
    for path in tmp_path.glob("frame_*.json"):
        path.write_text('{"pose": []}')
    with pytest.raises(ProjectError, match=r"20 pictures without cameras"):
        open_project(tmp_path)


# --- Polycam ----------------------------------------------------------------------------------


def test_polycam_masks_the_border_of_corrected_pictures_alone(tmp_path: Path) -> None:
    polycam(tmp_path)
    mask = open_project(tmp_path).views[0].load().mask
    assert mask is not None
    assert not mask[:, :4].any()
    assert mask[:, 7:].all()  # what is dark inside of the picture is part of it
    polycam(tmp_path / "recorded", corrected=False)
    assert open_project(tmp_path / "recorded").views[0].load().mask is None


def test_polycam_with_pictures_of_another_format_and_cameras_without_size(tmp_path: Path) -> None:
    polycam(tmp_path, corrected=False)
    before = open_project(tmp_path)
    shown = before.views[0].load().rgb
    for path in (tmp_path / "keyframes/images").glob("*.jpg"):
        with Image.open(path) as picture:
            picture.save(path.with_suffix(".png"))
        path.unlink()
    for path in (tmp_path / "keyframes/cameras").glob("*.json"):
        camera = json.loads(path.read_text())
        path.write_text(json.dumps({k: v for k, v in camera.items() if k[0] not in "wh"}))
    scene = open_project(tmp_path)
    np.testing.assert_array_equal(scene.cameras.K, before.cameras.K)
    np.testing.assert_array_equal(scene.views[0].load().rgb, shown)


def test_polycam_never_mixes_corrected_and_recorded_poses(tmp_path: Path) -> None:
    expected = polycam(tmp_path)
    name = expected.cameras.names[1].removesuffix(".jpg")
    (tmp_path / "keyframes" / "corrected_cameras" / f"{name}.json").write_text("{")
    scene = open_project(tmp_path / "keyframes")
    assert scene.names == (expected.cameras.names[0], *expected.cameras.names[2:])
    np.testing.assert_allclose(
        scene.cameras.cam_from_world, expected.cameras.cam_from_world[[0, 2, 3]], atol=1e-9
    )
    assert "poses: optimised" in messages(scene)
    assert "1 of 4 frames have no pose" in messages(scene)


# --- Record3D ---------------------------------------------------------------------------------


def test_record3d_archive_and_folder_are_the_same(tmp_path: Path) -> None:
    expected = record3d(tmp_path / "scan.r3d")
    with ZipFile(tmp_path / "scan.r3d") as archive:
        archive.extractall(tmp_path / "scan")
    compare(open_project(tmp_path / "scan"), expected)
    (tmp_path / "scan" / "rgbd" / "2.conf").unlink()
    (tmp_path / "scan" / "rgbd" / "1.jpg").unlink()
    (tmp_path / "scan" / "rgbd" / "3.depth").unlink()
    scene = open_project(tmp_path / "scan")
    assert scene.names == ("0.jpg", "2.jpg", "3.jpg")
    assert [view.has_depth for view in scene] == [True, True, False]
    assert "1 of 3 depth maps have no confidence map" in messages(scene)


def rewritten(path: Path, *, without: str = "", **metadata: Any) -> Path:
    """An archive with another metadata, or without a member."""
    with ZipFile(path) as old:
        held = {name: old.read(name) for name in old.namelist() if name != without}
    held["metadata"] = json.dumps({**json.loads(held["metadata"]), **metadata}).encode()
    with ZipFile(path, "w") as new:
        for name, data in held.items():
            new.writestr(name, data)
    return path


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"poses": [[0, 0, 0, 1, 0, 0, 0]] * 4}, "no frame has a pose, as in .* selfie camera"),
        ({"K": [1, 2]}, r"metadata: unreadable \(K: .*expected Record3D's"),
        ({"poses": "none"}, r"metadata: unreadable \(poses: "),
    ],
)
def test_record3d_metadata_that_is_of_no_use(changed, message, tmp_path):
    record3d(tmp_path / "scan.r3d")
    with pytest.raises(ProjectError, match=message):
        open_project(rewritten(tmp_path / "scan.r3d", **changed))


def test_record3d_damaged_files_name_what_is_wrong(tmp_path: Path) -> None:
    record3d(tmp_path / "scan.r3d")
    path = rewritten(tmp_path / "scan.r3d", dw=17)
    with pytest.raises(ProjectError, match=r"rgbd/0\.depth: unreadable .*expected 24x17 values"):
        open_project(path).views[0].load()
    whole = path.read_bytes()
    for damaged in (whole[:-100], whole[:60] + b"x" + whole[61:]):
        path.write_bytes(damaged)
        with pytest.raises(ProjectError, match=r"unreadable .*expected an archive"):
            open_project(path)
