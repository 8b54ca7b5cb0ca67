from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_scan import write_scan

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import HARMONICS, LOG_SCALE, SH
from gvtools.cameras import Cameras
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.runs.folder import RunDirectory
from gvtools.runs.poses import RunPoses
from gvtools.runs.run import load_run
from gvtools.scenes.project import open_project
from gvtools.settings import with_values
from gvtools.splats import turn_gaussians
from pipelines.blocks import merge as merging
from pipelines.blocks.merge import BlockAppearance, fit_across, join_appearances, merge, rows_across
from pipelines.blocks.split import BlockCell, SceneBlock, read_blocks, split
from pipelines.console import Console
from pipelines.reconstruction import run
from pipelines.reconstruction.fitting import Fitted
from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.settings import RunSettings

NAMES = ("a", "b", "c")


def camera() -> Cameras:
    K = np.array([[[40.0, 0, 24], [0, 40, 18], [0, 0, 1]]])
    return Cameras(K, np.eye(4)[None], np.array([48]), np.array([36]), ("target",))


def whole() -> Gaussians:
    rng = np.random.default_rng(2)
    positions = np.column_stack([rng.uniform(-1, 1, (300, 2)), rng.uniform(2, 3, 300)])
    some = Gaussians.at(positions, rng.uniform(40, 200, (300, 3)), sizes=np.full(300, 0.1))
    some.values[:, SH + 3 :] = rng.normal(scale=0.03, size=(300, some.values.shape[1] - SH - 3))
    return some


def in_frame(some: Gaussians, frame: LocalFrame, gain: float) -> Gaussians:
    """The same Gaussians as a block has them: in its frame, brighter by a factor."""
    values = turn_gaussians(some.values, frame.axes.T)
    values[:, :LOG_SCALE] = frame.from_world(some.values[:, :LOG_SCALE])
    sh = values[:, SH:].reshape(len(values), -1, 3) * gain
    sh[:, 0] += 0.5 * (gain - 1) / HARMONICS[0]
    values[:, SH:] = sh.reshape(len(values), -1)
    return Gaussians(values, frame=frame)


def part(number: int, cell: BlockCell, *, gain: float) -> BlockAppearance:
    """A block that has all Gaussians; its photographs are darker by what they are brighter."""
    turn = Rotation.from_euler("xyz", [0.3 * number, 0.5, -0.2 * number]).as_matrix()
    frame = LocalFrame.at([number, -0.5, 0.25], turn)
    poses = np.tile(np.eye(4), (3, 1, 1))
    logs = np.full((3, 3), -np.log(gain))
    owners = NAMES[:1] if number == 0 else NAMES[1:]
    block = SceneBlock(
        name=str(number), names=("0", "1"), project="", reading={}, low=cell.low, high=cell.high,
        owners=owners, helpers=(), targets=(), poses={}, refined=False,
    )  # fmt: skip
    exposures = Exposures(frame.cam_from_local(poses), logs, 1.0)
    return BlockAppearance(
        block, NAMES, Appearance(in_frame(whole(), frame, gain), 0.1, exposures=exposures)
    )


def test_joined_blocks_show_the_undivided_picture() -> None:
    left, right = BlockCell.everywhere().cut(0, 0.1)
    merged = join_appearances([part(0, left, gain=1.25), part(1, right, gain=0.8)], LocalFrame.at())
    # Equal photographs: half of the ratio of the blocks' scales goes to each.
    assert len(merged.gaussians) == 300
    assert merged.exposures is not None
    assert np.ptp(merged.exposures.log_gains, axis=0) == pytest.approx(0, abs=1e-9)
    expected = Appearance(whole(), 0.1).picture(camera()).rgb
    found = merged.picture(camera()).rgb
    assert np.abs(found - expected).max() < 2e-3


def test_only_the_gaussians_of_the_own_cell_stay() -> None:
    left, right = BlockCell.everywhere().cut(0, 0.1)
    merged = join_appearances([part(0, left, gain=1.0), part(1, right, gain=1.0)], LocalFrame.at())
    x = np.sort(merged.gaussians.values[:, 0])
    assert np.allclose(x, np.sort(whole().values[:, 0]), atol=1e-5)
    nothing = BlockCell(np.full(3, 50.0), np.full(3, 60.0))
    parts = [part(0, left, gain=1.0), part(1, nothing, gain=1.0)]
    assert len(join_appearances(parts, LocalFrame.at()).gaussians) < 300
    with_one = join_appearances([part(0, left, gain=1.0)], LocalFrame.at())
    assert (with_one.gaussians.values[:, 0] < 0.1 + 1e-5).all()


QUIET = Console(quiet=True)
CONTEXT, TARGETS = "not:every:6+3", "every:6+3"
FIT = {"refine.steps": 16, "refine.most_gaussians": 800, "refine.poses": False, "rounds": 1}
SAVED = "round_000/appearance.npz"


def reconstruct(project: Path, out: Path, **values: object) -> Path:
    config = with_values(RunSettings(), {**FIT, **values})
    return run.reconstruct(open_project(project), config, out, console=QUIET)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan, its unsplit run, its blocks, their runs and the merged run."""
    folder = tmp_path_factory.mktemp("fitted")
    scan = write_scan(folder / "scan", views=10)
    reconstruct(scan, folder / "whole", context=CONTEXT, targets=TARGETS)
    split(
        open_project(scan), folder / "blocks", blocks=2, overlap=0.5, context=CONTEXT,
        refine_poses=False,
    )  # fmt: skip
    for place, block in read_blocks(folder / "blocks"):
        lists = {"context": f"@{place}/context.txt", "targets": f"@{place}/targets.txt"}
        reconstruct(place, folder / "runs" / block.name, **lists)
    merge(sorted((folder / "runs").iterdir()), folder / "merged", console=QUIET)
    return folder


def across(folder: Path) -> list[str]:
    context = load_run(folder / "merged").context
    blocks = [block for _, block in read_blocks(folder / "blocks")]
    return [context[row] for row in rows_across(context, blocks)]


@pytest.fixture(scope="module")
def joined(fitted: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, Fitted, Any]:
    """What the same merge would fit further: its plan, the joined Gaussians and the blocks."""
    given: list[tuple[Plan, Fitted, Any]] = []

    def note(plan: Plan, joined: Fitted, blocks: Any, *, console: Console) -> Fitted:
        given.append((plan, joined, blocks))
        return joined

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merging, "fit_across", note)
        out = tmp_path_factory.mktemp("joined") / "merged"
        merge(sorted((fitted / "runs").iterdir()), out, console=QUIET)
    return given[0]


def error(folder: Path, fit: Fitted) -> float:
    """Mean squared difference from the photographs across faces."""
    scene = open_project(folder / "scan")
    return float(np.mean([
        np.square(fit.appearance.picture(scene[name].camera).rgb
                  - scene[name].load().rgb / np.float32(255)).mean()
        for name in across(folder)
    ]))  # fmt: skip


def test_pictures_across_faces_come_nearer_to_the_photographs(fitted, joined):
    before = joined[1]
    after = Fitted.load(fitted / "merged" / SAVED)
    assert error(fitted, after) < 0.95 * error(fitted, before)
    # Half of the steps that a fit of its own would have; at the same poses.
    assert after.steps - before.steps == FIT["refine.steps"] // 2
    one, two = before.appearance.exposures, after.appearance.exposures
    assert one is not None and two is not None
    assert one.poses.tobytes() == two.poses.tobytes()
    context, fitted_to = load_run(fitted / "merged").context, across(fitted)
    for name, old, new in zip(context, one.log_gains, two.log_gains, strict=True):
        assert (old == new).all() == (name not in fitted_to)


def test_a_resumed_merge_has_the_same_bytes_and_fits_no_second_time(fitted, tmp_path, monkeypatch):
    runs, out = sorted((fitted / "runs").iterdir()), tmp_path / "merged"

    def stop(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run, "measure_run", stop)
        with pytest.raises(KeyboardInterrupt):
            merge(runs, out, console=QUIET)
    assert len(RunDirectory(out).reports()) == 2
    monkeypatch.setattr(merging, "fit_across", stop)
    merge(runs, out, resume=True, console=QUIET)
    for name in (SAVED, "memory.npz"):
        assert (out / name).read_bytes() == (fitted / "merged" / name).read_bytes(), name


def test_poses_and_brightness_stay_where_the_views_across_are_exposed_unlike_others(joined) -> None:
    plan, fit, blocks = joined
    refine = plan.config.refine.replaced(steps=2)
    plan = replace(plan, config=plan.config.replaced(refine=refine))
    context = plan.scene.subset(plan.context).cameras
    poses = RunPoses(context.cam_from_world, plan.targets.cameras.cam_from_world)
    exposures = fit.appearance.exposures
    assert exposures is not None
    log_gains = np.zeros_like(exposures.log_gains)
    log_gains[rows_across(plan.context, blocks)] = 0.5
    appearance = replace(fit.appearance, exposures=replace(exposures, log_gains=log_gains))
    some = replace(fit, appearance=appearance, poses=poses)
    found = fit_across(plan, some, blocks, console=QUIET)
    assert found.poses is poses
    # One step changes next to nothing; a change of level would be a factor of 1.6.
    assert found.appearance.exposures is not None
    assert np.abs(found.appearance.exposures.log_gains - log_gains).max() < 0.05
    camera = plan.scene[plan.context[0]].camera
    one, two = (replace(some, exposures=None).picture(camera).rgb.mean() for some in
                (appearance, found.appearance))  # fmt: skip
    assert two == pytest.approx(one, rel=0.1)
