"""Every native layout: a miniature written in it is read back to the pixel and the pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from data_sets.miniature import Expected, Miniature, compare, layout_named, miniatures
from data_sets.miniature import read_miniature as read

from gvtools.errors import ProjectError
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.scene import Scene, natural_key
from gvtools.scenes.transforms import read_transforms

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


def same(scene: Scene, other: Scene) -> None:
    assert scene.names == other.names
    np.testing.assert_allclose(scene.cameras.K, other.cameras.K, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        scene.cameras.cam_from_world, other.cameras.cam_from_world, rtol=0, atol=1e-12
    )
    for view in (scene.views[0], scene.views[-1]):
        np.testing.assert_array_equal(view.load().rgb, other[view.name].load().rgb)


@pytest.mark.data
@pytest.mark.parametrize(
    ("layout", "name"),
    [
        ("mipnerf360", "fern_colmap"),
        ("tanks_and_temples", "sceaux_colmap"),
        pytest.param("mipnerf360", "fox_colmap", marks=pytest.mark.slow),
        pytest.param("tanks_and_temples", "fox_colmap", marks=pytest.mark.slow),
    ],
)
def test_a_model_is_read_as_a_project_is(shared: Path, layout: str, name: str) -> None:
    root = shared / "data"
    assert name in layout_named(layout).scenes(root)
    scene, project = read(layout, root, name), read_colmap(root / name)
    same(scene, project)
    assert scene.points is not None
    assert project.points is not None
    np.testing.assert_array_equal(scene.points.point_index, project.points.point_index)
    np.testing.assert_allclose(scene.points.xy, project.points.xy, rtol=0, atol=1e-9)


@pytest.mark.data
def test_a_file_of_nerfstudio_is_read_as_a_project_is(shared: Path) -> None:
    root = shared / "data"
    assert "fox_transforms" in layout_named("dl3dv").scenes(root)
    same(read("dl3dv", root, "fox_transforms"), read_transforms(root / "fox_transforms"))
