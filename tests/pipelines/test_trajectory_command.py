from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import refused
from scipy.spatial.transform import Rotation
from trajectory_writers import write_kitti, write_tum
from walks import disturbed, line, moved, path

from gvtools.cameras import Cameras, invert_rigid
from gvtools.scenes.colmap_writer import write_colmap
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
    for layout, written in (("tum", write_tum), ("kitti", write_kitti)):
        one, two = tmp_path / f"{layout}.a.txt", tmp_path / f"{layout}.b.txt"
        written(one, cameras(reference))
        written(two, cameras(moved(reference, scale=3)))
        figures = measured(tmp_path, "ate", one, two)
        assert figures["status"] == "aligned"
        assert figures["rmse"] < 1e-9
        assert figures["scale"] == pytest.approx(1 / 3)
        assert figures["n"] == figures["associated"] == 40
        assert figures["association"] == ("time" if layout == "tum" else "index")
        assert figures["auc"]["3"] > 0.99
        assert figures["notes"] == {}


def test_an_euroc_file_against_a_tum_file(tmp_path):
    head = "#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z, v_x, v_y, v_z\n"
    lines = [[*row, "0", "0", "0"] for row in rows(disturbed(path(), metres=0.1), "wxyz", 1e-9)]
    tum = write(tmp_path / "tum.txt", rows(path()))
    figures = measured(tmp_path, "ate", tum, write(tmp_path / "data.csv", lines, ",", head))
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
    file, out = tmp_path / "line.txt", tmp_path / "out.json"
    write_tum(file, cameras(line()))
    figures = measured(tmp_path, "ate", file, file)
    assert figures["rmse"] < 1e-12
    assert figures["rotation_deg"]["rmse"] is None
    assert "line" in figures["notes"]["rotation_deg"]
    write_tum(file, cameras(path(2)))
    assert "no figures" in refused(capsys, "trajectory", "ate", file, file, "--json", out)
    assert "at least 3" in json.loads(out.read_text())["notes"]["rmse"]
    assert measured(tmp_path, "ate", file, file, "--align", "none")["rmse"] == 0


def rows(poses: np.ndarray, order: str = "xyzw", unit: float = 1.0) -> list[list[str]]:
    """Lines of a file: a time every 0.1 s, the position, the quaternion in an order."""
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, ["xyzw".index(k) for k in order]]
    values = np.column_stack([poses[:, :3, 3], turns])
    stamps = [
        f"{round((100 + i / 10) / unit) if unit < 1 else 100 + i / 10}" for i in range(len(poses))
    ]
    return [[time, *(f"{v:.17g}" for v in row)] for time, row in zip(stamps, values, strict=True)]


def write(file: Path, lines: list[list[str]], between: str = " ", head: str = "") -> Path:
    """Lines in a file, and the file."""
    file.write_text(head + "\n".join(map(between.join, lines)))
    return file


EUROC_HEAD = "#timestamp [ns], p_RS_R_x [m], p_y [m], p_z [m], q_RS_w [], q_x [], q_y [], q_z []\n"


@pytest.mark.parametrize(
    ("name", "head", "order", "unit", "comma", "said"),
    [
        ("a.txt", EUROC_HEAD, "wxyz", 1e-9, ",", ""),
        ("a.txt", "", "wxyz", 1e-9, ",", ""),
        ("a.csv", "", "xyzw", 1, " ", ""),
        ("a.csv", "", "xyzw", 1, ",", "columns taken as timestamp tx"),
        ("a.csv", "num,t,x,y,z,qx,qy,qz,qw\n", "xyzw", 1, ",", ""),
        ("a.txt", "# time_us tx ty tz qw qx qy qz\n", "wxyz", 1e-6, " ", ""),
        ("a.txt", "", "xyzw", 1e-9, " ", "read as ns"),
        ("a.txt", "", "xyzw", 1e-6, " ", "read as us"),
        ("a.txt", "", "xyzw", 1e-3, " ", ""),
    ],
)
def test_heads_and_numbers_decide_columns_and_units(
    tmp_path, capsys, name, head, order, unit, comma, said
):
    reference = path()
    lines = rows(reference, order, unit)
    if head.startswith("num"):
        lines = [[str(i), *row] for i, row in enumerate(lines)]
    tum, other = write(tmp_path / "tum.txt", rows(reference)), tmp_path / name
    figures = measured(tmp_path, "ate", tum, write(other, lines, comma, head))
    assert figures["associated"] == 40
    assert figures["rotation_deg"]["max"] < 1e-5
    assert said in capsys.readouterr().err
    assert ("thousandths" in figures["association"]) == (unit == 1e-3)


def test_contradictions_are_refused_with_the_layout(tmp_path, capsys):
    file = write(tmp_path / "a.txt", rows(path(), "wxyz", 1e-9), ",", EUROC_HEAD)
    words = ("trajectory", "ate", file, file)
    assert "leave --layout out" in refused(capsys, *words, "--layout", "tum")
    write(file, rows(path(), "wxyz"), ",", EUROC_HEAD)
    assert "mend the head" in refused(capsys, *words)
    write(file, rows(path() @ np.linalg.inv(path()[0]), "wxyz"))
    assert "--layout" in refused(capsys, "trajectory", "ate", file, file)
    assert measured(tmp_path, "ate", file, file, "--layout", "euroc")["rmse"] < 1e-9


def test_shuffled_and_repeated_stamps_change_no_figure(tmp_path, capsys):
    reference, estimate = path(), disturbed(path(), metres=0.05)
    lines = rows(estimate)
    one, two = write(tmp_path / "a.txt", rows(reference)), write(tmp_path / "b.txt", lines)
    pairs = ((one, two), (two, one))
    right = [measured(tmp_path, "rpe", *pair)["rmse"] for pair in pairs]
    write(two, [*lines[20:], *lines[:25]])
    assert [measured(tmp_path, "rpe", *pair)["rmse"] for pair in pairs] == right
    assert "1 of 45 time stamps not in order, sorted" in (text := capsys.readouterr().err)
    assert "5 repeated, merged" in text


def test_pictures_named_by_their_time_are_paired_as_stamps(tmp_path, capsys):
    reference = path()
    a, b = tmp_path / "a", tmp_path / "b"
    write_colmap(a, cameras(reference, tuple(f"{100 + i / 10:.2f}.png" for i in range(40))))
    write_colmap(b, cameras(reference, tuple(f"{100.04 + i / 10:.2f}.png" for i in range(40))))
    assert "no pair within 0.01 s" in refused(capsys, "trajectory", "ate", a, b)
    tum = write(tmp_path / "tum.txt", rows(reference))
    euroc = write(tmp_path / "data.csv", rows(reference, "wxyz", 1e-9), ",")
    write_colmap(b, cameras(reference, tuple(f"cam0/{100 + i / 10:.1f}.jpg" for i in range(40))))
    for file in (tum, euroc, b):
        figures = measured(tmp_path, "ate", a, file)
        assert (figures["association"], figures["associated"]) == ("time", 40)
        assert figures["rmse"] < 1e-9


@pytest.mark.parametrize(
    ("name", "other"),
    [
        # A date, a second apart: no time in microseconds.
        (lambda i: f"202611271200{i:02d}123.jpg", lambda i: f"202611271201{i:02d}123.jpg"),
        (lambda i: f"v1.{i}.png", lambda i: f"v2.{i}.png"),
    ],
)
def test_names_that_look_like_times_are_paired_as_names(tmp_path, capsys, name, other):
    for folder, named in (("a", name), ("b", other)):
        names = tuple(named(i) for i in range(40))
        write_colmap(tmp_path / folder, cameras(path(), names))
    text = refused(capsys, "trajectory", "ate", tmp_path / "a", tmp_path / "b")
    assert "none of 40 and 40 names is equal" in text


@pytest.mark.parametrize(
    "named", ["rgb_{}.{:09d}.png", "cam0/image-{}-{:09d}.jpg", "{}_{:09d}.png"]
)
def test_times_within_names_are_paired_with_a_file_s(tmp_path, capsys, named):
    stamps = [(1_600_000_000 + i // 10, i % 10 * 10**8) for i in range(40)]
    write_colmap(tmp_path / "a", cameras(path(), tuple(named.format(*stamp) for stamp in stamps)))
    values = [row[1:] for row in rows(path())]
    lines = [[*map(str, stamp), *row] for stamp, row in zip(stamps, values, strict=True)]
    head = '"sec","nsec","x","y","z","qx","qy","qz","qw"\n'
    # Not the first pose, but as many: paired by order, all would be of other moments.
    file = write(tmp_path / "b.csv", [*lines[1:], lines[0]], ",", head)
    figures = measured(tmp_path, "ate", tmp_path / "a", file)
    assert (figures["association"], figures["associated"]) == ("time", 40)
    assert figures["rmse"] < 1e-9
    assert "not in order" in capsys.readouterr().err


def test_pairs_of_doubtful_moments_are_warned_of(tmp_path, capsys):
    names = tuple(f"{i:03d}.png" for i in range(40))
    write_colmap(tmp_path / "a", cameras(path(), names))
    files = [tmp_path / "b.txt", tmp_path / "c.txt"]
    for file, late in zip(files, (0, 0.04), strict=True):
        write(file, [[f"{float(time) + late}", *rest] for time, *rest in rows(path())])
    figures = measured(tmp_path, "ate", tmp_path / "a", files[0])
    assert "order alone" in figures["notes"]["association"][0]
    figures = measured(tmp_path, "ate", *files, "--max-difference", "1")
    assert "differ by 0.04 s (median)" in figures["notes"]["association"][0]
    assert capsys.readouterr().err.count("warning") == 2


def test_numbers_of_frames_against_seconds_are_warned_of(tmp_path, capsys):
    for name, rate in (("a.txt", 10), ("b.txt", 1)):
        write(tmp_path / name, [[f"{i / rate}", *row[1:]] for i, row in enumerate(rows(path()))])
    figures = measured(tmp_path, "ate", tmp_path / "a.txt", tmp_path / "b.txt")
    assert figures["associated"] == 4
    assert "--associate index" in figures["notes"]["association"][0]
    assert "warning" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("rate", "dense", "said"),
    [
        (1.5, 1, "run 1.5 times as fast"),
        (1.5, 20, "run 1.5 times as fast"),
        (1.01, 1, "40 poses find a partner instead of 1"),
        (1, 20, ""),
    ],
)
def test_clocks_of_another_rate_are_warned_of(tmp_path, rate, dense, said):
    every = path(39 * dense + 1)
    for name, poses, step in (("a", every, 0.1 / dense), ("b", every[::dense], 0.1 * rate)):
        write(tmp_path / name, [[f"{i * step}", *row[1:]] for i, row in enumerate(rows(poses))])
    notes = measured(tmp_path, "ate", tmp_path / "a", tmp_path / "b")["notes"]
    assert said in "".join(notes.get("association", []))
    assert bool(said) == ("association" in notes)


def test_the_table_is_printed_without_json(tmp_path, capsys):
    write_tum(tmp_path / "a.txt", cameras(path()))
    assert main(["trajectory", "ate", str(tmp_path / "a.txt"), str(tmp_path / "a.txt")]) == 0
    text = capsys.readouterr().out
    assert "rotation, degrees" in text
    assert "associated by time" in text
    assert main(["trajectory", "rpe", *[str(tmp_path / "a.txt")] * 2, "--delta", "5"]) == 0
    assert "pairs 5 frame(s) of these poses apart" in capsys.readouterr().out


def test_wrong_input_ends_in_one_line(tmp_path, capsys):
    write_tum(tmp_path / "a.txt", cameras(path()))
    write_kitti(tmp_path / "b.txt", cameras(path(39)))
    a, b = tmp_path / "a.txt", tmp_path / "b.txt"
    assert "40 and 39" in refused(capsys, "trajectory", "ate", a, b)
    assert "no such file" in refused(capsys, "trajectory", "ate", a, tmp_path / "c.txt")
    assert "no times" in refused(capsys, "trajectory", "ate", a, b, "--associate", "time")
    assert "no names" in refused(capsys, "trajectory", "ate", a, b, "--associate", "name")
    assert "--layout" in refused(capsys, "trajectory", "ate", a, a, "--layout", "ros")
    assert "--delta: belongs to rpe" in refused(capsys, "trajectory", "ate", a, a, "--delta", "2")
    assert "expected 1 frame" in refused(capsys, "trajectory", "rpe", a, a, "--delta", "0")


MATRICES: dict[str, Callable[[int, np.ndarray], str]] = {
    "16 numbers": lambda i, m: " ".join(map(repr, m.ravel().tolist())),
    "16 with commas": lambda i, m: ",".join(f"{v:.17e}" for v in m.ravel()),
    "17, a number in front": lambda i, m: f"{i} " + " ".join(map(repr, m.ravel().tolist())),
    "13, a time in front": lambda i, m: f"{i}.0 " + " ".join(map(repr, m[:3].ravel().tolist())),
    "blocks": lambda i, m: "\n".join(" ".join(map(repr, row)) for row in m.tolist()) + "\n",
    "log": lambda i, m: f"{i} {i} {i + 1}\n" + MATRICES["blocks"](i, m).rstrip(),
}


@pytest.mark.parametrize("kind", MATRICES)
def test_matrices_of_every_writing(tmp_path, kind):
    write_tum(tmp_path / "tum.txt", cameras(path()))
    lines = [MATRICES[kind](i, pose) for i, pose in enumerate(path())]
    (tmp_path / "a.txt").write_text("\n".join(lines))
    figures = measured(tmp_path, "ate", tmp_path / "tum.txt", tmp_path / "a.txt")
    assert (figures["associated"], figures["notes"]) == (40, {})
    assert max(figures["rmse"], figures["rotation_deg"]["max"]) < 1e-5
    assert figures["association"] == ("time" if "front" in kind else "index")


@pytest.mark.parametrize("between", [" ", ";"])
def test_decimal_commas_are_refused_by_name(tmp_path, capsys, between):
    lines = [[value.replace(".", ",") for value in row] for row in rows(path())]
    file = write(tmp_path / "a.txt", lines, between)
    assert "decimal commas" in refused(capsys, "trajectory", "ate", file, file)


def lost(poses: np.ndarray) -> np.ndarray:
    poses = poses.copy()
    poses[10:15] = np.eye(4)
    return poses


def mounted(poses: np.ndarray) -> np.ndarray:
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_rotvec([0.3, -0.9, 0.4]).as_matrix()
    mount[:3, 3] = 0.05
    return poses @ mount


def other_order(poses: np.ndarray) -> np.ndarray:
    poses = poses.copy()
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    poses[:, :3, :3] = Rotation.from_quat(turns).as_matrix()
    return poses


def jumped(poses: np.ndarray) -> np.ndarray:
    """From the middle on, two places earlier."""
    half = len(poses) // 2
    return np.concatenate([poses[:half], np.roll(poses, 2, axis=0)[half:]])


def inverted_turns(poses: np.ndarray) -> np.ndarray:
    poses = poses.copy()
    poses[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    return poses


@pytest.mark.parametrize(
    ("which", "swapped", "frame"),
    [
        ("the reference's", "a", moved),
        ("both files'", "ab", moved),
        ("one file's", "a", lambda poses: poses),
    ],
)
def test_the_other_order_of_quaternions_is_told_of_either_file(tmp_path, which, swapped, frame):
    walk = disturbed(path(), degrees=20)
    for name, poses in (("a", walk), ("b", frame(disturbed(walk, degrees=1)))):
        write_tum(tmp_path / name, cameras(other_order(poses) if name in swapped else poses))
    notes = measured(tmp_path, "rpe", tmp_path / "a", tmp_path / "b")["notes"]["conventions"]
    assert [which in note and "other order" in note for note in notes] == [True]


@pytest.mark.parametrize(
    ("change", "align", "said"),
    [
        (invert_rigid, "sim3", "camera from world"),
        (lambda poses: poses @ np.diag([1, -1, -1, 1]), "sim3", "turned by 180 degrees"),
        (mounted, "se3", "another sensor"),
        (lambda poses: moved(poses, scale=1000), "se3", "times 0.001"),
        (other_order, "none", "other order"),
        (inverted_turns, "se3", "rotations seem to map the other way"),
        (lambda poses: np.roll(poses, -5, axis=0), "se3", "belong 5 places later"),
        (jumped, "se3", "places before it and -2 after"),
        (lost, "se3", "5 poses of the estimate are exactly one"),
        (lambda poses: moved(poses, scale=1000), "sim3", ""),
        (lambda poses: disturbed(poses, metres=0.3, degrees=10), "se3", ""),
    ],
)
def test_conventions_that_would_mend_the_errors_are_named(tmp_path, change, align, said):
    walk = disturbed(path(), degrees=20)
    write_tum(tmp_path / "a.txt", cameras(walk))
    write_tum(tmp_path / "b.txt", cameras(change(walk)))
    arguments = (tmp_path / "a.txt", tmp_path / "b.txt", "--align", align)
    for metric in ("ate", "rpe"):
        notes = measured(tmp_path, metric, *arguments)["notes"].get("conventions", [])
        assert len(notes) == bool(said)
        assert said in "".join(notes)
