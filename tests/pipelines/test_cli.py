"""Bad input from the command line: one clear line, status 2, nothing lost."""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import arguments, refused
from scenes_workspace import sevenscenes, workspace
from tiny_scan import write_scan

import gvtools
from gvtools.errors import GvError, OptionError, ProjectError
from gvtools.scenes.project import rgbd_options
from gvtools.scenes.scene import Scene
from pipelines import cli
from pipelines.cli import COMMANDS, build_parser, main
from pipelines.commands.arguments import SceneArguments
from pipelines.commands.weights import WeightsCommand

RUN = ("--context", "first:2", "--targets", "range:2-5", "--views-per-round", "2", "--quiet")


@pytest.fixture
def scan(tmp_path):
    return write_scan(tmp_path / "scan")


def reconstruct(*arguments: object) -> tuple[object, ...]:
    return ("reconstruct", *arguments, "--refine", "0", "--set", "refine.poses=false", *RUN)


@pytest.mark.parametrize(
    "command", [*COMMANDS, *(f"weights {action}" for action in WeightsCommand.actions)]
)
def test_every_help_starts_with_two_examples(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert text.count(f"  gvtools {command}") >= 2
    # The examples are accepted by the parser itself.
    for line in text.splitlines():
        if line.startswith(f"  gvtools {command}"):
            build_parser().parse_args(line.split()[1:])


@pytest.mark.parametrize(("only", "more"), [("None", ""), ("''", "'numba', 'cv2', 'numpy',")])
def test_the_commands_start_without_heavy_imports(only, more):
    heavy = f"({more}'torch', 'open3d', 'pycolmap', 'matplotlib')"
    code = (
        f"import sys, pipelines.cli as c; c.build_parser(only={only});"
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def _empty(scan: Path) -> None:
    shutil.rmtree(scan)
    scan.mkdir()


def _torn_picture(scan: Path) -> None:
    path = scan / "frame-000003.color.png"
    path.write_bytes(path.read_bytes()[:200])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_empty, ("COLMAP", "transforms.json")),
        (_torn_picture, ("frame-000003.color.png",)),
    ],
)
def test_a_project_that_cannot_be_read(capsys, scan, tmp_path, spoil, words):
    spoil(scan)
    line = refused(capsys, *reconstruct(scan, "--out", tmp_path / "run"))
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--context", "all", "--targets", "first:2"), "--allow-overlap"),
        (("--voxle", "1"), "--voxle"),
        (("--set", "splat.depth_bnad=1"), "splat.depth_band"),
    ],
)
def test_options_that_cannot_be(capsys, scan, tmp_path, options, word):
    out = tmp_path / "run"
    assert word in refused(capsys, *reconstruct(scan, "--out", out), *options)
    assert not out.exists()


def test_a_rotation_orthonormal_to_4e_4_is_accepted(scan, tmp_path):
    path = scan / "frame-000001.pose.txt"
    pose = np.loadtxt(path)
    pose[:3, :3] *= 1 + 2e-4
    np.savetxt(path, pose)
    assert main([str(a) for a in reconstruct(scan, "--out", tmp_path / "run", "--dry-run")]) == 0


def test_a_debug_run_shows_where(scan, tmp_path):
    shutil.rmtree(scan)
    with pytest.raises(GvError):
        main([str(a) for a in reconstruct(scan, "--out", tmp_path / "run", "--debug")])


@pytest.mark.parametrize("option", ["--voxel=auto", "--voxel=none", "--max-side=none"])
def test_an_option_takes_the_word_for_no_value_of_its_setting(scan, tmp_path, option):
    out = tmp_path / "run"
    assert main([str(a) for a in reconstruct(scan, "--out", out, "--dry-run", option)]) == 0


def test_names_that_a_console_cannot_show_are_escaped(scan, tmp_path, monkeypatch):
    place = shutil.copytree(scan, tmp_path / "Küche")
    console = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", console)
    assert main(["check", str(place)]) == 0
    console.flush()
    assert b"K\\xfcche" in console.buffer.getvalue()


@pytest.mark.parametrize("before", ["", "from gvtools.colmap import pycolmap;"])
def test_a_termination_is_one_line_and_143(before):
    code = (
        "import os, signal, sys;"
        "from pipelines import cli;"
        "from pipelines.commands import data;"
        f"data.ListData.run = data.CheckCommand.run = lambda *_: exec("
        f"'{before}os.kill(os.getpid(), signal.SIGTERM)');"
        "sys.exit(cli.main(['check', '.']))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 143
    assert run.stderr.startswith("gvtools: terminated; ") and run.stderr.count("\n") == 1


@pytest.mark.parametrize(("name", "place"), [("pycolmap", "colmap"), ("open3d as o3d", "o3d")])
def test_what_is_set_up_at_its_import_is_imported_in_one_place(name, place):
    """pycolmap's handlers of signals; Open3D's threads."""
    root = Path(gvtools.__file__).parents[1]
    inside = re.compile(rf"^(    )*import {name}$", re.M)
    for package in ("gvtools", "pipelines", "viz"):
        for file in (root / package).rglob("*.py"):
            text = re.sub(
                r"^if TYPE_CHECKING:\n(    .*\n|\n)*", "", file.read_text("utf-8"), flags=re.M
            )
            assert file == root / "gvtools" / f"{place}.py" or not inside.search(text), file


def test_closed_streams_are_no_reason_to_fail(monkeypatch):
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    assert main(["completers"]) == 0
    assert main(["completers", "--json", "/"]) == 2


def test_a_termination_while_a_command_loads_is_told_too(monkeypatch, capsys):
    def terminated(name: str) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(cli, "import_module", terminated)
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        assert main(["check", "."]) == 143
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err.startswith("gvtools: terminated; ")


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
