from __future__ import annotations

import argparse

import numpy as np
import pytest
from command_line import arguments
from scenes_workspace import sevenscenes, workspace

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.project import rgbd_options
from gvtools.scenes.scene import Scene
from pipelines.commands.arguments import SceneArguments


def parsed(*words: object) -> SceneArguments:
    parser = argparse.ArgumentParser(exit_on_error=False)
    SceneArguments.add(parser)
    return SceneArguments.read(parser.parse_args([str(word) for word in words]))


def depth_of(scene: Scene) -> np.ndarray:
    depth = scene.views[0].load().depth
    assert depth is not None
    return depth


def test_nothing_given_is_no_rgbd_option(tmp_path):
    assert rgbd_options(parsed().reading()) is None
    workspace(tmp_path)
    assert parsed().open_scene(tmp_path).kind == "colmap"


def test_masks_of_photographs_are_no_option_of_recordings(tmp_path):
    words = ("capture", tmp_path, "--out", tmp_path / "out", "--masks", tmp_path)
    assert arguments(*words, "--depth-unit", 0.002).reading() == {"depth_unit": 0.002}


def test_images_and_masks_reach_the_reader(tmp_path):
    workspace(tmp_path / "project")
    (tmp_path / "project" / "images").rename(tmp_path / "pictures")
    with pytest.raises(ProjectError, match="--images"):
        parsed().open_scene(tmp_path / "project")
    scene = parsed("--images", tmp_path / "pictures").open_scene(tmp_path / "project")
    assert scene.views[0].load().rgb.any()
    with pytest.raises(ProjectError, match="masked"):
        masks = ("--masks", tmp_path / "masked")
        parsed("--images", tmp_path / "pictures", *masks).open_scene(tmp_path / "project")


def test_depth_unit_and_intrinsics_change_what_is_read(tmp_path):
    sevenscenes(tmp_path)
    plain = parsed().open_scene(tmp_path)
    double = parsed("--depth-unit", 0.002).open_scene(tmp_path)
    np.testing.assert_allclose(depth_of(double), 2 * depth_of(plain))
    other = parsed("--color-intrinsics", "100,101,40,30").open_scene(tmp_path)
    # Published with the first pixel's centre at (0, 0), here at (0.5, 0.5).
    expected = np.array([[100, 0, 40.5], [0, 101, 30.5], [0, 0, 1]])
    np.testing.assert_allclose(other.views[0].camera.K[0], expected)
    assert any("used as given" in finding.message for finding in other.findings)
    near = parsed("--depth-max", 1.0).open_scene(tmp_path)
    assert not depth_of(near).any()


@pytest.mark.parametrize("text", ["1 2 3", "a b", "1 0 0 0\n0 1 0 0\n0 0 1 0"])
def test_a_file_without_a_matrix(tmp_path, text):
    file = tmp_path / "moved.txt"
    file.write_text(text)
    with pytest.raises(OptionError, match=r"moved\.txt.*4x4|four rows of four"):
        rgbd_options(parsed("--color-from-depth", file).reading())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--depth-unit", "-1"), "--depth-unit -1; expected more than 0"),
        (("--depth-unit", "nan"), "--depth-unit nan; expected more than 0"),
        (("--color-intrinsics", "1,2,3"), "four finite numbers"),
        (("--depth-intrinsics", "0,1,2,3"), "above 0"),
    ],
)
def test_numbers_that_are_none(words, message):
    with pytest.raises(OptionError, match=message):
        parsed(*words)


def test_rgbd_options_on_a_colmap_project_are_refused(tmp_path):
    workspace(tmp_path)
    with pytest.raises(OptionError, match="expected no RGB-D options"):
        parsed("--depth-unit", "0.001").open_scene(tmp_path)
