"""Fits that begin with splats or points from a file."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import refused
from run_files import reconstructed
from scipy.spatial.transform import Rotation
from tiny_scan import write_colmap_scan, write_scan

from gvtools.appearance.fit import Fit
from gvtools.appearance.fit_options import FitOptions
from gvtools.errors import DegenerateError
from gvtools.scans.registration import Placement
from gvtools.scenes.project import open_project
from gvtools.settings import with_texts
from gvtools.splats import LOG_SCALE, LOGIT, QUATERNION, Splats, place_gaussians
from pipelines.console import Console
from pipelines.export.formats import ExportOptions
from pipelines.export.splats import write_file
from pipelines.reconstruction.fit_start import given_start
from pipelines.reconstruction.fitting import first_gaussians, fit_appearance, fit_views
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.settings import RunSettings
from pipelines.reconstruction.voxel import grid_frame

pytestmark = pytest.mark.usefixtures("unpainted")

QUIET = Console(quiet=True)
SETTINGS = ("context=first:6", "targets=range:6-7", "refine.poses=false", "refine.steps=2",
            "fusion.max_psnr_drop_db=none")  # fmt: skip


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("start") / "scan", views=8)


@pytest.fixture(scope="module")
def plan(scan):
    return planned(scan)


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


def planned(scan, *settings):
    return make_plan(open_project(scan), with_texts(RunSettings(), (*SETTINGS, *settings)))


def saved(rows, path, move=None):
    """The Gaussians in a file, moved by a similarity."""
    values, origin = place_gaussians(rows, np.eye(4) if move is None else move)
    values = values.copy()
    values[:, :LOG_SCALE] += origin.astype(np.float32)
    none = np.zeros(len(rows), np.int32)
    splats = Splats(values, np.zeros(3), None, 0, rounds=none, generated=none > 0)
    write_file(splats, path, ExportOptions())
    return path


def started(scan, file, *settings):
    plan = planned(scan, f"refine.init={file}", *settings)
    return given_start(plan, grid_frame(plan.scene, plan.context), QUIET)


def test_splats_lie_where_the_project_is(scan, rows, tmp_path):
    """From their own frame, and from one that is turned, shifted and 2.5 times as large."""
    back = tmp_path / "placement.txt"
    move = np.eye(4)
    move[:3, :3] = 2.5 * Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()
    move[:3, 3] = 7, -3, 11
    np.savetxt(back, np.linalg.inv(move))
    same = started(scan, saved(rows, tmp_path / "same.ply"))
    file = saved(rows, tmp_path / "moved.ply", move)
    moved = started(scan, file, f"scan.placement={back}")
    assert same.fitted and moved.fitted
    a, b = same.gaussians.values, moved.gaussians.values
    extent = np.ptp(a[:, :LOG_SCALE], axis=0).max()
    assert np.abs(a[:, :LOG_SCALE] - b[:, :LOG_SCALE]).max() < 1e-4 * extent
    assert np.abs(a[:, LOG_SCALE:QUATERNION] - b[:, LOG_SCALE:QUATERNION]).max() < 1e-4
    cameras = planned(scan).scene.cameras
    poses = move @ cameras.world_from_cam
    told = [{"img_name": name.split(".")[0], "position": pose[:3, 3].tolist(),
             "rotation": (pose[:3, :3] / 2.5).tolist()}
            for name, pose in zip(cameras.names, poses, strict=True)]  # fmt: skip
    inside = tmp_path / "point_cloud" / "iteration_30000"
    inside.mkdir(parents=True)
    (tmp_path / "cameras.json").write_text(json.dumps(told))
    by_cameras = started(scan, file.rename(inside / "point_cloud.ply")).gaussians.values
    np.testing.assert_allclose(by_cameras, b, atol=1e-4)
    np.testing.assert_allclose(a[:, LOGIT:], b[:, LOGIT:], atol=1e-4)
    frame = same.gaussians.frame
    world = frame.to_world(a[:, :LOG_SCALE])
    np.testing.assert_allclose(world, rows[:, :LOG_SCALE], atol=1e-4 * extent)


def test_photographs_decide_where_few_points_support_a_placement(scan, rows, tmp_path, monkeypatch):
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
                started(scan, file)
        else:
            assert started(scan, file).fitted
    assert told[1].endswith("moved.ply, without harmonics above degree 2")
    turned = started(scan, saved(rows, tmp_path / "turned.ply", np.diag([1.0, -1, -1, 1])))
    assert "turned half around x, since" in told[-2]
    same = started(scan, saved(rows, tmp_path / "same.ply"))
    alike = np.isclose(turned.gaussians.values, same.gaussians.values, atol=1e-3)
    assert alike[:, :QUATERNION].all() and alike[:, LOGIT:].all()  # quaternions may be negative


def test_of_too_many_those_of_most_light_stay(scan, rows, tmp_path):
    file = saved(rows, tmp_path / "many.ply")
    some = started(scan, file, "refine.most_gaussians=50").gaussians.values
    assert len(some) == 50
    light = 2 * rows[:, LOG_SCALE] - np.log1p(np.exp(-rows[:, LOGIT]))
    mine = 2 * some[:, LOG_SCALE] - np.log1p(np.exp(-some[:, LOGIT]))
    assert mine.min() >= np.sort(light)[-51] - 1e-4


def test_a_run_begins_with_them_and_resumes_with_the_same_file_alone(scan, rows, tmp_path, capsys):
    file, out = saved(rows, tmp_path / "begin.ply"), tmp_path / "run"
    reconstructed(scan, out, *SETTINGS, f"refine.init={file}")
    saved(rows[:100], file)
    words = ("reconstruct", scan, "--out", out, "--resume", "--init", file)
    settings = [word for text in SETTINGS for word in ("--set", text)]
    assert "fingerprint" in refused(capsys, *words, *settings)


@pytest.mark.parametrize("after", [29.0, 31.0])
def test_given_splats_are_kept_where_the_fit_ends_below_them(
    scan, rows, tmp_path, monkeypatch, capsys, after
):
    told = iter([30.0, after])
    monkeypatch.setattr(Fit, "shown_psnr", lambda fit: next(told))
    plan = planned(scan, f"refine.init={saved(rows, tmp_path / 'given.ply')}")
    fitted = fit_appearance(plan, Console())
    start = started(scan, tmp_path / "given.ply").gaussians
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
def test_what_no_fit_can_begin_with_is_refused(scan, tmp_path, capsys, name, content, words, line):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    out = tmp_path / "run"
    assert line in refused(
        capsys, "reconstruct", scan, "--out", out, "--init", tmp_path / name, *words
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
