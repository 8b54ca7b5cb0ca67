# mypy: no-check-untyped-defs
"""Which pictures are panoramas or by a fisheye, and how panoramas are cut for mapping."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from PIL import Image

from gvtools.capture.panoramas import (
    fisheye_params,
    lens_of,
    panorama_pairs,
    rename_faces,
    write_faces,
)
from gvtools.capture.photographs import CapturedPhotograph
from gvtools.errors import OptionError


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


def test_xmp_names_a_panorama(tmp_path):
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><GPano:ProjectionType>equirectangular</x:xmpmeta>'
    pixels = np.random.default_rng(0).integers(0, 255, (64, 128, 3), np.uint8)
    assert lens_of([photograph(tmp_path, "a.jpg", pixels)], "auto") == "perspective"
    assert lens_of([photograph(tmp_path, "b.jpg", pixels, xmp=xmp)], "auto") == "equirectangular"


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
    for face in rig.faces:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "PINHOLE"
        reader.camera_params = face.target.params_to_string()
        pycolmap.import_images(
            database, tmp_path / "images", camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=rig.names(face), options=reader,
        )  # fmt: skip
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
