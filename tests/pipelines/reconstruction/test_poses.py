from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run_command
from run_files import Killed, kill_after_round_0, reconstructed, results
from tiny_scan import world_from_cam, write_scan

from gvtools.cameras import rigid_poses
from gvtools.errors import MemoryFileError
from gvtools.poses.motions import move_pose
from gvtools.procedural.noisy_room import jitter_poses
from gvtools.runs.poses import RunPoses
from gvtools.runs.run import at_run_poses, load_memory, load_run
from gvtools.scenes.project import open_project
from pipelines.reconstruction import prepare

SETTINGS = ("context=first:8", "targets=range:8-9", "views_per_round=1", "refine.steps=0",
            "refine.poses=true")  # fmt: skip
POSES = "round_000/poses.npz"


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """Ten views whose poses err by two centimetres and a degree."""
    folder = write_scan(tmp_path_factory.mktemp("poses") / "scan", views=10)
    true = np.stack([world_from_cam(i) for i in range(10)])
    rng = np.random.default_rng(0)
    wrong = np.linalg.inv(jitter_poses(jitter_poses(np.linalg.inv(true), rng), rng))
    for i, pose in enumerate(wrong):
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    return folder


def run(scan: Path, out: Path, *settings: str, resume: bool = False) -> Path:
    return reconstructed(scan, out, *SETTINGS, *settings, resume=resume)


@pytest.fixture(scope="module")
def whole(scan, tmp_path_factory):
    return run(scan, tmp_path_factory.mktemp("runs") / "whole")


def relative_errors(context: np.ndarray) -> float:
    """Mean angle between true and found turns from each view to the next [rad]."""
    true = np.linalg.inv(np.stack([world_from_cam(i) for i in range(8)]))
    turns = [(poses[1:] @ np.linalg.inv(poses[:-1]))[:, :3, :3] for poses in (true, context)]
    cosine = (np.einsum("vij,vij->v", *turns) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1, 1)).mean())


def test_poses_are_refined_and_kept_beside_round_0(scan, whole):
    kept = RunPoses.load(whole / POSES)
    assert kept is not None
    scene = open_project(scan)
    given = scene.subset(scene.names[:8]).cameras.cam_from_world
    assert relative_errors(kept.context) < 0.6 * relative_errors(given)
    assert kept.targets.shape == (2, 4, 4)


def test_a_resumed_run_takes_the_poses_that_it_began_with(scan, whole, tmp_path, monkeypatch):
    kill_after_round_0(monkeypatch)
    with pytest.raises(Killed):
        run(scan, tmp_path / "run")
    monkeypatch.undo()

    def refined_again(*args, **kwargs):
        raise AssertionError("refined again")

    monkeypatch.setattr(prepare, "refined_poses_of", refined_again)
    run(scan, tmp_path / "run", resume=True)
    assert results(tmp_path / "run") == results(whole)
    (tmp_path / "run" / POSES).write_bytes((whole / POSES).read_bytes()[:-300])
    with pytest.raises(MemoryFileError, match="expected refined poses"):
        run(scan, tmp_path / "run", resume=True)


def test_targets_move_with_the_context_and_are_measured_where_they_were_moved_to(tmp_path):
    """Half of the path errs by one motion, half by the opposite one."""
    folder = write_scan(tmp_path / "scan", views=16)
    for i in range(16):
        sign = 1 if i < 8 else -1
        motion = sign * np.array([0.02, 0.01, 0, 0, 0.01, 0])
        pose = np.linalg.inv(move_pose(np.linalg.inv(world_from_cam(i)), motion))
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    out = run(folder, tmp_path / "run", "context=every:2", "targets=every:2+1", "views_per_round=8")
    kept = RunPoses.load(out / POSES)
    assert kept is not None
    loaded = load_run(out)
    given = open_project(folder).subset(loaded.record["targets"]).cameras.cam_from_world
    assert np.abs(kept.targets - given).max() > 1e-3
    for number, (_, files, truth) in enumerate(loaded.targets()):
        assert truth is not None
        np.testing.assert_array_equal(truth.camera.cam_from_world[0], kept.targets[number])
        np.testing.assert_allclose(files.camera.cam_from_world[0], kept.targets[number])
    context = loaded.scenes[0].subset(loaded.context).cameras.cam_from_world
    np.testing.assert_array_equal(context, kept.context)


@pytest.mark.parametrize("depth", [0.0, 2.0])
def test_the_project_of_a_run_is_seen_at_its_refined_poses(scan, whole, tmp_path, capsys, depth):
    copy = tmp_path / "run"
    shutil.copytree(whole, copy)
    scene = open_project(scan)
    extra = replace(scene.views[3], name="z.png")
    scene = replace(scene, views=(*scene.views, extra))
    given = scene.cameras.cam_from_world
    shift = rigid_poses(np.eye(3), (0.01, 0.02, -0.03))
    RunPoses(shift @ given[:8], given[8:10], depth=depth).save(copy / POSES)
    moved, said = at_run_poses(scene, copy)
    np.testing.assert_allclose(moved.cameras.cam_from_world[:8], shift @ given[:8], atol=1e-12)
    expected = shift @ given[10] if depth else given[10]
    np.testing.assert_allclose(moved.cameras.cam_from_world[10], expected, atol=1e-9)
    assert ("moved like" if depth else "1 views that it did not have stay as given") in said
    assert at_run_poses(moved, copy / "memory.npz")[1] == said
    other = replace(scene, views=scene.views[5:])
    assert at_run_poses(other, copy) == (
        other,
        f"poses: as given; the run's own are refined, but not for {scene.root}",
    )
    out = tmp_path / "out.json"
    run_command("render", copy, "--cameras", scan, "--against-images", "--json", out, quiet=True)
    assert "as refined by the run" in json.loads(out.read_text())["poses"]
    film = tmp_path / "film.gif"
    run_command("film", copy, "--path", f"{scan}@first:2", "--out", film)
    assert "as refined by the run" in capsys.readouterr().out
    walk = tmp_path / "walk.txt"
    walk.write_text("".join(f"{i} {' '.join(map(str, np.eye(4)[:3].ravel()))}\n" for i in (0, 1)))
    run_command("film", copy, "--path", walk, "--out", film)
    run_command("render", copy, "--cameras", walk, "--out", tmp_path / "out")
    assert capsys.readouterr().out.count(f"poses: as given in {walk}; the run refined") == 2
    # Apart from its run, a memory has poses that are not the project's.
    alone, memory = tmp_path / "memory.npz", load_memory(whole)
    assert at_run_poses(scene, alone, memory)[1].startswith("poses: as given, not those")
    assert at_run_poses(at_run_poses(scene, whole)[0], alone, memory)[1] == ""
