"""A project split, its blocks reconstructed, their runs merged: against the unsplit run."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import refused
from scipy.spatial.transform import Rotation
from tiny_scan import write_colmap_scan, write_scan

from gvtools.appearance.appearance import Appearance
from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import HARMONICS, LOG_SCALE, SH
from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.runs.folder import RunDirectory
from gvtools.runs.poses import RunPoses
from gvtools.runs.run import load_run
from gvtools.scenes.project import open_project
from gvtools.settings import with_values
from gvtools.splats import turn_gaussians
from pipelines.blocks import merge as merging
from pipelines.blocks.merge import BlockAppearance, fit_across, join_appearances, merge, rows_across
from pipelines.blocks.split import BlockCell, SceneBlock, cut_cells, read_blocks, split
from pipelines.cli import main
from pipelines.console import Console
from pipelines.reconstruction import run
from pipelines.reconstruction.fitting import Fitted
from pipelines.reconstruction.plan import Plan
from pipelines.reconstruction.settings import RunSettings

QUIET = Console(quiet=True)
# The last view sees what no other does.
CONTEXT, TARGETS = "not:every:6+3", "every:6+3"
FAST = {"profile": "fast", "memory.observations_per_voxel": 3}
FIT = {"refine.steps": 16, "refine.most_gaussians": 800, "rounds": 1}


def reconstruct(project: Path, out: Path, **values: object) -> Path:
    config = with_values(RunSettings(), {"refine.poses": False, **values})
    return run.reconstruct(open_project(project), config, out, console=QUIET)


def block_runs(folder: Path, out: Path, **values: object) -> list[Path]:
    """A run of each block, its own lists as context and targets."""
    runs = []
    for place, block in read_blocks(folder):
        lists = {"context": f"@{place}/context.txt"}
        lists |= {"targets": f"@{place}/targets.txt"} if block.targets else {}
        runs.append(reconstruct(place, out / block.name, **lists, **values))
    return runs


def split_run(folder: Path, *, blocks: int, overlap: float, **values: object) -> Path:
    """A scan, its unsplit run, its blocks, their runs and the merged run."""
    scan = write_scan(folder / "scan", views=10)
    reconstruct(scan, folder / "whole", context=CONTEXT, targets=TARGETS, **values)
    split(open_project(scan), folder / "blocks", blocks=blocks, overlap=overlap, context=CONTEXT,
          refine_poses=False)  # fmt: skip
    runs = block_runs(folder / "blocks", folder / "runs", **values)
    merge(runs[::-1], folder / "merged", console=QUIET)
    return folder


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return split_run(tmp_path_factory.mktemp("walk"), blocks=3, overlap=0.8, **FAST)


def observed(run: Path) -> SpatialMemory:
    memory = SpatialMemory.load(run / "memory.npz")
    for number in reversed(memory.rounds[1:]):
        memory.forget(round=number)
    return memory


def test_observed_content_is_the_unsplit_runs_to_the_bit(walk: Path) -> None:
    one, two = observed(walk / "whole"), observed(walk / "merged")
    assert one.voxel == two.voxel and one.frame.same_as(two.frame)
    for name in ("positions", "colors", "confidence", "spacing", "round", "view", "level"):
        left, right = getattr(one.columns, name), getattr(two.columns, name)
        assert left.tobytes() == right.tobytes(), name
    for first, second in zip(one.views, two.views, strict=True):
        assert first.camera.names == second.camera.names
        assert first.camera.cam_from_world.tobytes() == second.camera.cam_from_world.tobytes()
        assert first.free_depth.tobytes() == second.free_depth.tobytes()
    # The views of several blocks did merge, so that their memories could not have been added.
    report = load_run(walk / "merged").rounds[0]
    alone = [load_run(walk / "runs" / path.name).rounds[0] for path in (walk / "runs").iterdir()]
    assert report["merged"] > 0
    assert report["points"] < sum(other["points"] for other in alone)


def test_every_view_enters_once_and_targets_come_from_their_own_block(walk: Path) -> None:
    scene, merged_run = open_project(walk / "scan"), load_run(walk / "merged")
    blocks = [block for _, block in read_blocks(walk / "blocks")]
    owned = sorted(name for block in blocks for name in block.owners)
    assert list(merged_run.context) == owned
    assert all(set(block.helpers) <= set(owned) - set(block.owners) for block in blocks)
    assert any(block.helpers for block in blocks)
    targets = [name for block in blocks for name in block.targets]
    assert sorted([*owned, *targets]) == sorted(scene.names)
    assert sorted(view.name for view in merged_run.views) == sorted(targets)
    whole = json.loads((walk / "whole/metrics.json").read_text())
    merged = json.loads((walk / "merged/metrics.json").read_text())
    assert merged["coverage"] == whole["coverage"]
    assert merged["psnr"] == pytest.approx(whole["psnr"], abs=0.1)


def test_generated_content_is_that_of_the_blocks_and_stays_out_of_free_space(walk: Path) -> None:
    from gvtools.memory.culling import in_free_space

    memory = SpatialMemory.load(walk / "merged/memory.npz")
    made = memory.generated
    assert made.any()
    assert {memory.views[i].camera.names[0] for i in np.unique(memory.columns.view[made])} <= {
        view.name for view in load_run(walk / "merged").views
    }
    free = in_free_space(
        memory.columns.positions[made], memory.observed_grids(range(len(memory.views))),
        tolerance=memory.options.free_space_tolerance,
    )  # fmt: skip
    assert not free.any()


def test_commands_read_the_merged_run_and_blocks(walk: Path) -> None:
    assert main(["evaluate", str(walk / "merged")]) == 0
    assert main(["check", str(walk / "blocks/0_0")]) == 0


def test_a_block_is_read_like_the_project_and_survives_a_copy(walk: Path, tmp_path: Path) -> None:
    scene = open_project(walk / "scan")
    place, block = next(read_blocks(walk / "blocks"))
    shutil.copytree(place, tmp_path / "copy")
    alone = open_project(tmp_path / "copy")
    assert set(alone.names) == {*block.context, *block.targets}
    for name in alone.names:
        one, two = scene[name].load(), alone[name].load()
        assert one.depth is not None and two.depth is not None
        assert np.array_equal(one.rgb, two.rgb) and np.array_equal(one.depth, two.depth)
        assert np.allclose(scene[name].camera.K, alone[name].camera.K, rtol=0, atol=1e-12)
        if name in block.poses and not block.refined:
            assert np.allclose(
                scene[name].camera.cam_from_world, alone[name].camera.cam_from_world, atol=1e-12
            )


def test_computed_depth_is_that_of_each_views_owner(tmp_path: Path) -> None:
    scan = write_colmap_scan(tmp_path / "scan", views=6)
    split(open_project(scan), tmp_path / "blocks", blocks=2, overlap=1.0)
    options = {"depth": "plane-sweep", "rounds": 0, "voxel": 0.05, "stereo.max_side": 64, **FAST}
    runs = block_runs(tmp_path / "blocks", tmp_path / "runs", **options)
    # With all views in every block, a view's depth is the unsplit run's, up to rounding of poses.
    whole = reconstruct(scan, tmp_path / "whole", **options)
    merge(runs, tmp_path / "merged", console=QUIET)
    for path in sorted((tmp_path / "merged/round_000").glob("context_depth_*.npz")):
        name = path.name.removeprefix("context_depth_").removesuffix(".npz") + ".png"
        block = next(b for _, b in read_blocks(tmp_path / "blocks") if name in b.owners)
        (owner,) = (r for r in runs if r.name == block.name)
        assert path.read_bytes() == (owner / "round_000" / path.name).read_bytes()
    one, two = observed(whole), observed(tmp_path / "merged")
    assert len(one.views) == len(two.views) == 6
    assert abs(len(one) - len(two)) < 0.02 * len(one)


def test_chunks_have_the_layout_of_hierarchical_3dgs(tmp_path: Path) -> None:
    scan = write_colmap_scan(tmp_path / "scan", views=8)
    scene = open_project(scan)
    blocks = split(scene, tmp_path / "out", blocks=2, layout="chunks")
    for block in blocks:
        chunk = tmp_path / "out/chunks" / block.name
        center, extent = (
            np.array([float(word) for word in (chunk / name).read_text().split(" ")])
            for name in ("center.txt", "extent.txt")
        )
        owned = scene.subset(block.owners).cameras.centers
        assert (np.abs(owned - center) <= extent / 2).all()
        read = open_project(chunk)
        assert set(read.names) == set(block.context)
        assert read.points is not None and scene.points is not None
        known = {tuple(point) for point in scene.points.positions.round(9)}
        assert {tuple(point) for point in read.points.positions.round(9)} <= known
        for name in block.owners:
            assert np.array_equal(read[name].load().rgb, scene[name].load().rgb)
    # Chunks share the pictures, and their boxes do not overlap.
    assert len(list((tmp_path / "out/rectified/images").iterdir())) == 8
    assert not list((tmp_path / "out/chunks").glob("*/images"))


@pytest.mark.parametrize("count", [1, 3, 8])
def test_cells_fill_space_and_share_cameras_evenly(count: int) -> None:
    points = np.random.default_rng(count).normal(size=(40, 3)) * [5, 2, 1]
    cells = cut_cells(points, count)
    assert len(cells) == count
    anywhere = np.random.default_rng(9).normal(size=(500, 3)) * 50
    holding = np.sum([cell.holds(anywhere) for cell in cells.values()], axis=0)
    assert (holding == 1).all()
    held = [int(cell.holds(points).sum()) for cell in cells.values()]
    assert max(held) - min(held) <= 2 and sum(held) == 40


def test_more_blocks_than_places_are_refused() -> None:
    with pytest.raises(OptionError, match="too few places"):
        cut_cells(np.zeros((5, 3)), 2)
    with pytest.raises(OptionError, match="expected 1 to 5"):
        cut_cells(np.zeros((5, 3)), 6)


def test_what_cannot_be_merged_is_refused_in_one_line(walk, tmp_path, capsys):
    runs = sorted((walk / "runs").iterdir())
    out = tmp_path / "merged"
    assert "missing: " in refused(capsys, "merge", *runs[:2], "--out", out)
    assert "are both of block" in refused(capsys, "merge", runs[0], *runs, "--out", out)
    assert "is no block" in refused(capsys, "merge", walk / "whole", "--out", out)
    odd = tmp_path / "odd"
    shutil.copytree(runs[0], odd)
    record = json.loads((odd / "run.json").read_text())
    record["settings"]["seed"] = 7
    (odd / "run.json").write_text(json.dumps(record))
    assert "differ in seed" in refused(capsys, "merge", odd, *runs[1:], "--out", out)
    assert not out.exists()


NAMES = ("a", "b", "c")


def camera() -> Cameras:
    return Cameras.pinhole(48, 36, focal=40.0, name="target")


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


SAVED = "round_000/appearance.npz"


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return split_run(tmp_path_factory.mktemp("fitted"), blocks=2, overlap=0.5, **FIT)


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
