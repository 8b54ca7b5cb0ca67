from __future__ import annotations

import argparse

import numpy as np
import pytest
from scenes_workspace import sevenscenes, workspace

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.project import rgbd_options
from gvtools.scenes.scene import Scene
from pipelines.commands.arguments import add_scene_arguments, open_scene, reading_of


def parsed(*words: object) -> argparse.Namespace:
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_scene_arguments(parser)
    return parser.parse_args([str(word) for word in words])


def depth_of(scene: Scene) -> np.ndarray:
    depth = scene.views[0].load().depth
    assert depth is not None
    return depth


def test_nothing_given_is_no_rgbd_option(tmp_path):
    assert rgbd_options(reading_of(parsed())) is None
    workspace(tmp_path)
    assert open_scene(tmp_path, parsed()).kind == "colmap"


def test_images_and_masks_reach_the_reader(tmp_path):
    workspace(tmp_path / "project")
    (tmp_path / "project" / "images").rename(tmp_path / "pictures")
    with pytest.raises(ProjectError, match="--images"):
        open_scene(tmp_path / "project", parsed())
    scene = open_scene(tmp_path / "project", parsed("--images", tmp_path / "pictures"))
    assert scene.views[0].load().rgb.any()
    with pytest.raises(ProjectError, match="masked"):
        masks = ("--masks", tmp_path / "masked")
        open_scene(tmp_path / "project", parsed("--images", tmp_path / "pictures", *masks))


def test_depth_unit_and_intrinsics_change_what_is_read(tmp_path):
    sevenscenes(tmp_path)
    plain = open_scene(tmp_path, parsed())
    double = open_scene(tmp_path, parsed("--depth-unit", 0.002))
    np.testing.assert_allclose(depth_of(double), 2 * depth_of(plain))
    other = open_scene(tmp_path, parsed("--color-intrinsics", "100,101,40,30"))
    # Published with the first pixel's centre at (0, 0), here at (0.5, 0.5).
    expected = np.array([[100, 0, 40.5], [0, 101, 30.5], [0, 0, 1]])
    np.testing.assert_allclose(other.views[0].camera.K[0], expected)
    near = open_scene(tmp_path, parsed("--depth-max", 1.0))
    assert not depth_of(near).any()


def test_registration_takes_the_matrix_of_a_file(tmp_path):
    sevenscenes(tmp_path)
    file = tmp_path / "moved.txt"
    moved = np.eye(4)
    moved[0, 3] = 0.2
    np.savetxt(file, moved)
    args = parsed("--depth-intrinsics", "90,90,47.5,35.5", "--color-from-depth", file)
    depth = depth_of(open_scene(tmp_path, args))
    plain = depth_of(open_scene(tmp_path, parsed()))
    # A wall at 2 m moves by 90 x 0.2 / 2 = 9 pixels: the left edge has none now.
    assert not depth[:, :8].any()
    np.testing.assert_allclose(depth[10:60, 12:90], plain[10:60, 3:81], rtol=1e-3)


@pytest.mark.parametrize("text", ["1 2 3", "a b", "1 0 0 0\n0 1 0 0\n0 0 1 0"])
def test_a_file_without_a_matrix(tmp_path, text):
    file = tmp_path / "moved.txt"
    file.write_text(text)
    with pytest.raises(OptionError, match=r"moved\.txt.*4x4|four rows of four"):
        rgbd_options(reading_of(parsed("--color-from-depth", file)))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--depth-unit", "-1"), "no positive number"),
        (("--depth-unit", "nan"), "no positive number"),
        (("--color-intrinsics", "1,2,3"), "four numbers"),
        (("--depth-intrinsics", "0,1,2,3"), "above 0"),
    ],
)
def test_numbers_that_are_none(words, message):
    with pytest.raises(argparse.ArgumentError, match=message):
        parsed(*words)


def test_rgbd_options_on_a_colmap_project_are_refused(tmp_path):
    workspace(tmp_path)
    with pytest.raises(OptionError, match="expected no RGB-D options"):
        open_scene(tmp_path, parsed("--depth-unit", "0.001"))
