"""Photographs and videos without poses become projects."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from command_line import arguments, refused
from PIL import Image
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, invert_rigid, rigid_poses
from gvtools.capture.mapping import MappingTask, find_cameras, sift_descriptors, similar_pairs
from gvtools.capture.panoramas import (
    fisheye_params,
    lens_of,
    panorama_pairs,
    rename_faces,
    write_faces,
)
from gvtools.capture.photographs import CapturedPhotograph, copy_upright, find_photographs
from gvtools.capture.project import capture_photographs, place
from gvtools.capture.video import pick_frames
from gvtools.errors import OptionError, ProjectError, UnposedError
from gvtools.scenes.colmap_writer import build_reconstruction
from gvtools.scenes.project import open_project
from gvtools.trajectories import level_up, look_at
from pipelines.cli import main
from pipelines.commands import capture
from pipelines.commands.capture import open_or_capture
from pipelines.console import Console

pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.fixture(scope="session")
def captured(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project made of these photographs alone."""
    out = tmp_path_factory.mktemp("captured") / "project"
    assert main(["capture", str(room / "images"), "--out", str(out), "--quiet"]) == 0
    return out


def test_cameras_are_found_from_the_pictures_alone(captured, centre_error) -> None:
    scene = open_project(captured)
    # The last ones along the path show hardly anything of the others.
    assert len(scene) >= 8
    assert centre_error(scene.names, scene.cameras.centers) < 0.03
    report = json.loads((captured / "capture.json").read_text())
    assert report["registered"] == list(scene.names)
    assert len(report["registered"]) + len(report["left_out"]) == 10
    assert report["reprojection_px"] < 1
    assert len(report["cameras"]) == 1
    assert (captured / "capture.png").stat().st_size > 10_000
    assert sorted(path.name for path in captured.iterdir()) == [
        "capture.json", "capture.png", "images", "sparse",
    ]  # fmt: skip
    assert not list(captured.parent.glob(".*"))


def test_the_model_is_level_and_takes_a_given_length(captured: Path) -> None:
    model = pycolmap.Reconstruction(str(captured / "sparse/0"))
    up = -np.mean(
        [image.cam_from_world().rotation.matrix()[1] for image in model.images.values()], 0
    )
    assert up[2] > 0.9 * np.linalg.norm(up)
    np.testing.assert_allclose(level_up(open_project(captured).cameras), [0, 0, 1], atol=1e-5)
    names = [image.name for image in model.images.values()]
    placement, _ = place(model, locations={}, distance=(names[0], names[3], 2.5))
    ends = [model.find_image_with_name(names[row]).projection_center() for row in (0, 3)]
    assert placement.metric
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(2.5)
    with pytest.raises(OptionError, match="no registered picture"):
        place(model, locations={}, distance=(names[0], "elsewhere.jpg", 1.0))


def test_cameras_that_look_down_are_levelled_by_how_they_are_held() -> None:
    """Their mean up leans by half of how far they look down, where they look one way."""
    yaw, centers = np.radians(np.linspace(-60, 60, 12)), np.arange(36).reshape(12, 3)
    aim = np.stack([np.sin(yaw), np.cos(yaw), np.full(12, -0.8)], axis=1)
    turn = rigid_poses(Rotation.from_euler("xyz", [20, -50, 80], degrees=True).as_matrix())
    pose = invert_rigid(turn @ look_at(centers, centers + aim, up=[0, 0, 1]))
    cameras, none = Cameras.alike(np.diag([60.0, 60, 1]), pose, size=(64, 64)), np.zeros(0, int)
    model = build_reconstruction(
        cameras, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), point_index=none, view_index=none,
        xy=np.zeros((0, 2)),
    )  # fmt: skip
    place(model, locations={})
    level = [image.cam_from_world().rotation.matrix()[0, 2] for image in model.images.values()]
    assert np.abs(level).max() < np.sin(np.radians(0.5))


def test_gps_places_a_model_in_metres(captured: Path) -> None:
    model = pycolmap.Reconstruction(str(captured / "sparse/0"))
    images = list(model.images.values())
    true = np.stack([image.projection_center() for image in images]) * [40, 40, 40]
    places = pycolmap.GPSTransform().enu_to_ellipsoid(true, 48.0, 11.0, 500.0)
    locations = {
        image.name: (float(row[0]), float(row[1]), float(row[2]))
        for image, row in zip(images, places, strict=True)
    }
    placement, findings = place(model, locations=locations)
    assert (placement.metric, placement.by) == (True, "GPS")
    found = np.stack([image.projection_center() for image in model.images.values()])
    assert np.allclose(found - found.mean(0), true - true.mean(0), atol=0.01)
    # A spread below the receiver's error tells nothing.
    near = {name: (48.0 + 1e-6 * i, 11.0, 500.0) for i, name in enumerate(locations)}
    placement, findings = place(model, locations=near)
    assert not placement.metric
    assert "not used" in findings[0].message


def test_damaged_copied_and_turned_pictures_are_told_apart(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    shutil.copytree(room / "images", folder)
    names = sorted(path.name for path in folder.iterdir())
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff nothing more")
    shutil.copy(folder / names[0], folder / "copy.png")
    with Image.open(folder / names[1]) as image:
        exif = image.getexif()
        exif[0x0112] = 6  # stored on its side: to be turned by 90 degrees
        image.transpose(Image.Transpose.ROTATE_90).save(folder / "turned.jpg", exif=exif)
    (folder / names[1]).unlink()
    photographs, findings = find_photographs(folder)
    said = " ".join(finding.message for finding in findings)
    assert "1 of 12 pictures cannot be read" in said
    assert "are copies of others" in said
    assert "1 pictures were stored on their side" in said
    copy_upright(photographs, tmp_path / "upright")
    with (
        Image.open(tmp_path / "upright/turned.jpg") as upright,
        Image.open(room / "images" / names[1]) as original,
    ):
        assert upright.size == original.size
        assert int(upright.getexif().get(0x0112, 1)) == 1
        difference = np.asarray(upright, np.int16) - np.asarray(original.convert("RGB"))
        assert np.abs(difference).mean() < 6
    kept = (tmp_path / "upright" / names[0]).read_bytes()
    assert kept == (folder / names[0]).read_bytes()


def test_a_picture_of_elsewhere_is_left_out_and_named(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in sorted((room / "images").iterdir())[:5]:
        shutil.copy(path, folder)
    noise = np.random.default_rng(3).integers(0, 255, (270, 360, 3), np.uint8)
    Image.fromarray(noise).save(folder / "noise.png")
    report = capture_photographs(folder, tmp_path / "out")
    assert set(report.left_out) == {"noise.png"}
    assert len(report.registered) == 5
    assert any("noise.png" in finding.message for finding in report.findings)


def test_wrong_inputs_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "there").mkdir()
    (tmp_path / "there/file").touch()
    (tmp_path / "text.txt").touch()
    for said, source, out, *more in (
        ("at least two photographs", "empty", "out"),
        ("no such file", "nothing", "out"),
        ("expected a folder (or .zip) of photographs", "text.txt", "out"),
        ("nothing is overwritten", "empty", "there"),
        ("A,B,METRES", "empty", "out", "--distance", "a,b"),
    ):
        command = ("capture", tmp_path / source, "--out", tmp_path / out, *more)
        assert said in refused(capsys, *command)


def test_pairs_are_found_by_what_pictures_look_like(room: Path, tmp_path: Path) -> None:
    names = sorted(path.name for path in (room / "images").iterdir())
    with pytest.raises(ProjectError):
        find_cameras(MappingTask(room / "images", [names[:1]], tmp_path))
    database = tmp_path / "features.db"
    pycolmap.extract_features(database, room / "images")
    pairs = similar_pairs(sift_descriptors(database), nearest=3)
    assert all(a in names and b in names and a < b for a, b in pairs)
    cameras = open_project(room)
    apart = {
        (a, b): float(np.linalg.norm(cameras[a].camera.centers - cameras[b].camera.centers))
        for a in names
        for b in names
        if a < b
    }
    chosen = np.mean([apart[pair] for pair in pairs])
    assert len(pairs) < len(apart)
    assert chosen < 0.8 * np.mean(list(apart.values()))


# Source, project and masks of a capture.
Asked = tuple[Path, Path, Path | None]


@pytest.fixture
def captures(room: Path, monkeypatch: pytest.MonkeyPatch) -> list[Asked]:
    """What ``gvtools capture`` was asked for; it gives the room's own cameras here."""
    asked: list[Asked] = []

    def stand_in(source: Path, out: Path, **options: Any) -> None:
        asked.append((source, out, options.get("masks")))
        shutil.copytree(room, out)
        (out / "capture.json").write_text(json.dumps({"source": str(source.resolve())}))

    monkeypatch.setattr(capture, "capture", stand_in)
    return asked


def on_terminal(monkeypatch: pytest.MonkeyPatch, answer: str) -> list[str]:
    """A terminal with a user who gives one answer; returns what they are asked."""
    questions = []

    def read(question: str) -> str:
        questions.append(question)
        return answer

    for stream in (sys.stdin, sys.stdout):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setattr("builtins.input", read)
    return questions


def test_without_a_terminal_one_line_gives_the_command(room, tmp_path, capsys):
    photos = tmp_path / "my photos"
    shutil.copytree(room / "images", photos)
    out = tmp_path / "runs" / "x"
    line = refused(capsys, "reconstruct", photos, "--out", out)
    assert "10 pictures without cameras" in line
    assert f"gvtools capture '{photos}' --out {out}-project; or add --capture" in line
    assert "a run would find them first" in refused(
        capsys, "reconstruct", photos, "--out", out, "--dry-run", "--capture"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my photos"]
    nested = tmp_path / "nested"
    for part in ("a", "b"):
        (nested / part).mkdir(parents=True)
        Image.new("RGB", (8, 8)).save(nested / part / "1.png")
    assert "2 pictures without cameras" in refused(capsys, "reconstruct", nested, "--out", out)
    (tmp_path / "camera.bag").touch()
    assert "a recording without cameras" in refused(
        capsys, "reconstruct", tmp_path / "camera.bag", "--out", out
    )


def test_capture_comes_unasked_and_once(room: Path, captures: list[Asked], tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    args = arguments(
        "reconstruct", room / "images", "--out", tmp_path / "run", "--capture", "--masks", masks
    )
    for _ in range(2):
        scene, reading = open_or_capture(args, Console(quiet=True))
        assert len(scene) == 10
        assert reading == {"masks": str(masks)}
        assert scene.root == tmp_path / "run-project"
    assert captures == [(room / "images", tmp_path / "run-project", masks)]
    with pytest.raises(OptionError, match="--images: of a COLMAP project"):
        words = ("--out", tmp_path / "b", "--capture", "--images", masks)
        open_or_capture(arguments("reconstruct", room / "images", *words), Console(quiet=True))


@pytest.mark.parametrize(("answer", "calls"), [("y", 1), ("Yes ", 1), ("", 0), ("n", 0)])
def test_a_user_at_a_terminal_is_asked(answer, calls, room, captures, tmp_path, monkeypatch):
    questions = on_terminal(monkeypatch, answer)
    args = arguments("reconstruct", room / "images", "--out", tmp_path / "run")
    if calls:
        assert len(open_or_capture(args, Console())[0]) == 10
    else:
        with pytest.raises(UnposedError, match="10 pictures without cameras"):
            open_or_capture(args, Console())
    assert len(captures) == calls
    (question,) = questions
    assert "10 pictures without cameras. Capture now to" in question
    assert question.endswith("? [y/N] ")


@pytest.mark.slow
def test_photographs_alone_become_a_run(room, tmp_path):
    out = tmp_path / "run"
    options = ("--capture", "--refine", "0", "--rounds", "1", "--quiet")
    assert main(["reconstruct", str(room / "images"), "--out", str(out), *options]) == 0
    assert (out / "metrics.json").is_file()
    assert (tmp_path / "run-project/capture.json").is_file()


WIDTH, HEIGHT = 320, 240


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    """A long wall with corners everywhere."""
    rng = np.random.default_rng(0)
    small = rng.integers(0, 255, (HEIGHT // 8, 3 * WIDTH // 8, 3), np.uint8)
    return cv2.resize(small, (3 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def write_video(path: Path, frames: list[np.ndarray]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (WIDTH, HEIGHT))
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def test_frames_are_an_equal_motion_apart_and_sharp(tmp_path: Path, wall: np.ndarray) -> None:
    # The camera stands for 30 frames, then moves 8 pixels a frame; every third frame is blurred.
    at = [0] * 30 + [8 * i for i in range(60)]
    frames = [wall[:, x : x + WIDTH].copy() for x in at]
    frames = [cv2.GaussianBlur(f, (0, 0), 4) if i % 3 == 0 else f for i, f in enumerate(frames)]
    path = write_video(tmp_path / "walk.mp4", frames)
    picked = pick_frames(path, tmp_path / "frames", count=10, progress=lambda n: None)
    assert (picked.total, picked.lost) == (90, 0)
    assert picked.motion == pytest.approx(59 * 8 / WIDTH, rel=0.1)
    assert len(picked.frames) == 10
    assert all(frame % 3 for frame in picked.frames)
    steps = np.diff([at[frame] for frame in picked.frames])
    assert steps.max() <= 80  # two pieces of the path
    written = sorted(file.name for file in (tmp_path / "frames").iterdir())
    assert written == [f"frame_{frame:06d}.jpg" for frame in picked.frames]
    first = cv2.imread(str(tmp_path / "frames" / written[0]))
    assert first is not None
    assert np.abs(first.astype(int) - frames[picked.frames[0]]).mean() < 8


def test_a_video_without_motion_is_refused(tmp_path: Path, wall: np.ndarray) -> None:
    path = write_video(tmp_path / "still.mp4", [wall[:, :WIDTH].copy()] * 20)
    with pytest.raises(ProjectError, match="expected a camera that moves"):
        pick_frames(path, tmp_path / "frames", progress=lambda n: None)
    with pytest.raises(OptionError, match="expected 2 or more"):
        pick_frames(path, tmp_path / "frames", count=1, progress=lambda n: None)


def photograph(folder, name, pixels, **options):
    Image.fromarray(pixels).save(folder / name, **options)
    thumbnail = np.zeros(1024, np.uint8)
    return CapturedPhotograph(folder / name, name, pixels.shape[1::-1], "", False, 1.0, thumbnail)


def panorama():
    """Smooth over the sphere: sides meet, and each pole is one colour."""
    longitude = np.linspace(-np.pi, np.pi, 128, endpoint=False)
    latitude = np.linspace(np.pi / 2, -np.pi / 2, 64)[:, None]
    grey = 127 + 100 * np.cos(latitude) * np.sin(3 * longitude)
    return np.repeat(grey[..., None], 3, -1).astype(np.uint8)


def test_panoramas_are_told_from_wide_pictures(tmp_path):
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><GPano:ProjectionType>equirectangular</x:xmpmeta>'
    pixels = np.random.default_rng(0).integers(0, 255, (64, 128, 3), np.uint8)
    assert lens_of([photograph(tmp_path, "d.jpg", pixels)], "auto") == "perspective"
    assert lens_of([photograph(tmp_path, "e.jpg", pixels, xmp=xmp)], "auto") == "equirectangular"
    whole = photograph(tmp_path, "a.png", panorama())
    half = photograph(tmp_path, "b.png", np.ascontiguousarray(panorama()[:, 20:84][:32]))
    assert half.size == (64, 32)
    assert lens_of([whole], "auto") == "equirectangular"
    assert lens_of([half], "auto") == "perspective"
    assert lens_of([whole], "perspective") == "perspective"
    with pytest.raises(OptionError, match="1 of 2 pictures are panoramas"):
        lens_of([whole, half], "auto")
    square = photograph(tmp_path, "c.png", np.full((50, 50, 3), 99, np.uint8))
    with pytest.raises(OptionError, match="not twice as wide as high"):
        lens_of([square], "equirectangular")


def test_fisheyes_have_dark_corners(tmp_path):
    y, x = np.mgrid[:90, :120] + 0.5
    pixels = np.full((90, 120, 3), 140, np.uint8)
    pixels[np.hypot(x - 60, y - 45) > 45] = 0
    item = photograph(tmp_path, "a.png", pixels)
    assert lens_of([item], "auto") == "fisheye"
    focal = float(fisheye_params([item]).split(",")[0])
    # The circle of 90 pixels shows 180 degrees.
    assert focal == pytest.approx(90 / np.pi)


def test_faces_become_a_rig_with_one_centre(tmp_path):
    items = [photograph(tmp_path, f"{name}.png", panorama()) for name in "ab"]
    masks = tmp_path / "given"
    masks.mkdir()
    mask = np.full((64, 128), 255, np.uint8)
    mask[-16:] = 0
    Image.fromarray(mask).save(masks / "a.png.png")
    (rig,) = write_faces(items, tmp_path / "images", masks=masks, face_masks=tmp_path / "masks")
    names = [name for face in rig.faces for name in rig.names(face)]
    assert len(names) == 12
    assert all((tmp_path / "images" / name).is_file() for name in names)
    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, tmp_path / "images", pycolmap.CameraMode.PER_FOLDER)
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([rig.config()], opened)
        frames = opened.read_all_frames()
        (found,) = opened.read_all_rigs()
    assert len(frames) == 2
    assert found.num_sensors() == 6
    for turn in found.non_ref_sensors.values():
        np.testing.assert_array_equal(turn.translation, 0)
    model = pycolmap.Reconstruction()
    rename_faces(model, [rig], images=tmp_path / "images", face_masks=tmp_path / "masks")
    assert sorted(path.name for path in (tmp_path / "images").iterdir())[:2] == [
        "a@back.png", "a@down.png",
    ]  # fmt: skip
    down = np.asarray(Image.open(tmp_path / "masks" / "a@down.png.png"))
    assert down[len(down) // 2, len(down) // 2] == 0
    assert not (tmp_path / "masks" / "b@down.png.png").exists()


def test_matches_of_faces_count_for_their_panoramas():
    pairs = {
        ("8x4/up/a.png", "8x4/left/b.png"): 5,
        ("8x4/left/b.png", "8x4/front/a.png"): 7,
        ("8x4/left/x/c.png", "8x4/front/x/c.png"): 9,
    }
    assert panorama_pairs(pairs) == {("a.png", "b.png"): 12}
