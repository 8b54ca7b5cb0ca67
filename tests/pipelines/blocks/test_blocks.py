"""A project split, its blocks reconstructed, their runs merged: against the unsplit run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import refused
from tiny_scan import write_colmap_scan, write_scan

from gvtools.errors import OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.runs.run import load_run
from gvtools.scenes.project import open_project
from gvtools.settings import with_values
from pipelines.blocks.merge import merge
from pipelines.blocks.split import cut_cells, read_blocks, split
from pipelines.cli import main
from pipelines.console import Console
from pipelines.reconstruction import run
from pipelines.reconstruction.settings import RunSettings

pytestmark = pytest.mark.usefixtures("unpainted")

QUIET = Console(quiet=True)
# The last view sees what no other does.
CONTEXT, TARGETS = "not:every:6+3", "every:6+3"
SETTINGS = {"profile": "fast", "memory.observations_per_voxel": 3, "refine.poses": False}


def reconstruct(project: Path, out: Path, **values: object) -> Path:
    config = with_values(RunSettings(), {**SETTINGS, **values})
    return run.reconstruct(open_project(project), config, out, console=QUIET)


def block_runs(folder: Path, out: Path, **values: object) -> list[Path]:
    """A run of each block, its own lists as context and targets."""
    runs = []
    for place, block in read_blocks(folder):
        lists = {"context": f"@{place}/context.txt"}
        lists |= {"targets": f"@{place}/targets.txt"} if block.targets else {}
        runs.append(reconstruct(place, out / block.name, **lists, **values))
    return runs


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan, its unsplit run, its blocks, their runs and the merged run."""
    folder = tmp_path_factory.mktemp("walk")
    scan = write_scan(folder / "scan", views=10)
    reconstruct(scan, folder / "whole", context=CONTEXT, targets=TARGETS)
    split(open_project(scan), folder / "blocks", blocks=3, context=CONTEXT, max_side=480,
          refine_poses=False)  # fmt: skip
    merge(block_runs(folder / "blocks", folder / "runs")[::-1], folder / "merged", console=QUIET)
    return folder


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
    options = {"depth": "plane-sweep", "rounds": 0, "voxel": 0.05, "stereo.max_side": 64}
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
