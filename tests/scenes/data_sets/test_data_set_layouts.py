"""Every native layout: a miniature written in it is read back to the pixel and the pose."""

from __future__ import annotations

from pathlib import Path

import pytest
from data_sets.miniature import Expected, Miniature, compare, layout_named, miniatures
from data_sets.miniature import read_miniature as read

from gvtools.errors import ProjectError
from gvtools.scenes.scene import natural_key

ALL = miniatures()
PARTIAL = [miniature for miniature in ALL if miniature.pictures]


@pytest.fixture(scope="module", params=ALL, ids=lambda miniature: miniature.title)
def written(request, tmp_path_factory):
    """A miniature, where it lies, and what it holds; not to be changed."""
    root = tmp_path_factory.mktemp("miniature")
    return request.param, root, request.param.write(root)


def test_a_miniature_is_read_back(written: tuple[Miniature, Path, Expected]) -> None:
    miniature, root, expected = written
    assert layout_named(miniature.layout).scenes(root) == (expected.scene,)
    with miniature.within():
        scene = read(miniature.layout, root, expected.scene)
        compare(scene, expected, pose_error=miniature.pose_error)
    assert list(scene.names) == sorted(scene.names, key=natural_key)
    assert all(file.is_file() for view in scene for file in view.files)


@pytest.mark.parametrize("miniature", PARTIAL, ids=lambda miniature: miniature.title)
def test_what_a_partial_download_lacks_is_left_out_and_counted(miniature, tmp_path):
    expected = miniature.write(tmp_path)
    pictures = sorted(tmp_path.glob(miniature.pictures))
    pictures[1].unlink()
    pictures[2].write_bytes(b"")
    whole = len(expected.cameras)
    scene = read(miniature.layout, tmp_path, expected.scene)
    assert len(scene) == whole - 2
    assert set(scene.names) < set(expected.cameras.names)
    warnings = [finding.message for finding in scene.findings if finding.level == "warning"]
    assert any(line.startswith(f"2 of {whole} ") for line in warnings), warnings
    for view in scene:
        view.load()
    for picture in pictures:
        picture.unlink(missing_ok=True)
    with pytest.raises(ProjectError):
        read(miniature.layout, tmp_path, expected.scene)


def test_an_empty_folder_holds_no_scene(tmp_path: Path) -> None:
    for name in {miniature.layout for miniature in ALL}:
        assert layout_named(name).scenes(tmp_path) == ()


# --- real scenes, against the readers of projects ---------------------------------------------
