"""Real scenes through the readers of native layouts, against the readers of projects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from data_sets.miniature import layout_named
from data_sets.miniature import read_miniature as read

from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.scene import Scene
from gvtools.scenes.transforms_json import read_transforms

pytestmark = pytest.mark.data


def same(scene: Scene, other: Scene) -> None:
    assert scene.names == other.names
    np.testing.assert_allclose(scene.cameras.K, other.cameras.K, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        scene.cameras.cam_from_world, other.cameras.cam_from_world, rtol=0, atol=1e-12
    )
    for view in (scene.views[0], scene.views[-1]):
        np.testing.assert_array_equal(view.load().rgb, other[view.name].load().rgb)


@pytest.mark.parametrize("layout", ["mipnerf360", "tanks_and_temples"])
@pytest.mark.parametrize("name", ["fern_colmap", "fox_colmap", "sceaux_colmap"])
def test_a_model_is_read_as_a_project_is(shared: Path, layout: str, name: str) -> None:
    root = shared / "data"
    assert name in layout_named(layout).scenes(root)
    scene, project = read(layout, root, name), read_colmap(root / name)
    same(scene, project)
    assert scene.points is not None
    assert project.points is not None
    np.testing.assert_array_equal(scene.points.point_index, project.points.point_index)
    np.testing.assert_allclose(scene.points.xy, project.points.xy, rtol=0, atol=1e-9)


def test_a_file_of_nerfstudio_is_read_as_a_project_is(shared: Path) -> None:
    root = shared / "data"
    assert "fox_transforms" in layout_named("dl3dv").scenes(root)
    same(read("dl3dv", root, "fox_transforms"), read_transforms(root / "fox_transforms"))
