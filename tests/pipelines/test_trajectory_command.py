"""``gvtools trajectory`` from the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import refused
from trajectory_writers import write_kitti, write_tum
from walks import disturbed, line, moved, path

from gvtools.cameras import Cameras, invert_rigid
from gvtools.scenes.colmap_model import write_colmap
from pipelines.cli import main


def cameras(poses: np.ndarray, names: tuple[str, ...] = ()) -> Cameras:
    K = np.tile(np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), (len(poses), 1, 1))
    return Cameras(K, invert_rigid(poses), np.array(64), np.array(48), names)


def measured(tmp_path, *arguments: object) -> dict:
    file = tmp_path / "figures.json"
    assert main(["trajectory", *map(str, arguments), "--json", str(file), "--quiet"]) == 0
    return json.loads(file.read_text())


def test_files_of_one_layout(tmp_path):
    reference = path()
    for layout, write in (("tum", write_tum), ("kitti", write_kitti)):
        one, two = tmp_path / f"{layout}.a.txt", tmp_path / f"{layout}.b.txt"
        write(one, cameras(reference))
        write(two, cameras(moved(reference, scale=3)))
        figures = measured(tmp_path, "ate", one, two)
        assert figures["status"] == "aligned"
        assert figures["rmse"] < 1e-9
        assert figures["scale"] == pytest.approx(1 / 3)
        assert figures["n"] == figures["associated"] == 40
        assert figures["association"] == ("time" if layout == "tum" else "index")
        assert figures["auc"]["3"] > 0.99
        assert figures["notes"] == {}


def test_an_euroc_file_against_a_tum_file(tmp_path):
    from scipy.spatial.transform import Rotation

    reference = path()
    write_tum(tmp_path / "tum.txt", cameras(reference))
    rows = ["#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z, v_x, v_y, v_z"]
    for i, pose in enumerate(disturbed(reference, metres=0.1)):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        values = [*pose[:3, 3], w, x, y, z, 0, 0, 0]
        rows.append(",".join([str(i * 10**9), *(f"{v:.17g}" for v in values)]))
    (tmp_path / "data.csv").write_text("\n".join(rows))
    figures = measured(tmp_path, "ate", tmp_path / "tum.txt", tmp_path / "data.csv")
    assert figures["associated"] == 40
    assert 0.1 < figures["rmse"] < 0.25
    assert figures["rotation_deg"]["max"] < 5


def test_a_colmap_model_without_pictures_is_paired_by_name(tmp_path):
    reference = path()
    names = tuple(f"{i:03d}.png" for i in range(len(reference)))
    write_colmap(tmp_path / "a/sparse/0", cameras(reference, names))
    write_colmap(tmp_path / "b", cameras(moved(reference)[5:25], names[5:25]))
    figures = measured(tmp_path, "rpe", tmp_path / "a", tmp_path / "b", "--delta", 3, "--all-pairs")
    assert figures["association"] == "name"
    assert figures["associated"] == 20
    assert figures["n"] == 17
    assert figures["rmse"] < 1e-9


def test_degenerate_paths_are_null_with_the_reason(tmp_path, capsys):
    write_tum(tmp_path / "line.txt", cameras(line()))
    file = tmp_path / "line.txt"
    figures = measured(tmp_path, "ate", file, file)
    assert figures["rmse"] is None
    assert figures["rotation_deg"]["rmse"] is None
    assert "collinear" in figures["status"]
    assert "collinear" in figures["notes"]["rmse"]
    assert "collinear" in capsys.readouterr().err
    assert measured(tmp_path, "ate", file, file, "--align", "none")["rmse"] == 0


def test_the_table_is_printed_without_json(tmp_path, capsys):
    write_tum(tmp_path / "a.txt", cameras(path()))
    assert main(["trajectory", "ate", str(tmp_path / "a.txt"), str(tmp_path / "a.txt")]) == 0
    text = capsys.readouterr().out
    assert "rotation, degrees" in text
    assert "associated by time" in text


def test_wrong_input_ends_in_one_line(tmp_path, capsys):
    write_tum(tmp_path / "a.txt", cameras(path()))
    write_kitti(tmp_path / "b.txt", cameras(path(39)))
    a, b = tmp_path / "a.txt", tmp_path / "b.txt"
    assert "40 and 39" in refused(capsys, "trajectory", "ate", a, b)
    assert "no such file" in refused(capsys, "trajectory", "ate", a, tmp_path / "c.txt")
    assert "no times" in refused(capsys, "trajectory", "ate", a, b, "--associate", "time")
    assert "no names" in refused(capsys, "trajectory", "ate", a, b, "--associate", "name")
    assert "--layout" in refused(capsys, "trajectory", "ate", a, a, "--layout", "ros")
    assert "expected 1 frame" in refused(capsys, "trajectory", "rpe", a, a, "--delta", "0")
