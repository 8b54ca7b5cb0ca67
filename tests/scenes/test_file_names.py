"""Pictures, masks and depth maps that are not called quite as lists have them."""

# mypy: no-check-untyped-defs
from __future__ import annotations

import unicodedata
from pathlib import Path

import numpy as np
import pytest
from scenes_workspace import ramp, save, workspace

from gvtools.scenes.matching import find_renamed
from gvtools.scenes.project import open_project

MASK = np.repeat(np.array([[0] * 48 + [255] * 48], np.uint8), 72, 0)


def told(scene):
    return " | ".join(finding.message for finding in scene.findings)


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
    assert len(scene) == 4 and "4 of 4 pictures registered" in told(scene)
    for line in (
        "4 pictures are named otherwise",
        "4 masks are named otherwise",
        "4 masks of 48x36",
    ):
        assert told(scene).count(line) == 1
    assert not scene.views[0].load().mask[:, :40].any()
