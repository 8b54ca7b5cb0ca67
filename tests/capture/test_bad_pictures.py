"""Pictures that structure from motion cannot use, or not all of: what is said, what is kept."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from command_line import refused
from PIL import Image, ImageFilter
from walls import walk

from gvtools.capture.mapping import MappingTask, find_cameras
from gvtools.capture.photographs import complete_masks, copy_upright, find_photographs
from gvtools.capture.project import capture_photographs
from gvtools.errors import ProjectError
from gvtools.scenes.project import open_project
from gvtools.similarity import fit_similarity


@pytest.fixture(scope="module")
def texture() -> Image.Image:
    """A wall with corners of every size."""
    rng = np.random.default_rng(0)
    pixels = np.zeros((480, 960, 3))
    for side in (60, 20, 8, 3):
        noise = rng.uniform(0, 64, (-(-480 // side), -(-960 // side), 3))
        pixels += cv2.resize(noise, (960, 480), interpolation=cv2.INTER_NEAREST)
    return Image.fromarray(pixels.astype(np.uint8))


@pytest.fixture(scope="module")
def parts(texture: Image.Image) -> list[Image.Image]:
    """Pictures side by side."""
    return [texture.crop((40 * index, 0, 40 * index + 480, 360)) for index in range(4)]


def test_blurred_pictures_are_named(parts: list[Image.Image], tmp_path: Path) -> None:
    for index, part in enumerate([*parts[:3], parts[3].filter(ImageFilter.GaussianBlur(8))]):
        part.save(tmp_path / f"{index}.png")
    said = [finding.message for finding in find_photographs(tmp_path)[1]]
    assert said == [
        "1 of 4 pictures are blurred beside the others (3.png); they are tried all the same"
    ]
    for index in range(4):
        parts[3].filter(ImageFilter.GaussianBlur(8 + index)).save(tmp_path / f"{index}.png")
    (only,) = find_photographs(tmp_path)[1]
    assert only.message.startswith("most of the 4 pictures have hardly any edges")


def _scene(width: int, height: int) -> Image.Image:
    """A picture with large shapes, as photographs have."""
    x, y = np.meshgrid(np.linspace(0, 9, width), np.linspace(0, 7, height))
    waves = np.stack([np.sin(x + y * y / 9), np.cos(x * y / 7), np.sin(3 * y - x)], axis=-1)
    return Image.fromarray((120 + 100 * waves).astype(np.uint8))


def test_copies_and_pictures_of_systems_are_left_out_by_content(parts, tmp_path):
    hidden = ["@eaDir/0.jpg/SYNOPHOTO_THUMB_XL.jpg", ".thumbs/1.jpg", "__MACOSX/._2.jpg"]
    files = {f"{index}.jpg": part for index, part in enumerate(parts)}
    files |= {"small/renamed.jpg": parts[1].resize((240, 180)), "2.png": parts[2]}
    shown = _scene(480, 360)
    files["4.jpg"] = shown
    files["4-edited.jpg"] = Image.eval(shown, lambda level: 20 + 3 * level // 4)
    files["turned.jpg"] = shown.transpose(Image.Transpose.ROTATE_90)
    files["squeezed.jpg"] = shown.resize((200, 360))
    for name in (*files, *hidden):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        files.get(name, parts[0]).save(tmp_path / name)
    found, findings = find_photographs(tmp_path)
    assert sorted(item.path.stem for item in found) == ["0", "1", "2", "3", "4"]
    said = [finding.message for finding in findings if finding.level == "warning"]
    assert "5 of 10 pictures are others again: reduced, turned, edited or saved" in said[0]
    assert "3 pictures lie in hidden folders" in said[1]


def test_photographs_below_one_sky_upright_and_across_are_no_copies(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for index in range(4):
        height, width = (400, 300) if index % 2 else (300, 400)
        hazy = np.linspace(120, 220, height)[:, None] + rng.normal(0, 3, (height, width))
        hazy[60 + 30 * index : 100 + 30 * index, 50 + 20 * index : 90 + 20 * index] -= 40
        Image.fromarray(hazy.astype(np.uint8)).save(tmp_path / f"{index}.jpg")
    assert len(find_photographs(tmp_path)[0]) == 4


def test_what_is_no_photograph_is_left_out_by_content(parts, tmp_path):
    (tmp_path / "IMG_1.HEIC").write_bytes(b"ftypheic")
    with pytest.raises(ProjectError, match=r"1 pictures are HEIC.*IMG_1\.HEIC.* to JPEG"):
        find_photographs(tmp_path)
    for index in range(3):
        parts[index].save(tmp_path / f"{index}.png")
        mask = np.zeros((360, 480), np.uint8)
        mask[: 50 + index] = 255
        Image.fromarray(mask).save(tmp_path / f"{index}.png.png")
        depth = np.arange(480, dtype=np.uint16)[None] * np.full((360, 1), 9 + index, np.uint16)
        Image.fromarray(depth).save(tmp_path / f"{index}_depth.png")
    (tmp_path / "0.mov").write_bytes(b"of a live photograph")
    (tmp_path / "walk.MOV").write_bytes(b"film")
    found, said = find_photographs(tmp_path)
    assert [item.name for item in found] == ["0.png", "1.png", "2.png"]
    assert [item.message for item in said] == [
        "3 of 9 pictures have at most 4 colours, as masks (give these with --masks): left out "
        "(0.png.png, 1.png.png, 2.png.png)",
        "3 of 9 pictures are grey of 16 bits beside others of 8, as depth maps: left out "
        "(0_depth.png, 1_depth.png, 2_depth.png)",
        "1 pictures are HEIC, AVIF or raw: left out (IMG_1.HEIC); convert them to JPEG",
        "1 videos are left out (walk.MOV); give one instead of the folder",
    ]


def test_masks_fit_their_pictures(tmp_path: Path) -> None:
    photos, masks, out = tmp_path / "photos", tmp_path / "masks", tmp_path / "out"
    for folder in (photos, masks):
        folder.mkdir()
    for index in range(3):
        Image.new("RGB", (40, 30), (index, 0, 0)).save(photos / f"{index}.png")
    found, _ = find_photographs(photos)
    with pytest.raises(ProjectError, match=r"holds no mask of the 3 .* expected 0\.png\.png"):
        complete_masks(found, masks, out=out)
    mask = Image.new("L", (40, 30), 0)
    mask.paste(1, (0, 0, 40, 10))
    mask.save(masks / "1.png.png")
    (finding,) = complete_masks(found, masks, out=out)
    assert finding.message == "2 of 3 pictures have no mask (0.png, 2.png): used whole"
    written = [np.asarray(Image.open(out / f"{index}.png.png")) > 0 for index in range(3)]
    assert written[0].all() and written[2].all()
    assert written[1][:10].all() and not written[1][10:].any()
    mask.resize((20, 30)).save(masks / "2.png.png")
    with pytest.raises(ProjectError, match=r"20x30 pixels; expected .* 40x30"):
        complete_masks(found, masks, out=out)


def test_a_failure_says_what_was_met(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for index in range(3):
        noise = np.random.default_rng(index).integers(0, 255, (240, 320, 3), np.uint8)
        Image.fromarray(noise).save(folder / f"{index}.png")
    shutil.copy(folder / "0.png", folder / "again.png")
    (folder / "half.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(ProjectError) as raised:
        capture_photographs(folder, tmp_path / "out")
    line = str(raised.value)
    assert line.startswith(f"{folder}: no two of the 3 pictures show enough of the same")
    assert "1 of 5 pictures cannot be read: left out (half.jpg)" in line
    assert "1 of 5 pictures are copies of others: left out (again.png)" in line
    assert "\n" not in line
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]


def test_a_camera_that_only_turned_is_told(texture: Image.Image, tmp_path: Path) -> None:
    images, names = tmp_path / "images", [f"{index}.png" for index in range(4)]
    walls(texture, images, [(0, np.radians(4.0 * index - 6)) for index in range(4)], lift=0)
    (tmp_path / "work").mkdir()
    with pytest.raises(ProjectError, match=r"away: .*the camera only turned.* while walking"):
        find_cameras(MappingTask(images, [names], tmp_path / "work", source=Path("away")))


def walls(
    texture: Image.Image, folder: Path, poses: list[tuple[float, float]], *, lift: float = 0.1
) -> None:
    """Pictures of a wall at distance 1, from places and turns about the vertical axis."""
    folder.mkdir()
    K, wall = (np.array([[f, 0, w], [0, f, h], [0, 0, 1.0]]) for f, w, h in
               ((240, 120, 90), (480, 480, 240)))  # fmt: skip
    for index, (x, angle) in enumerate(poses):
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        moved = np.eye(3) - np.outer([x, lift * (index % 2), 0], [0, 0, 1])
        seen = cv2.warpPerspective(
            np.asarray(texture), K @ turn @ moved @ np.linalg.inv(wall), (240, 180)
        )
        Image.fromarray(seen).save(folder / f"{index}.png")


def test_a_walk_past_something_flat_is_kept_and_told(texture: Image.Image, tmp_path: Path) -> None:
    places = [0.15 * (index - 2.5) for index in range(6)]
    walls(texture, tmp_path / "photos", [(x, np.arctan(x)) for x in places])
    report = capture_photographs(tmp_path / "photos", tmp_path / "out")
    assert len(report.registered) == 6
    said = [finding.message for finding in report.findings if finding.level == "warning"]
    assert len(said) == 1 and said[0].startswith("each pair of pictures is explained by a plane")
    true = np.array([[x, 0.1 * (index % 2), 0] for index, x in enumerate(places)])
    found = open_project(tmp_path / "out").cameras.centers
    assert fit_similarity(found, true).residuals.max() < 0.02


def test_a_video_that_was_cut_off(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cut.mp4"
    path.write_bytes(b"\0\0\0\x20ftypisom" + bytes(1000))
    line = refused(capfd, "capture", path, "--out", tmp_path / "out")
    assert "no video that OpenCV reads (1012 bytes); it may have been cut off" in line


def test_exif_tells_focal_length_place_and_camera(texture: Image.Image, tmp_path: Path) -> None:
    photos, images = tmp_path / "photos", tmp_path / "images"
    photos.mkdir()
    for name, orientation, focal in (("a", 1, 28), ("b", 6, 28), ("c", 1, 50)):
        picture = texture.crop((0, 0, 400, 300))
        exif = picture.getexif()
        exif[0x010F], exif[0x0110], exif[0x0112] = "Maker", "Model", orientation
        exif.get_ifd(0x8769)[0xA405] = focal
        exif.get_ifd(0x8825).update(
            {1: "S", 2: (33.0, 51.0, 30.0), 3: "E", 4: (151.0, 12.0, 36.0), 5: b"\0", 6: 58.5}
        )
        if orientation == 6:
            picture = picture.transpose(Image.Transpose.ROTATE_90)
        # Quality keeps the three files apart.
        picture.save(photos / f"{name}.jpg", exif=exif, quality=80 + orientation + focal // 10)
    found, _ = find_photographs(photos)
    assert [item.size for item in found] == [(400, 300)] * 3
    assert found[0].camera == found[1].camera != found[2].camera
    assert found[0].location == pytest.approx((-33.858333, 151.21, 58.5))
    copy_upright(found, images)
    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, images, pycolmap.CameraMode.PER_IMAGE)
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            camera = opened.read_camera(image.camera_id)
            focal = 50 if image.name == "c.jpg" else 28
            assert camera.has_prior_focal_length
            # The full frame of 35 mm film is 36 mm wide, 43.27 mm across.
            assert camera.focal_length == pytest.approx(focal / 43.27 * 500, rel=0.05), image.name


def test_of_two_places_the_larger_is_kept(wall_walk, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for place, pictures in (("large", wall_walk[:6]), ("small", walk(seed=3)[:4])):
        for picture in pictures:
            Image.fromarray(picture.rgb).save(folder / f"{place}_{picture.name}")
    report = capture_photographs(folder, tmp_path / "out")
    assert {name[:5] for name in report.registered} == {"large"}
    assert len(report.registered) >= 5
    assert report.other_models == (4,)
    assert "in a further model of 4 pictures, which does not connect" in report.left_out.values()
    left_out = {name for name in report.left_out if name.startswith("small")}
    assert left_out == {path.name for path in folder.glob("small*")}
