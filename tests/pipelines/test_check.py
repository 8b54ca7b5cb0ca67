from __future__ import annotations

import json

import numpy as np
import pytest
import skimage.data
from command_line import run_command
from PIL import Image
from scenes_workspace import HEIGHT, WIDTH, sevenscenes, workspace

from gvtools.errors import ProjectError


def run(*words: object) -> None:
    run_command("check", *words)


def test_a_good_project_is_ok_and_told_in_lines(tmp_path, capsys):
    sevenscenes(tmp_path)
    run(tmp_path)
    out = capsys.readouterr().out
    assert "ok: true" in out
    assert f"{WIDTH}x{HEIGHT} (3 views)" in out
    assert "info: depth unit: 0.001 m" in out


def test_json_holds_the_report(tmp_path):
    reconstruction = workspace(tmp_path / "project", "PINHOLE")
    run(tmp_path / "project", "--json", tmp_path / "report.json")
    data = json.loads((tmp_path / "report.json").read_text())
    assert data["ok"] is True
    assert data["views"] == data["views_opened"] == reconstruction.num_reg_images()
    assert data["sparse_points"] == reconstruction.num_points3D()
    assert data["depth"] is None


def test_a_project_without_depth_is_ok_and_told(tmp_path, capsys):
    workspace(tmp_path)
    run(tmp_path)
    out = capsys.readouterr().out
    assert "info: none of the 4 views has recorded depth" in out
    assert "ok: true" in out


def test_an_unreadable_picture_is_an_error_after_the_report(tmp_path, capsys):
    sevenscenes(tmp_path / "project")
    (tmp_path / "project" / "frame-000001.color.png").write_bytes(b"no picture")
    with pytest.raises(ProjectError, match=r"not ok: 1 errors, first: .*frame-000001"):
        run(tmp_path / "project")
    out = capsys.readouterr().out
    assert "ok: false" in out
    assert out.index("error: ") < out.index("info: ")
    with pytest.raises(ProjectError):
        run(tmp_path / "project", "--json", tmp_path / "report.json")
    data = json.loads((tmp_path / "report.json").read_text())
    assert data["ok"] is False
    assert data["views_opened"] == 2


def test_what_cannot_be_opened_is_in_the_json_too(tmp_path):
    with pytest.raises(ProjectError, match="no such folder"):
        run(tmp_path / "absent", "--json", tmp_path / "report.json")
    data = json.loads((tmp_path / "report.json").read_text())
    assert data["ok"] is False
    assert "no such folder" in data["findings"][0]["message"]


@pytest.mark.data
def test_the_kitchen(shared, capsys):
    run(shared / "data" / "redwood_rgbd5")
    out = capsys.readouterr().out
    assert "ok: true" in out
    assert np.char.count(out, "info: ") >= 1


def test_poses_that_contradict_each_other_are_a_warning(tmp_path, capsys):
    sevenscenes(tmp_path, frames=4)
    pose = (tmp_path / "frame-000000.pose.txt").read_text()
    for i, name in enumerate(("astronaut", "astronaut", "coffee", "coffee")):
        picture = Image.fromarray(getattr(skimage.data, name)()).resize((WIDTH, HEIGHT))
        picture.save(tmp_path / f"frame-{i:06d}.color.png")
        (tmp_path / f"frame-{i:06d}.pose.txt").write_text(pose)
    run(tmp_path)
    out = capsys.readouterr().out
    assert "warning: 4 pairs of views have nearly equal cameras but show different things" in out
    assert "ok: true" in out
