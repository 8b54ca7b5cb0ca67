"""``gvtools refine``, and fits that begin with splats or points from a file."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import refused
from run_files import reconstructed, results
from scipy.spatial.transform import Rotation
from tiny_scan import write_colmap_scan, write_scan

from gvtools.appearance import fit_options
from gvtools.appearance.camera_corrections import CameraCorrections
from gvtools.appearance.fit import Fit
from gvtools.appearance.fit_options import FitOptions
from gvtools.cameras import rigid_poses
from gvtools.errors import DegenerateError
from gvtools.files import write_json
from gvtools.runs.poses import RunPoses
from gvtools.runs.run import load_run
from gvtools.scans.registration import Placement
from gvtools.scenes.project import open_project
from gvtools.settings import with_texts
from gvtools.splats import LOG_SCALE, LOGIT, QUATERNION, Splats, place_gaussians
from pipelines.cli import main
from pipelines.console import Console
from pipelines.export.formats import ExportOptions
from pipelines.export.splats import write_file
from pipelines.reconstruction import fitting
from pipelines.reconstruction import run as module
from pipelines.reconstruction.fit_start import _by_cameras, first_gaussians, given_start
from pipelines.reconstruction.fitting import Fitted, fit_appearance, fit_views
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.run import refine
from pipelines.reconstruction.settings import RunSettings
from pipelines.reconstruction.voxel import grid_frame

SETTINGS = ("context=first:8", "targets=range:8-8", "views_per_round=1", "completer=inpaint")
QUIET = Console(quiet=True)
APPEARANCE = "round_000/appearance.npz"


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("scan"), views=9)


@pytest.fixture(scope="module")
def whole(scan, tmp_path_factory):
    return run(scan, tmp_path_factory.mktemp("runs") / "whole", "refine.steps=12")


@pytest.fixture
def copy(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "run"))


def refining_poses(copy: Path) -> dict:
    """Let the fit refine poses, too; the run's record."""
    record = json.loads((copy / "run.json").read_text())
    record["settings"]["refine"]["poses"] = True
    # As of a version that did not have them.
    record["settings"].pop("lens")
    write_json(copy / "run.json", record)
    return record


def run(scan: Path, out: Path, *settings: str, resume: bool = False) -> Path:
    return reconstructed(scan, out, *SETTINGS, *settings, resume=resume)


def test_the_fit_goes_on_where_it_ended(copy):
    before = Fitted.load(copy / APPEARANCE)
    refine(copy, steps=1, console=QUIET)
    after = Fitted.load(copy / APPEARANCE)
    change = np.abs(after.appearance.gaussians.values - before.appearance.gaussians.values)
    assert change.max() > 0
    # The step lengths of the last part of a fit: below 0.025 px at 0.02 scene units, then RATES.
    assert change[:, :3].max() < 0.025 * 0.04
    assert change[:, 3:].max() < 0.06
    was, now = (one.appearance.exposures for one in (before, after))
    assert was is not None and now is not None
    assert np.abs(was.log_gains).max() > 0
    assert np.abs(now.log_gains - was.log_gains).max() < 0.009
    assert after.appearance.blend == before.appearance.blend
    assert json.loads((copy / "run.json").read_text())["refined"] == [{"steps": 1}]


def test_refined_poses_go_on_from_the_saved_ones(copy):
    saved = Fitted.load(copy / APPEARANCE)
    scene, record = load_run(copy).scenes[0], refining_poses(copy)
    shifted = scene.subset(record["context"]).cameras.cam_from_world.copy()
    shifted[1, :3, 3] += [0.004, 0, 0]
    target = scene.subset(record["targets"]).cameras.cam_from_world
    Fitted(saved.appearance, RunPoses(shifted, target)).save(copy / APPEARANCE)
    refine(copy, steps=2, console=QUIET)
    after = Fitted.load(copy / APPEARANCE)
    # Two steps neither find the way back nor predict neighbours better: the saved ones are kept.
    assert after.poses is not None
    np.testing.assert_array_equal(after.poses.context, shifted)
    np.testing.assert_array_equal(after.poses.targets, target)


def test_photographs_are_shown_better_afterwards_by_a_moved_project(scan, copy, tmp_path, capsys):
    def error() -> float:
        appearance = Fitted.load(copy / APPEARANCE).appearance
        scene = load_run(copy).scenes[0]
        views = [scene[name] for name in load_run(copy).context]
        off = [appearance.picture(v.camera).rgb - v.load().rgb / 255.0 for v in views]
        return float(np.mean(np.square(off)))

    before = error()
    moved = Path(shutil.copytree(scan, tmp_path / "moved"))
    refine(copy, steps=30, project=moved, console=Console())
    assert "PSNR" in capsys.readouterr().out
    assert error() < 0.8 * before
    assert json.loads((copy / "run.json").read_text())["project"] == str(moved)


def test_a_stop_at_any_moment_leaves_the_run_as_it_was(copy, monkeypatch):
    before = results(copy)

    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    names = ("fit_appearance", "complete_run", "_figures", "rename")
    for place, name in zip((module, module, module, os), names, strict=True):
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(place, name, stop)
            refine(copy, steps=1, console=QUIET)
        assert results(copy) == before, name
        assert os.listdir(copy.parent) == ["run"], name


def test_a_run_without_a_fit_gets_one_and_is_resumed_with_it(scan, tmp_path):
    settings = ("refine.steps=0", "refine.poses=true")
    out = run(scan, tmp_path / "run", *settings)
    assert not (out / APPEARANCE).exists()
    refine(out, steps=2, console=QUIET)
    refined = results(out)
    assert APPEARANCE in refined
    run(scan, out, *settings, resume=True)
    assert results(out) == refined


def test_an_interrupted_run_is_finished_and_files_of_the_user_are_kept_and_named(copy, capsys):
    shutil.rmtree(copy / "round_001")
    (copy / "metrics.json").unlink()
    (copy / "evaluation").mkdir()
    write_json(copy / "evaluation" / "evaluation.json", {})
    assert main(["refine", str(copy), "--steps", "2"]) == 0
    assert load_run(copy).complete
    assert (copy / "report.html").exists()
    assert "evaluation in" in capsys.readouterr().err
    assert (copy / "evaluation" / "evaluation.json").exists()


def test_what_cannot_be_refined_is_one_line_with_status_2(scan, copy, tmp_path, capsys):
    before = results(copy)
    assert "run.json" in refused(capsys, "refine", tmp_path)
    assert "run.json" in refused(capsys, "refine", tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    assert "at least 1" in refused(capsys, "refine", copy, "--steps", 0)
    assert "more than 0" in refused(capsys, "refine", copy, "--seconds", "nan")
    assert "not allowed with" in refused(capsys, "refine", copy, "--steps", 1, "--seconds", 1)
    assert "gone" in refused(capsys, "refine", copy, "--project", tmp_path / "moved")
    moved = Path(shutil.copytree(scan, tmp_path / "moved"))
    (moved / "frame-000001.color.png").touch()
    line = refused(capsys, "refine", copy, "--project", moved)
    assert "fingerprint" in line
    assert "project," not in line
    assert results(copy) == before


def test_a_converged_fit_is_joined_by_another_if_there_are_steps(copy, monkeypatch, capsys):
    monkeypatch.setattr(fit_options, "CONVERGED_PER_VIEW", 1)
    monkeypatch.setattr(fit_options, "CONVERGED_LEAST_RECORDED", 12)
    before = results(copy)
    line = refused(capsys, "refine", copy, "--steps", 5)
    assert "5 steps" in line and "expected 6" in line
    assert results(copy) == before
    earlier = Fitted.load(copy / APPEARANCE).appearance
    refine(copy, steps=6, console=QUIET)
    after = Fitted.load(copy / APPEARANCE).appearance
    assert len(after.fits) == 2
    np.testing.assert_array_equal(after.gaussians.values, earlier.gaussians.values)
    assert after.others[0].values.tobytes() != earlier.gaussians.values.tobytes()
    monkeypatch.setattr(fitting, "MOST_FITS", 2)
    assert "2 fits" in refused(capsys, "refine", copy, "--steps", 6)


FITTED = ("context=first:6", "targets=range:6-7", "refine.poses=false", "refine.steps=2",
            "fusion.max_psnr_drop_db=none")  # fmt: skip


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("start") / "scan", views=8)


@pytest.fixture(scope="module")
def plan(walls):
    return planned(walls)


@pytest.fixture(scope="module")
def rows(plan):
    """Opaque Gaussians on the surfaces of the scan, in its world, with harmonics."""
    frame = grid_frame(plan.scene, plan.context)
    values = first_gaussians(plan, fit_views(plan, frame, QUIET, sweep=None), frame).values.copy()
    values[:, LOGIT] = np.linspace(1, 4, len(values))
    values[:, LOGIT + 4 :] = np.random.default_rng(0).normal(0, 0.1, values[:, LOGIT + 4 :].shape)
    world, origin = place_gaussians(values, np.vstack([
        np.column_stack([frame.axes, frame.origin]), [0, 0, 0, 1],
    ]))  # fmt: skip
    world = world.copy()
    world[:, :LOG_SCALE] += origin
    return world


def planned(walls, *settings):
    return make_plan(open_project(walls), with_texts(RunSettings(), (*FITTED, *settings)))


def saved(rows, path, move=None):
    """The Gaussians in a file, moved by a similarity."""
    values, origin = place_gaussians(rows, np.eye(4) if move is None else move)
    values = values.copy()
    values[:, :LOG_SCALE] += origin.astype(np.float32)
    none = np.zeros(len(rows), np.int32)
    splats = Splats(values, np.zeros(3), None, 0, rounds=none, generated=none > 0)
    write_file(splats, path, ExportOptions())
    return path


def started(walls, file, *settings):
    plan = planned(walls, f"refine.init={file}", *settings)
    return given_start(plan, grid_frame(plan.scene, plan.context), QUIET)


def test_splats_lie_where_the_project_is(walls, rows, tmp_path):
    """From their own frame, and from one that is turned, shifted and 2.5 times as large."""
    back = tmp_path / "placement.txt"
    move = rigid_poses(2.5 * Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix(), (7, -3, 11))
    np.savetxt(back, np.linalg.inv(move))
    same = started(walls, saved(rows, tmp_path / "same.ply"))
    file = saved(rows, tmp_path / "moved.ply", move)
    moved = started(walls, file, f"scan.placement={back}")
    assert same.fitted and moved.fitted
    a, b = same.gaussians.values, moved.gaussians.values
    extent = np.ptp(a[:, :LOG_SCALE], axis=0).max()
    assert np.abs(a[:, :LOG_SCALE] - b[:, :LOG_SCALE]).max() < 1e-4 * extent
    assert np.abs(a[:, LOG_SCALE:QUATERNION] - b[:, LOG_SCALE:QUATERNION]).max() < 1e-4
    cameras = planned(walls).scene.cameras
    poses = move @ cameras.world_from_cam
    told = [{"img_name": name.split(".")[0], "position": pose[:3, 3].tolist(),
             "rotation": (pose[:3, :3] / 2.5).tolist()}
            for name, pose in zip(cameras.names, poses, strict=True)]  # fmt: skip
    inside = tmp_path / "point_cloud" / "iteration_30000"
    inside.mkdir(parents=True)
    (tmp_path / "cameras.json").write_text(json.dumps(told))
    file = file.rename(inside / "point_cloud.ply")
    by_cameras = started(walls, file).gaussians.values
    np.testing.assert_allclose(by_cameras, b, atol=1e-4)
    (tmp_path / "cameras.json").write_text(json.dumps([*told, told[0]]))  # two of one name
    assert _by_cameras(file, planned(walls)) is None
    np.testing.assert_allclose(a[:, LOGIT:], b[:, LOGIT:], atol=1e-4)
    frame = same.gaussians.frame
    world = frame.to_world(a[:, :LOG_SCALE])
    np.testing.assert_allclose(world, rows[:, :LOG_SCALE], atol=1e-4 * extent)


def test_photographs_decide_where_few_points_support_a_placement(
    walls, rows, tmp_path, monkeypatch
):
    move = np.eye(4)
    move[:3, :3] = 2.5 * Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()
    wide = np.concatenate([rows, np.full((len(rows), 21), 0.1, np.float32)], axis=1)
    file, told = saved(wide, tmp_path / "moved.ply", move), list[str]()
    monkeypatch.setattr(QUIET, "line", told.append)
    for matrix, fitness in ((np.linalg.inv(move), 0.4), (np.eye(4), 0.6), (np.eye(4), 0.4)):
        placement = Placement(np.asarray(matrix, np.float64), "estimated", fitness, 0.3, 0.01, 0.02)
        monkeypatch.setattr(
            "pipelines.reconstruction.fit_start.register", lambda *a, _it=placement, **k: _it
        )
        if matrix[0, 0] == 1 and fitness < 0.5:
            with pytest.raises(DegenerateError, match=r"nothing like the photographs.*--cloud-pl"):
                started(walls, file)
        else:
            assert started(walls, file).fitted
    assert told[1].endswith("moved.ply, without harmonics above degree 2")
    turned = started(walls, saved(rows, tmp_path / "turned.ply", np.diag([1.0, -1, -1, 1])))
    assert "turned half around x, since" in told[-2]
    same = started(walls, saved(rows, tmp_path / "same.ply"))
    alike = np.isclose(turned.gaussians.values, same.gaussians.values, atol=1e-3)
    assert alike[:, :QUATERNION].all() and alike[:, LOGIT:].all()  # quaternions may be negative


def test_of_too_many_those_of_most_light_stay(walls, rows, tmp_path):
    file = saved(rows, tmp_path / "many.ply")
    some = started(walls, file, "refine.most_gaussians=50").gaussians.values
    assert len(some) == 50
    light = 2 * rows[:, LOG_SCALE] - np.log1p(np.exp(-rows[:, LOGIT]))
    mine = 2 * some[:, LOG_SCALE] - np.log1p(np.exp(-some[:, LOGIT]))
    assert mine.min() >= np.sort(light)[-51] - 1e-4


def test_a_run_begins_with_them_and_resumes_with_the_same_file_alone(walls, rows, tmp_path, capsys):
    file, out = saved(rows, tmp_path / "begin.ply"), tmp_path / "run"
    reconstructed(walls, out, *FITTED, f"refine.init={file}")
    saved(rows[:100], file)
    words = ("reconstruct", walls, "--out", out, "--resume", "--init", file)
    settings = [word for text in FITTED for word in ("--set", text)]
    assert "fingerprint" in refused(capsys, *words, *settings)


@pytest.mark.parametrize("after", [29.0, 31.0])
def test_given_splats_are_kept_where_the_fit_ends_below_them(
    walls, rows, tmp_path, monkeypatch, capsys, after
):
    told = iter([30.0, after])
    monkeypatch.setattr(Fit, "shown_psnr", lambda fit: next(told))
    plan = planned(walls, f"refine.init={saved(rows, tmp_path / 'given.ply')}")
    given_back = []
    monkeypatch.setattr(CameraCorrections, "give_back", lambda self: given_back.append(self))
    fitted = fit_appearance(plan, Console())
    assert bool(given_back) == (after < 30)
    start = started(walls, tmp_path / "given.ply").gaussians
    same = np.array_equal(fitted.appearance.gaussians.values, start.values)
    assert same == (after < 30) == ("the given Gaussians are kept" in capsys.readouterr().out)
    assert next(told, None) is None


def test_points_of_a_cloud_become_gaussians(tmp_path):
    """Photographs that know fewer points than a placement needs: taken as they lie, and said."""
    bare = write_colmap_scan(tmp_path / "bare", views=8, points=10)
    positions = open_project(bare).points.positions.repeat(20, axis=0)
    positions = positions + np.random.default_rng(0).normal(0, 0.02, positions.shape)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(positions)}", "property float x",
             "property float y", "property float z", "end_header"]  # fmt: skip
    cloud = tmp_path / "cloud.ply"
    cloud.write_text("\n".join([*lines, *(" ".join(map(str, p)) for p in positions)]) + "\n")
    found = started(bare, cloud, "refine.steps=5")
    assert not found.fitted and len(found.gaussians) > len(positions) / 2


@pytest.mark.parametrize(
    ("name", "content", "words", "line"),
    [
        ("absent.ply", None, (), "absent.ply"),
        ("cut.spz", b"\x1f\x8b\x08\x00", (), "cut.spz"),
        ("photo.jpg", b"\xff\xd8\xff", (), "photo.jpg"),
        ("photo.ply", b"ply\n", ("--refine", "0"), "--init without a fit"),
    ],
)
def test_what_no_fit_can_begin_with_is_refused(walls, tmp_path, capsys, name, content, words, line):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    out = tmp_path / "run"
    assert line in refused(
        capsys, "reconstruct", walls, "--out", out, "--init", tmp_path / name, *words
    )
    assert not out.exists()


def test_photographs_begin_with_the_exposure_at_which_the_start_shows_them_best(plan):
    """Pictures of the start, every other one a half brighter."""
    frame = grid_frame(plan.scene, plan.context)
    views = fit_views(plan, frame, QUIET, sweep=None)
    start = first_gaussians(plan, views, frame)
    start.values[:, LOGIT] = 4
    options, gains = FitOptions(steps=1), np.where(np.arange(len(views)) % 2, 0.9, 0.6)
    drawn = Fit(start, views, options=options, begin=0.5)
    pictures = [
        drawn._picture(row, view.cam_from_local).rgb * gain * 255
        for row, (view, gain) in enumerate(zip(views, gains, strict=True))
    ]
    views = [replace(view, rgb=np.rint(rgb).astype(np.uint8))
             for view, rgb in zip(views, pictures, strict=True)]  # fmt: skip
    fit = Fit(start, views, options=options, begin=0.5)
    fit.compare_exposures()
    expected = np.log(gains) - np.log(gains).mean()
    np.testing.assert_allclose(fit.cameras.log_gains, expected[:, None].repeat(3, 1), atol=0.01)
