from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numba import get_num_threads
from PIL import Image
from run_files import Killed, kill_after_round_0, reconstructed, report_of, results, untimed
from tiny_scan import write_colmap_scan, write_scan

from benchmarks.made_scenes import PLACES, write_place
from gvtools.appearance.appearance import Appearance, Blend, Picture
from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.fit import Fit
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.population import from_points
from gvtools.appearance.splat.project_kernels import VALUES
from gvtools.depth.foundation import FoundationDepth
from gvtools.depth.source import DepthMap
from gvtools.errors import DegenerateError, MemoryFileError
from gvtools.memory.projection import project
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.poses.refinement import FitView
from gvtools.runs.poses import RunPoses
from gvtools.scenes.project import open_project
from gvtools.settings import with_texts
from pipelines.console import Console
from pipelines.reconstruction import fit_start, fitting
from pipelines.reconstruction import run as runs
from pipelines.reconstruction.fit_start import first_gaussians
from pipelines.reconstruction.fitting import (
    MOST_SHARE,
    MOST_TOLERANCE,
    Fitted,
    FitValidation,
    Sweep,
    fit_appearance,
    fit_views,
    validate_fit,
)
from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.run import _empty_memory
from pipelines.reconstruction.settings import RunSettings

SETTINGS = ("context=first:8", "targets=range:8-9", "views_per_round=1", "depth=auto",
            "fusion.max_psnr_drop_db=none", "refine.most_gaussians=2000")  # fmt: skip
# Fewer show so little that the blend takes all of the memory's detail.
STEPS = "refine.steps=40"
ONE = Appearance(Gaussians(np.zeros((1, VALUES), np.float32)), 0.1)
QUIET = Console(quiet=True)
FITTED, POSES = "round_000/appearance.npz", "round_000/poses.npz"


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("fitting") / "scan", views=10)


@pytest.fixture(scope="module")
def whole(scan, tmp_path_factory):
    """A run with Gaussians."""
    return run(scan, tmp_path_factory.mktemp("runs") / "whole")


@pytest.fixture(scope="module")
def unfitted(scan, tmp_path_factory) -> list[Path]:
    """Runs without steps, or without time, to fit anything."""
    root = tmp_path_factory.mktemp("unfitted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "fit_appearance", not_to_be_called)
        patch.setattr(Appearance, "picture", not_to_be_called)
        return [run(scan, root / off, f"refine.{off}=0") for off in ("steps", "seconds")]


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> Path:
    """Photographs with sparse points, and without depth."""
    return write_colmap_scan(tmp_path_factory.mktemp("bare") / "scan", views=10)


def run(scan: Path, out: Path, *settings: str, resume: bool = False) -> Path:
    return reconstructed(scan, out, *SETTINGS, STEPS, *settings, resume=resume)


def planned(scan: Path, *settings: str) -> Plan:
    config = with_texts(RunSettings(), ("refine.poses=false", *SETTINGS, STEPS, *settings))
    return make_plan(open_project(scan), config)


def memory_of_round_0(out: Path) -> SpatialMemory:
    memory = SpatialMemory.load(out / "memory.npz")
    for number in [number for number in reversed(memory.rounds) if number]:
        memory.forget(round=number)
    return memory


def guidance_of(out: Path, number: int) -> np.ndarray:
    (file,) = (out / f"round_{number:03d}").glob("guidance_*.png")
    return np.asarray(Image.open(file).convert("RGB"))


def not_to_be_called(*args, **kwargs):
    raise AssertionError("called")


def test_targets_show_the_gaussians_where_the_memory_observed(whole, scan):
    fitted, plan = Fitted.load(whole / FITTED), planned(scan)
    assert 100 < len(fitted.appearance.gaussians) <= 2000
    again = fit_appearance(plan, QUIET)
    assert again is not None
    values = again.appearance.gaussians.values
    np.testing.assert_array_equal(values, fitted.appearance.gaussians.values)
    memory = memory_of_round_0(whole)
    camera = fitted.apply(plan).targets.cameras[[0]]
    guidance = project(memory, camera, options=plan.config.splat)
    shown = fitted.appearance.recolor(guidance, fitted.appearance.picture(camera))
    off = np.abs(shown.rgb[0] * 255 - guidance_of(whole, 1))[guidance.valid[0]]
    assert off.max() <= 1
    assert np.abs(guidance.rgb[0] * 255 - guidance_of(whole, 1))[guidance.valid[0]].max() > 1


def test_resuming_after_round_0_gives_the_same_bytes_without_a_second_fit(
    whole, scan, tmp_path, monkeypatch
):
    kill_after_round_0(monkeypatch)
    with pytest.raises(Killed):
        run(scan, tmp_path / "run")
    monkeypatch.undo()
    assert (tmp_path / "run" / FITTED).exists()
    monkeypatch.setattr(runs, "fit_appearance", not_to_be_called)
    run(scan, tmp_path / "run", resume=True)
    assert results(tmp_path / "run") == results(whole)
    assert untimed(tmp_path / "run") == untimed(whole)


def test_a_run_that_nothing_can_be_fitted_to_goes_on_without_and_resumes(
    scan, unfitted, tmp_path, monkeypatch, capsys
):
    def nowhere(*args, **kwargs):
        raise DegenerateError("no surface is known")

    monkeypatch.setattr(fit_start, "from_depth", nowhere)
    out = run(scan, tmp_path / "run")
    assert "no Gaussians are fitted: no surface is known" in capsys.readouterr().err
    assert not (out / FITTED).exists()
    before = results(out)
    run(scan, out, resume=True)
    assert results(out) == before
    assert (unfitted[0] / "memory.npz").read_bytes() == (out / "memory.npz").read_bytes()


def test_without_steps_or_time_a_run_knows_nothing_of_gaussians(scan, unfitted):
    out = unfitted[1]
    assert results(out).keys() == results(unfitted[0]).keys()
    assert not (out / FITTED).exists()
    plan = planned(scan, f"refine.{out.name}=0")
    memory = memory_of_round_0(out)
    guidance = project(memory, plan.targets.cameras[[0]], options=plan.config.splat)
    shown = guidance_of(out, 1)[guidance.valid[0]]
    assert np.abs(guidance.rgb[0][guidance.valid[0]] * 255 - shown).max() <= 0.51


@pytest.mark.parametrize("points", [60, 0])
def test_photographs_alone_get_depth_by_the_gaussians(tmp_path, monkeypatch, points):
    """With sparse points, and without any: then a plane sweep tells where to begin."""
    # So short a fit is not as good as the memory.
    monkeypatch.setattr(fitting, "validate_fit", lambda *args: None)
    monkeypatch.setattr(fit_start, "SWEPT_SIDE", 64)
    scan = write_colmap_scan(tmp_path / "scan", views=6, points=points)
    settings = ("context=first:5", "targets=range:5-5")
    out = run(scan, tmp_path / "run", *settings)
    fitted = Fitted.load(out / FITTED)
    assert fitted.poses is None and not (out / POSES).exists()
    report = report_of(out)
    assert {entry["source"] for entry in report["depth"]} <= {"fitted", "memory"}
    assert report["depth"][0]["source"] == "fitted"
    assert report["points"] > 500
    shown = fitted.appearance.depth(planned(scan, *settings).scene["view_1.png"].camera)
    # The wall is 3 units away, the square 1.8.
    assert 1.5 < np.median(shown[shown > 0]) < 3.5


@pytest.mark.parametrize(
    ("steps", "enough", "told"), [(20, 22, True), (25, 22, False), (9, 10, True), (11, 10, False)]
)
def test_a_fit_too_short_for_its_photographs_is_told(
    bare, monkeypatch, capsys, steps, enough, told
):
    # Where nothing judges it.
    monkeypatch.setattr(fitting, "validate_fit", lambda *args: None)
    monkeypatch.setattr(fit_start, "SWEPT_SIDE", 64)
    monkeypatch.setattr(fitting, "ENOUGH", 10 if enough == 10 else 400)
    plan = planned(bare, f"refine.steps={steps}", "context=first:3")
    fit_appearance(plan, Console())
    assert (f"expected at least {enough}" in capsys.readouterr().err) == told


def test_a_fit_that_its_clock_ends_too_early_is_not_used(bare, monkeypatch, capsys):
    monkeypatch.setattr(fitting, "validate_fit", lambda *args: None)
    monkeypatch.setattr(fit_start, "SWEPT_SIDE", 64)
    plan = planned(bare, "refine.seconds=0.001", "context=first:3")
    assert fit_appearance(plan, Console()) is None
    assert "the fit is not used" in capsys.readouterr().err


def test_pixels_with_swept_depth_make_up_for_few_sparse_points(tmp_path, monkeypatch):
    begun = []

    def watched(positions, colors, **kwargs):
        begun.append(positions)
        return from_points(positions, colors, **kwargs)

    monkeypatch.setattr(fit_start, "from_points", watched)
    scan = write_colmap_scan(tmp_path / "scan", views=10, points=15)
    plan = planned(scan, "refine.most_gaussians=20000")
    frame = fitting.grid_frame(plan.scene, plan.context)
    views = fit_views(plan, frame, QUIET, sweep=Sweep.of(plan))
    first_gaussians(plan, views, frame)
    monkeypatch.setattr(fit_start, "FEW_POINTS", 150)
    first_gaussians(plan, views, frame)
    few, enough = begun
    assert len(enough) == 150
    assert len(few) > 2000
    np.testing.assert_array_equal(few[:150], enough)
    # One photograph with recorded depth adds its part, and the points stay.
    views[0] = replace(views[0], depth=views[0].estimate)
    first_gaussians(plan, views, frame)
    share = fit_start.STARTING_GAUSSIANS // len(views)
    assert 0.5 * share < len(begun[-1]) - 150 <= share + 1
    np.testing.assert_array_equal(begun[-1][-150:], enough)
    # A wall and a square before it, both parallel to the pictures.
    known = np.unique(enough[:, 2].round(6))
    assert len(known) == 2
    error = np.abs(few[150:, 2, None] - known).min(axis=1)
    assert np.median(error) < 0.05


@pytest.mark.parametrize(("seconds", "side"), [("none", 96), ("40", 96), ("15", 64), ("5", None)])
def test_a_sweep_is_as_large_as_there_is_time(bare, monkeypatch, seconds, side):
    monkeypatch.setattr(fit_start, "SWEPT_SIDE", 96)
    monkeypatch.setattr(fit_start, "SMALL_SIDE", 64)
    monkeypatch.setattr(fit_start, "get_num_threads", lambda: 2)
    monkeypatch.setattr(fit_start, "FEW_POINTS", 15)
    plan = planned(bare, f"refine.seconds={seconds}")
    sweep = Sweep.of(plan)
    if side is None:
        assert sweep is None
        # A start needs points.
        monkeypatch.setattr(fit_start, "FEW_POINTS", 10**6)
        sweep, side = Sweep.of(plan), 64
    assert sweep is not None
    view = sweep.scene["view_1.png"]
    assert int(view.camera.width[0]) == side
    depth = sweep.depth(view)
    assert depth is not None
    assert (depth > 0).mean() > 0.3


def test_refined_poses_move_context_and_targets(scan):
    plan = planned(scan)
    context = plan.scene.subset(plan.context).cameras.cam_from_world.copy()
    targets = plan.targets.cameras.cam_from_world.copy()
    context[:, 0, 3] += 0.01
    targets[:, 1, 3] -= 0.02
    moved = Fitted(ONE, RunPoses(context, targets)).apply(plan)
    np.testing.assert_array_equal(moved.scene.subset(plan.context).cameras.cam_from_world, context)
    np.testing.assert_array_equal(moved.targets.cameras.cam_from_world, targets)
    others = [name for name in plan.scene.names if name not in plan.context]
    np.testing.assert_array_equal(
        moved.scene.subset(others).cameras.cam_from_world,
        plan.scene.subset(others).cameras.cam_from_world,
    )
    kept = Fitted(ONE).apply(plan)
    assert kept.scene is plan.scene and kept.source is plan.source


def test_photographs_with_fitted_depth_enter_the_memory_smaller(bare, scan):
    plan = planned(bare)
    changed = Fitted(ONE, side=64).apply(plan)
    assert changed.evidence is not None and plan.config.voxel is not None
    camera = changed.evidence["view_0.png"].camera
    assert (int(camera.width[0]), int(camera.height[0])) == (64, 48)
    assert changed.config.voxel == pytest.approx(1.5 * plan.config.voxel)
    assert changed.scene is plan.scene
    assert changed.source.name == "fitted"
    # Recorded depth is not replaced, nor a source that the user named.
    named = planned(bare, "depth=plane-sweep")
    assert Fitted(ONE).apply(named).source is named.source
    assert Sweep.of(planned(scan)) is None


def test_a_fit_comes_back_from_its_file_as_it_was(tmp_path):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(5, VALUES)).astype(np.float32)
    gaussians = Gaussians(values, frame=LocalFrame.at([1e6, 2, 3]))
    poses = np.tile(np.eye(4), (2, 3, 1, 1))
    poses[..., :3, 3] = rng.normal(size=(2, 3, 3))
    fitted = Fitted(Appearance(gaussians, 0.125, Blend(0.35, 0.4), backdrop=True), RunPoses(*poses))
    for saved in (fitted, replace(fitted, poses=None)):
        saved.save(tmp_path / "fit.npz")
        back = Fitted.load(tmp_path / "fit.npz")
        np.testing.assert_array_equal(back.appearance.gaussians.values, gaussians.values)
        assert back.appearance.gaussians.frame.same_as(gaussians.frame)
        assert back.appearance.near == 0.125
        assert back.appearance.blend == Blend(0.35, 0.4) and back.appearance.backdrop
        assert (back.poses is None) == (saved.poses is None)
        if back.poses is not None:
            np.testing.assert_array_equal([back.poses.context, back.poses.targets], poses)
    gaussians.save(tmp_path / "fit.npz")
    with pytest.raises(MemoryFileError, match="no readable appearance"):
        Fitted.load(tmp_path / "fit.npz")


def test_the_blend_is_chosen_by_the_left_out_photographs(scan):
    plan = planned(scan, "context=first:4")
    memory = _empty_memory(plan, Path())
    for name in plan.context:
        view = plan.scene[name]
        frame = view.load()
        memory.observe(frame.rgb, frame.depth, view.camera, round=0)
    name = plan.context[1]
    truth = (plan.scene[name].load().rgb / np.float32(255)).astype(np.float32)
    alpha = np.ones(truth.shape[:2], np.float32)
    good, bad = Picture(truth, alpha), Picture(1 - truth, alpha)
    fitted = Fitted(ONE, predicted={name: good})
    assert fitted.with_best_blend(plan, memory).appearance.blend.share == 0
    fitted = Fitted(ONE, predicted={name: bad})
    assert fitted.with_best_blend(plan, memory).appearance.blend == Blend(1.0, 4.0)
    fitted = Fitted(replace(ONE, blend=Blend(0.3, 0.3)))
    assert fitted.with_best_blend(plan, memory) is fitted


def test_a_long_fit_takes_at_most_half_of_the_memory_s_detail_and_an_uneven_one_none(bare):
    plan = planned(bare)
    memory, name = _empty_memory(plan, Path()), plan.context[1]
    for each in plan.context:
        view = plan.scene[each]
        frame = view.load()
        distance = np.full(frame.rgb.shape[:2], 2, np.float32)
        memory.observe(frame.rgb, distance, view.camera, round=0)
    shown = project(memory, plan.scene[name].camera, options=plan.config.splat, without=name)
    truth = plan.scene[name].load().rgb / np.float32(255)
    smooth = truth + 0.3 * (truth - np.clip(shown.rgb[0], 0, 1))
    predicted = {name: Picture(smooth.astype(np.float32), np.ones(truth.shape[:2], np.float32))}
    even = replace(ONE, blend=Blend(share=0.0))
    long, short = (Fitted(even, predicted=predicted, steps=steps) for steps in (10**4, 50))
    blend = long.with_best_blend(plan, memory).appearance.blend
    assert 0 < blend.share <= MOST_SHARE and blend.tolerance <= MOST_TOLERANCE
    most = short.with_best_blend(plan, memory).appearance.blend
    assert most.tolerance > blend.tolerance or most.share > blend.share
    poses = np.repeat(np.eye(4)[None], 2, axis=0)
    uneven = replace(even, exposures=Exposures(poses, np.array([[0.1] * 3, [-0.1] * 3]), 1.0))
    kept = Fitted(uneven, predicted=predicted).with_best_blend(plan, memory)
    assert kept.appearance.blend.share == 0


@pytest.mark.parametrize(("seconds", "side"), [(0.05, 64), (1000, 96), (None, 96)])
def test_the_memory_takes_photographs_as_large_as_the_fit_has_time_for(
    bare, monkeypatch, seconds, side
):
    monkeypatch.setattr(fitting, "SWEPT_SIDE", 64)
    length = "refine.steps=9" if seconds is None else f"refine.seconds={seconds}"
    plan = planned(bare, length)
    fit: Any = SimpleNamespace(begin=0.0)
    monkeypatch.setattr(fitting, "validation_rows", lambda views: (1,))
    found, expected = fitting._memory_side(plan, fit, None)
    pixels = 8 * 96 * 72 * (side**2 - 64**2) / 96**2
    each = fitting.MEGAPIXEL_SECONDS / get_num_threads()
    assert found == side and expected == pytest.approx(1e-6 * pixels * each)
    monkeypatch.setattr(fitting, "validation_rows", lambda views: ())
    assert fitting._memory_side(plan, fit, None) == (64, 0.0)
    earlier = Fitted(ONE, side=80)
    assert fitting._memory_side(plan, fit, earlier) == (80, 0.0)


def test_a_photograph_does_not_validate_a_memory_that_has_seen_it(scan):
    plan = planned(scan)
    memory, name = _empty_memory(plan, Path()), plan.context[1]
    view = plan.scene[name]
    frame = view.load()
    memory.observe(frame.rgb, frame.depth, view.camera, round=0)
    ones = np.ones(frame.rgb.shape[:2], np.float32)
    grey = Picture(np.full(frame.rgb.shape, 0.5, np.float32), ones)
    fitted = Fitted(ONE, predicted={name: grey})
    assert fitted.with_best_blend(plan, memory).appearance.blend == Blend()


def test_a_networks_depth_guides_the_fit_and_its_failures_do_not_stop_it(
    bare, tmp_path, monkeypatch, capsys
):
    (tmp_path / "model.safetensors").write_bytes(b"only looked for")
    plan = planned(bare, "depth=da3", f"da3.weights={tmp_path}")
    assert isinstance(plan.source, FoundationDepth)

    def depth(self, scene, view, frame):
        if view.name == plan.context[1]:
            raise DegenerateError("no scale")
        found = np.full(frame.rgb.shape[:2], 3, np.float32)
        return DepthMap(found, np.ones_like(found), self.name)

    monkeypatch.setattr(FoundationDepth, "depth", depth)
    frame = fitting.grid_frame(plan.scene, plan.context)
    first, second, *_ = fit_views(plan, frame, Console())
    assert first.depth is None and first.estimate is not None and (first.estimate == 3).all()
    assert second.estimate is None
    assert "is fitted without an estimate of its depth: no scale" in capsys.readouterr().err
    plain = fit_views(planned(bare), frame, QUIET)
    assert all(view.depth is None and view.estimate is None for view in plain)
    # Without sparse points the fit begins there, too.
    scene = replace(plan.scene, points=None)
    start = first_gaussians(replace(plan, scene=scene), [first, second], frame)
    assert len(start) > 50


def test_a_fit_worse_than_the_memory_is_not_used(bare, monkeypatch, capsys):
    plan = planned(bare, "refine.steps=1")
    sweep = Sweep.of(plan)
    assert sweep is not None
    view = plan.scene["view_3.png"]
    truth = (view.load().rgb / 255).astype(np.float32)
    alpha = np.ones(truth.shape[:2], np.float32)

    def validated(rgb: np.ndarray, steps: int) -> FitValidation | None:
        fitted: Any = SimpleNamespace(
            predicted={view.name: Picture(rgb, alpha)}, sweep=sweep, steps=steps
        )
        return validate_fit(fitted, plan)

    good = validated(truth, 1)
    assert good is not None and good.fit_is_used
    bad = validated(0 * truth, 1000)
    assert bad is not None and not bad.fit_is_used
    close = FitValidation(30, 32, 1000)
    assert close.fit_is_used and not replace(close, steps=100).fit_is_used
    # What the Gaussians show where the memory knows nothing does not count.
    assert good.gaussians > good.memory == bad.memory > 15 > bad.gaussians
    monkeypatch.setattr(fitting, "validate_fit", lambda *args: bad)
    # As far as it has been swept.
    monkeypatch.setattr(Sweep, "of", lambda plan, begins: sweep)
    assert fit_appearance(plan, Console()) is None
    told = capsys.readouterr()
    assert "colours: the memory's own" in told.out and "the fit is not used" in told.err


@pytest.fixture
def heeds_ctrl_c():
    """As in a terminal: where tests run in the background, Ctrl-C is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_ends_a_fit_and_a_second_one_the_run(heeds_ctrl_c, capsys):
    start = Gaussians(np.zeros((1, VALUES), np.float32))
    view = FitView(np.zeros((16, 16, 3), np.uint8), np.diag([16.0, 16.0, 1.0]), np.eye(4))
    fit = Fit(start, [view])
    with fitting._stopped_by_ctrl_c(fit, Console()):
        signal.raise_signal(signal.SIGINT)
        assert fit.stopped
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is heeds_ctrl_c
    assert "the run goes on with it" in capsys.readouterr().out


# How much worse a fit may be than none, and a longer fit than a shorter one [dB].
THAN_NONE, THAN_SHORTER = 0.2, 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["object indoors", "facade", "street", "from above"])
def test_a_fit_never_hurts(tmp_path, name):
    place = PLACES[name]
    write_place(tmp_path / "scan", replace(place, views=14, size=(320, 240)))

    def psnr(seconds):
        out = tmp_path / f"run-{seconds}"
        settings = ("context=not:every:5+2", "targets=every:5+2", f"refine.seconds={seconds}")
        reconstructed(tmp_path / "scan", out, *settings)
        return json.loads((out / "metrics.json").read_text())["psnr"]

    none, short, long = (psnr(seconds) for seconds in (0, 10, 30))
    assert short > none - THAN_NONE
    assert long > max(none - THAN_NONE, short - THAN_SHORTER)
