"""Pictures, masks and depth maps as they are read, also under nearly the name that lists have."""
# mypy: no-check-untyped-defs

from __future__ import annotations

import re
import unicodedata
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes_workspace import messages, ramp, save, workspace

from gvtools.errors import ProjectError
from gvtools.scenes.images import (
    check_size,
    orientation_of,
    read_depth,
    read_header,
    read_image,
    read_mask,
    resize_nearest,
)
from gvtools.scenes.matching import find_renamed
from gvtools.scenes.project import open_project


def test_grey_palette_sixteen_bit_and_binary_become_rgb(tmp_path):
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    expected = np.repeat(grey[..., None], 3, axis=-1)
    np.testing.assert_array_equal(read_image(save(tmp_path / "g.png", grey)).rgb, expected)
    deep = grey.astype(np.uint16) * 256 + 255
    np.testing.assert_array_equal(read_image(save(tmp_path / "d.png", deep)).rgb, expected)
    Image.fromarray(ramp()).convert("P").save(tmp_path / "p.png")
    assert read_image(tmp_path / "p.png").rgb.shape == ramp().shape
    Image.fromarray(grey > 100).save(tmp_path / "b.png")
    np.testing.assert_array_equal(
        read_image(tmp_path / "b.png").rgb[..., 0], (grey > 100) * np.uint8(255)
    )


def test_alpha_becomes_a_mask_and_leaves_colours_alone(tmp_path):
    rgba = np.dstack([ramp(8, 6), np.full((6, 8), 255, np.uint8)])
    assert read_image(save(tmp_path / "opaque.png", rgba)).mask is None
    rgba[2, 3, 3], rgba[1, 1, 3], rgba[0, 0, 3] = 0, 127, 128
    picture = read_image(save(tmp_path / "holes.png", rgba))
    assert np.argwhere(~picture.mask).tolist() == [[1, 1], [2, 3]]
    np.testing.assert_array_equal(picture.rgb, rgba[..., :3])
    assert read_header(tmp_path / "holes.png").has_alpha


def test_exif_orientation_is_not_applied(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(ramp(8, 6)).save(tmp_path / "turned.jpg", exif=exif, quality=95)
    header = read_header(tmp_path / "turned.jpg")
    assert (header.width, header.height, header.orientation) == (8, 6, 6)
    assert read_image(tmp_path / "turned.jpg").rgb.shape == (6, 8, 3)
    with pytest.raises(ProjectError, match="EXIF"):
        check_size((8, 6), (6, 8), path=tmp_path / "turned.jpg", orientation=6)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_truncated_absent_and_foreign_files_are_named(tmp_path, suffix):
    path = save(
        tmp_path / f"picture.{suffix}",
        np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8),
    )
    path.write_bytes(path.read_bytes()[:-2000])
    for reader in (read_image, read_mask):
        with pytest.raises(ProjectError, match=r"picture.*unreadable") as error:
            reader(path)
        assert "\n" not in str(error.value)
    path.write_text("no picture")
    for reader in (read_image, read_mask, read_depth, read_header):
        with pytest.raises(ProjectError, match=r"picture.*unreadable"):
            reader(path)
    path.unlink()
    with pytest.raises(ProjectError, match="no such file"):
        read_image(path)


def test_black_of_a_mask_stored_with_loss_is_black(tmp_path):
    x, y = np.meshgrid(np.arange(64), np.arange(64))
    mask = np.hypot(x - 32, y - 32) < 20
    Image.fromarray(mask.astype(np.uint8) * 255).save(tmp_path / "m.jpg", quality=60)
    assert (np.asarray(Image.open(tmp_path / "m.jpg"))[~mask] > 0).mean() > 0.1
    assert (read_mask(tmp_path / "m.jpg") != mask).mean() < 0.01


@pytest.mark.parametrize("color", [0, 255, None])
def test_a_mask_may_tell_it_by_its_alpha(tmp_path, color):
    pixels = np.full((2, 2, 4), color or 0, np.uint8)
    pixels[..., 3] = [[0, 255], [255, 255]]
    expected = pixels[..., 3] > 0
    if color is None:  # both tell something
        pixels[0, :, :3] = 255
        expected = np.array([[False, True], [False, False]])
    np.testing.assert_array_equal(read_mask(save(tmp_path / "m.png", pixels)), expected)


def test_depth_units_and_invalid_codes(tmp_path):
    stored = np.array([[0, 1500, 65535, 65534]], np.uint16)
    np.testing.assert_allclose(
        read_depth(save(tmp_path / "d.png", stored), unit=1e-3), [[0, 1.5, 0, 65.534]], rtol=1e-6
    )
    np.testing.assert_allclose(
        read_depth(tmp_path / "d.png", unit=1e-3, maximum=10), [[0, 1.5, 0, 0]], rtol=1e-6
    )
    real = np.array([[np.nan, np.inf, -1, 0, 2.5, 65535]])
    expected = [[0, 0, 0, 0, 2.5, 65535]]
    np.save(tmp_path / "d.npy", real)
    np.savez(tmp_path / "d.npz", depth=real[..., None])
    for name in ("d.npy", "d.npz"):
        np.testing.assert_array_equal(read_depth(tmp_path / name), expected)
    assert read_depth(tmp_path / "d.npy").dtype == np.float32


def test_nearest_resize_is_pillows():
    rng = np.random.default_rng(1)
    array = rng.uniform(size=(9, 12)).astype(np.float32)
    for size in ((24, 18), (4, 3), (32, 24)):
        peer = Image.fromarray(array).resize(size, Image.Resampling.NEAREST)
        np.testing.assert_array_equal(resize_nearest(array, *size), np.asarray(peer))


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize(
    ("channels", "suffix"), [(1, "png"), (3, "png"), (4, "png"), (3, "tif"), (1, "tif"), (3, "ppm")]
)
def test_a_projects_pictures_of_16_bits_a_channel_have_one_range(tmp_path, bits, channels, suffix):
    import cv2
    from scenes_workspace import PINHOLE, frame, transforms

    from gvtools.scenes.transforms import read_transforms

    red = np.where(np.arange(96 * 72).reshape(72, 96) % 7 < 6, ramp()[..., 0], 255)
    whole = red.astype(np.uint16) << (bits - 8)
    (tmp_path / "images").mkdir()
    for name, shade in (("a", 1), ("b", 4)):  # a dark picture follows the bright one
        levels = np.repeat((whole // shade)[..., None], channels, axis=-1)
        levels[..., 3:] = 65535 if bits == 16 else (1 << bits) - 1
        cv2.imwrite(str(tmp_path / f"images/{name}.{suffix}"), np.squeeze(levels))
    cv2.imwrite(str(tmp_path / "images/0.png"), red.astype(np.uint8))  # another has 8 bits
    frames = [frame("images/0.png"), *(frame(f"images/{name}.{suffix}") for name in "ab")]
    scene = read_transforms(transforms(tmp_path, frames, **PINHOLE))
    for view, shade in zip(scene.views, (1, 1, 4), strict=True):
        np.testing.assert_allclose(view.load().rgb[..., 0].astype(int), red // shade, atol=1)
    said = any("16-bit pictures hold no more than" in found.message for found in scene.findings)
    assert said == (bits < 16)


@pytest.mark.parametrize(
    ("head", "said"),
    [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1", "HEIC: convert it"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"<!DOCTYPE html><html>", "a web page"),
        (b"PK\3\4", "a ZIP archive"),
        (b"anything", "unreadable (no picture)"),
    ],
)
def test_what_is_no_picture_is_named_by_its_bytes(tmp_path, head, said):
    (tmp_path / "a.jpg").write_bytes(head + bytes(200))
    with pytest.raises(ProjectError, match=re.escape(said)):
        read_image(tmp_path / "a.jpg")


@pytest.mark.parametrize("told", [6, (6,), b"\x06", "6", 0, 9, "x", b""])
def test_orientation_tags_of_odd_types(tmp_path, told):
    image = Image.fromarray(ramp())
    exif = Image.Exif()
    exif[0x0112] = 6
    image.save(tmp_path / "a.jpg", exif=exif)
    assert orientation_of({0x0112: told}) == (6 if told not in (0, 9, "x", b"") else 1)
    assert read_header(tmp_path / "a.jpg").orientation == 6


MASK = np.repeat(np.array([[0] * 48 + [255] * 48], np.uint8), 72, 0)


@pytest.mark.parametrize(
    ("listed", "there"),
    [
        ("images\\a.png", "a.png"),
        ("/data/scene/images/a.png", "a.png"),
        ("C:\\scene\\a.png", "a.png"),
        ("../other/a.png", "a.png"),
        ("a.png", "left/a.png"),
        ("left\\a.png", "left/a.png"),
        ("A.JPG", "a.jpg"),
        ("a%20b.png", "a b.png"),
        ("a.jpg", "a.png"),
        ("a.jpg", "a.jpg.png"),
        ("a.png.png", "a.png"),
        ("a.jpg.png", "a_mask.png"),
        ("gr\u00fcn.png", unicodedata.normalize("NFD", "gr\u00fcn.png")),
    ],
)
def test_the_only_file_of_nearly_the_name_is_taken(tmp_path, listed, there):
    save(tmp_path / there, ramp())
    save(tmp_path / "@eaDir" / Path(there).name, ramp())
    found, findings = find_renamed(tmp_path, [tmp_path / listed], where=["list"])
    assert found == [tmp_path / there]
    assert "1 pictures are named otherwise than listed" in findings[0].message


@pytest.mark.parametrize(
    ("listed", "there"),
    [
        (["a.png"], ["left/a.png", "right/a.png"]),  # either
        (["left/a.png", "right/a.png"], ["a.png"]),  # one for both
        (["left/a.png"], ["right/a.png"]),  # another one's
        (["a.png", "b.png"], ["a.png", "old/b.png"]),  # others are where they are listed
        (["a.png"], ["ba.png"]),
    ],
)
def test_other_files_are_not_taken(tmp_path, listed, there):
    for name in there:
        save(tmp_path / name, ramp())
    files = [tmp_path / name for name in listed]
    assert find_renamed(tmp_path, files, where=["list"] * len(files)) == (files, [])


@pytest.mark.parametrize("suffix", [".png", ".JPG"])
def test_models_pictures_and_masks(tmp_path, suffix):
    model = workspace(tmp_path)
    for image in model.images.values():
        save(tmp_path / "masks" / image.name, MASK[::2, ::2])
        file = tmp_path / "images" / image.name
        file.rename(file.with_suffix(suffix))
        image.name = f"images\\{image.name}"
    model.write_binary(tmp_path / "sparse" / "0")
    scene = open_project(tmp_path)
    assert len(scene) == 4 and "4 of 4 pictures registered" in messages(scene)
    for line in (
        "4 pictures are named otherwise",
        "4 masks are named otherwise",
        "4 masks of 48x36",
    ):
        assert messages(scene).count(line) == 1
    assert not scene.views[0].load().mask[:, :40].any()
