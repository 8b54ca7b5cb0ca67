"""Targets: what they may be, completed in rounds, projected no oftener than needed; scans."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from memory_scenes import camera as view_from
from memory_scenes import random_memory
from PIL import Image
from scan_files import FAR, write_las
from tiny_scan import FOCAL, HEIGHT, WIDTH, render, world_from_cam, write_colmap_scan, write_scan
from trajectory_writers import write_tum

from gvtools.cameras import Cameras, rigid_poses
from gvtools.cameras import concatenate as all_of
from gvtools.completers.base import Completer, Completion, ScaleAlignment, ScaleStatus
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance, concatenate
from gvtools.kernels import parallel_kernels_may_overlap
from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
from gvtools.runs.run import load_run
from gvtools.scenes.project import open_project
from gvtools.scenes.selection import is_view_or_folder
from gvtools.scenes.transforms import read_camera_path, write_transforms
from gvtools.settings import with_texts
from pipelines.cli import main
from pipelines.reconstruction.plan import Plan, make_schedule, resolve_targets
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.rounds import (
    CachedProjection,
    Clock,
    RoundTargets,
    complete_targets,
)
from pipelines.reconstruction.settings import RunSettings


def camera(name: str, size: tuple[int, int], x: float = 0.0) -> Cameras:
    height, width = size
    pose = rigid_poses(np.eye(3), (-x, 0, 0))
    return Cameras.pinhole(width, height, focal=40.0, cam_from_world=pose, name=name)


class Recorder(Completer):
    """Fills holes with one grey and depth 2, or leaves them."""

    name = "recorder"

    def __init__(self, *, batches_targets: bool, fill: bool = True, factor: float | None = None):
        super().__init__()
        self.batches_targets, self.fill, self.factor = batches_targets, fill, factor
        self.status = ScaleStatus.CAMERA_CENTRES
        self.whole = False
        self.batches: list[tuple[str, ...]] = []

    def complete(self, context, guidance: Guidance, *, seed: int = 0) -> Completion:
        self.batches.append(guidance.cameras.names)
        hole = (~guidance.valid | self.whole) & self.fill
        rgb = np.where(hole[..., None], np.float32(0.5), guidance.rgb)
        depth = np.where(hole, np.float32(2), guidance.depth)
        confidence = np.where(hole, np.float32(0.5), np.minimum(guidance.confidence, 1))
        if self.factor is not None:
            depth = (depth * self.factor).astype(np.float32)
            return Completion(rgb, depth, confidence.astype(np.float32))
        alignment = (ScaleAlignment(self.status),) * len(rgb)
        return Completion(
            rgb, depth, confidence.astype(np.float32), scale_alignment=alignment, whole=self.whole
        )


@pytest.fixture
def memory() -> SpatialMemory:
    out = SpatialMemory(0.02)
    seen = camera("seen", (24, 32))
    rgb = np.full((24, 32, 3), 200, np.uint8)
    out.observe(rgb, np.full((24, 32), 2, np.float32), seen, round=0)
    return out


def complete(memory: SpatialMemory, completer: Recorder, targets: list[Cameras], *settings: str):
    calls: list[str] = []
    project = memory.project

    def counted(cameras, **options):
        calls.append(cameras.names[0])
        return project(cameras, **options)

    followed = [CachedProjection(memory, target, reuse=False) for target in targets]
    for target in followed:
        target.guidance()
    memory.project = counted  # type: ignore[method-assign]
    config = with_texts(RunSettings(), settings)
    results = list(complete_targets(
        followed, 1, memory=memory, completer=completer, context=(), config=config, clock=Clock(),
    ))  # fmt: skip
    return results, sum((result.fusion for result in results), FuseReport()), calls


def test_targets_of_different_sizes_are_completed_together_by_size(memory):
    sizes = [(24, 32), (32, 24), (24, 32), (32, 24)]
    targets = [camera(f"t{i}", size, x=0.3 * i) for i, size in enumerate(sizes)]
    completer = Recorder(batches_targets=True)
    results, total, calls = complete(memory, completer, targets)
    assert completer.batches == [("t0", "t2"), ("t1", "t3")] and not calls
    assert [r.guidance.cameras.names[0] for r in results] == ["t0", "t1", "t2", "t3"]
    for result, size in zip(results, sizes, strict=True):
        assert result.completion.depth.shape == (1, *size)
        assert (result.completion.depth > 0).all()
    assert total.added > 0


def test_a_later_target_sees_what_an_earlier_one_added(memory):
    targets = [camera("t0", (24, 32), x=0.4), camera("t1", (24, 32), x=0.4)]
    results, _, calls = complete(memory, Recorder(batches_targets=False), targets)
    assert calls == ["t1"]
    assert results[1].guidance.generated.any() and not results[0].guidance.generated.any()


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_depth_of_another_unit_is_aligned_with_the_memory(memory, factor):
    completer = Recorder(batches_targets=True, factor=factor)
    ((result,), total, _) = complete(memory, completer, [camera("t0", (24, 32), x=0.3)])
    scale = result.figures["scale"]
    assert scale["status"] == ScaleStatus.MEMORY_DEPTH and scale["accepted"]
    assert scale["scale"] == pytest.approx(1 / factor, rel=1e-5)
    assert scale["overlap_px"] == result.guidance.valid.sum()
    assert total.added > 0
    shown = memory.project(camera("t0", (24, 32), x=0.3))
    assert shown.generated.any()
    np.testing.assert_allclose(shown.depth[shown.generated], 2, rtol=1e-3)


def test_a_scale_that_the_completer_refuses_gives_no_points(memory):
    completer = Recorder(batches_targets=True)
    completer.status = ScaleStatus.CONTRADICTED
    ((result,), total, _) = complete(memory, completer, [camera("t0", (24, 32), x=0.3)])
    assert not total.added and not result.fused.any()
    assert not result.figures["scale"]["accepted"]
    assert result.figures["scale"]["description"].startswith("refused: known depth contradicts")


@pytest.mark.parametrize("pixels", ["holes", "all"])
@pytest.mark.parametrize("as_observed", ["false", "true"])
def test_whole_generated_views_are_fused_as_the_settings_say(memory, pixels, as_observed):
    completer = Recorder(batches_targets=True)
    completer.whole = True
    target, before = camera("t0", (24, 32), x=0.4), len(memory)
    settings = (f"fusion.pixels={pixels}", f"fusion.generated_as_observed={as_observed}")
    ((result,), _, _) = complete(memory, completer, [target], *settings)
    assert (result.completion.rgb == 0.5).all()
    known = result.guidance.valid[0]
    assert 0 < known.sum() < known.size
    assert (result.fused | known).all()
    assert result.fused[known].all() if pixels == "all" else not result.fused[known].any()
    shown = memory.project(target)
    if as_observed == "true":
        assert not memory.generated.any() and len(memory) > before
        grey = np.abs(shown.rgb[0][known] - 0.5).max(-1) < 0.1
        assert (grey.mean() > 0.5) == (pixels == "all")
    else:
        assert memory.generated.any() and shown.generated[0][~known].any()
        # What was observed stands, whatever is generated there.
        assert (shown.rgb[0][known] > 0.7).all()


def test_nothing_is_projected_again_while_nothing_is_fused(memory):
    targets = [camera(f"t{i}", (24, 32), x=0.4) for i in range(3)]
    _, total, calls = complete(memory, Recorder(batches_targets=False, fill=False), targets)
    assert not total.points and not calls


def test_guidance_of_one_size_makes_a_batch_and_of_two_sizes_is_refused(memory):
    views = [memory.project(camera(f"t{i}", (24, 32), x=0.1 * i)) for i in range(2)]
    both = concatenate(views)
    assert both.cameras.names == ("t0", "t1")
    for index, view in enumerate(views):
        assert np.array_equal(both[index].rgb, view.rgb)
        assert np.array_equal(both[index].valid, view.valid)
    with pytest.raises(ShapeError, match="2 picture sizes"):
        concatenate([*views, memory.project(camera("t2", (32, 24)))])
    with pytest.raises(ShapeError, match="0 picture sizes"):
        concatenate([])


# Targets that are looked at ahead.


@pytest.fixture
def seen() -> SpatialMemory:
    memory = random_memory(5)
    # With it, numba chooses how kernels run.
    memory.project(view_from())
    if not parallel_kernels_may_overlap():
        pytest.skip("no OpenMP and no TBB: rounds are not looked at ahead")
    return memory


def plan(*rounds: int) -> Plan:
    """Of so many targets a round."""
    cuts = np.cumsum([0, *rounds])
    at = [view_from(center=(0.1 * i, 0, 0), name=f"t{i}") for i in range(int(cuts[-1]))]
    return cast(
        Plan,
        SimpleNamespace(
            config=RunSettings(),
            schedule=tuple(tuple(range(a, b)) for a, b in pairwise(cuts)),
            targets=SimpleNamespace(cameras=all_of(at)),
        ),
    )


def test_rounds_are_the_plans_whether_looked_at_ahead_or_not(seen):
    with RoundTargets(plan(1, 2), seen) as targets:
        assert [t.camera.names for t in targets.of(1)] == [("t0",)]
        targets.prefetch_round(2)
        ahead = targets.of(2)
        again = targets.of(2)
        targets.prefetch_round(3)
    assert [t.camera.names for t in ahead] == [t.camera.names for t in again] == [("t1",), ("t2",)]
    for one, two in zip(ahead, again, strict=True):
        np.testing.assert_array_equal(one.guidance().rgb, two.guidance().rgb)
        np.testing.assert_array_equal(one.guidance().depth, two.guidance().depth)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return open_project(write_scan(tmp_path_factory.mktemp("scan")))


def test_hold_outs_come_with_their_truth_and_are_no_context(scene):
    targets = resolve_targets(scene, scene.names[::2], "every:2+1")
    assert targets.kind == "hold-out"
    assert targets.cameras.names == scene.names[1::2]
    assert [view.name for view in targets.truth if view] == list(scene.names[1::2])
    with pytest.raises(OptionError, match="allow-overlap"):
        resolve_targets(scene, scene.names, "first:2")
    assert len(resolve_targets(scene, scene.names, "first:2", allow_overlap=True).cameras) == 2


def test_folders_of_views_win_over_paths_which_may_hold_an_at_sign(tmp_path, scene):
    other = write_scan(tmp_path / "run@2026")
    found = resolve_targets(scene, scene.names[:2], f"{other}@last:1", allow_overlap=True)
    assert found.kind == "project" and found.cameras.names == scene.names[-1:]
    whole = resolve_targets(scene, scene.names[:1], str(other), allow_overlap=True)
    assert len(whole.cameras) == len(scene)
    names = tuple(f"test/{name}" for name in scene.names)
    assert is_view_or_folder(names, "test") and not is_view_or_folder(names, "tes")


@pytest.mark.parametrize("name", ["interpolate", "orbit", "spiral"])
def test_paths_have_as_many_cameras_as_asked(scene, name):
    targets = resolve_targets(scene, scene.names, f"{name}:5")
    assert len(targets.cameras) == 5
    assert targets.truth == (None,) * 5
    assert len(set(targets.cameras.names)) == 5


@pytest.mark.parametrize("spec", ["orbit", "orbit:0", "orbit:x", "nosuchview", "evry:2"])
def test_bad_specifications_are_refused(scene, spec):
    with pytest.raises(OptionError):
        resolve_targets(scene, scene.names, spec)


def test_a_file_of_cameras_without_pictures_gives_them_all_or_some(scene, tmp_path):
    """As the viewer saves paths; a project's own file stays a project."""
    path = tmp_path / "path.json"
    cameras = scene.cameras[:3]
    write_transforms(path, cameras, image_paths=[tmp_path / name for name in cameras.names])
    targets = resolve_targets(scene, scene.names, f"{path}@last:2")
    assert (targets.kind, targets.truth, targets.project) == ("trajectory", (None, None), None)
    np.testing.assert_allclose(targets.cameras.cam_from_world, cameras.cam_from_world[1:])
    (tmp_path / cameras.names[1]).write_bytes(b"a picture")
    assert read_camera_path(path, scene.cameras) is None
    write_tum(tmp_path / "path.txt", cameras)
    chosen = resolve_targets(scene, scene.names, f"{tmp_path / 'path.txt'}@first:1")
    pose = chosen.cameras.cam_from_world
    np.testing.assert_allclose(pose, cameras.cam_from_world[:1], atol=1e-6)


def test_a_second_project_gives_cameras_and_truth(scene, tmp_path):
    other = write_scan(tmp_path / "other", views=3)
    targets = resolve_targets(scene, scene.names[2:], f"{other}@first:2")
    assert len(targets.cameras) == 2
    assert targets.truth[0] is not None


def test_a_second_project_with_the_contexts_pictures_is_refused(scene, tmp_path):
    copied = write_scan(tmp_path / "other", views=3)
    for spec in (str(scene.root), f"{copied}@first:2"):
        with pytest.raises(OptionError, match="overlap"):
            resolve_targets(scene, scene.names, spec)
        assert len(resolve_targets(scene, scene.names, spec, allow_overlap=True).cameras) >= 2


def test_a_list_longer_than_a_files_name_is_a_selection(tmp_path):
    wide = open_project(write_scan(tmp_path / "wide", views=14))
    spec = ",".join(wide.names[2:])
    assert len(spec) > 255
    assert len(resolve_targets(wide, wide.names[:2], spec).cameras) == 12


def test_a_second_project_with_smaller_copies_of_the_pictures_is_refused(scene, tmp_path):
    """Other files, sizes and intrinsics, but the same shots."""
    cameras = scene.cameras.resized(48, 36)
    for name in cameras.names:
        Image.new("RGB", (48, 36)).save(tmp_path / f"{name}.png")
    write_transforms(
        tmp_path / "transforms.json", cameras, image_paths=[f"{name}.png" for name in cameras.names]
    )
    with pytest.raises(OptionError, match="overlap"):
        resolve_targets(scene, scene.names[:2], str(tmp_path))
    others = resolve_targets(scene, scene.names[:2], f"{tmp_path}@range:2-5")
    assert len(others.cameras) == 4


@pytest.mark.parametrize(
    ("targets", "size", "rounds", "expected"),
    [
        (5, 6, 3, (1, 2, 2)),
        (7, 3, None, (2, 2, 3)),
        (12, 3, 2, (3, 3)),
        (2, 6, 5, (1, 1)),
        (4, 2, 0, ()),
    ],
)
def test_the_schedule_takes_targets_in_order(targets, size, rounds, expected):
    schedule = make_schedule(targets, size, rounds)
    assert tuple(len(rows) for rows in schedule) == expected
    assert [row for rows in schedule for row in rows] == list(range(sum(expected)))
    assert all(len(rows) <= size for rows in schedule)


def test_points_of_held_out_views_are_used_and_said_so_or_left_out(tmp_path):
    scan = write_colmap_scan(tmp_path / "scan", views=4, points=10)
    scene = open_project(scan)
    said: list[str] = []
    settings = {"context": "first:3", "targets": "last:1", "depth": "plane-sweep"}
    plan = make_plan(scene, RunSettings(**settings), say=said.append)
    assert plan.scene.points is not None
    assert len(plan.scene.points.positions) == 40
    assert any("40 of 40 sparse points" in line and "points=context" in line for line in said)
    # Each point is detected by one view here; the context would have to detect it twice.
    strict = make_plan(scene, RunSettings(**settings, points="context", voxel=0.1))
    assert strict.scene.points is not None
    assert len(strict.scene.points.positions) == 0


SCALE = 2.0


def far_scan(path: Path, *, colored: bool = False) -> Path:
    """What a scanner at the last view's place sees, twice as large and far away; red is blue."""
    positions, colors = [], []
    for index in (4, 5):
        pose = world_from_cam(index)
        rgb, depth = render(pose)
        colors.append(rgb.reshape(-1, 3)[:, ::-1])
        row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        rays = [(column - WIDTH / 2) / FOCAL, (row - HEIGHT / 2) / FOCAL, np.ones_like(row)]
        positions.append((np.stack(rays, -1) * depth[..., None]).reshape(-1, 3) + pose[:3, 3])
    count = sum(map(len, positions))
    return write_las(
        path,
        SCALE * np.concatenate(positions) + FAR,
        np.concatenate(colors) if colored else None,
        intensity=np.arange(count) % 999,
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """A folder with a project, a scan, and runs with and without it."""
    root = tmp_path_factory.mktemp("scanned")
    project, scan = write_scan(root / "project"), far_scan(root / "scan.laz")
    write_las(root / "few.las", np.eye(20, 3), None)
    matrix = np.diag([1 / SCALE] * 3 + [1.0])
    matrix[:3, 3] = -FAR / SCALE
    np.savetxt(root / "placement.txt", matrix, fmt="%.17g")
    options = ["--context", "first:1", "--targets", "range:4-5", "--refine", "0", "--quiet",
               "--set", "refine.poses=false"]  # fmt: skip
    given = ["--cloud", str(scan), "--cloud-placement", str(root / "placement.txt")]
    for name, more in (("with", given), ("without", [])):
        out = ["--out", str(root / name)]
        assert main(["reconstruct", str(project), *options, *out, *more]) == 0
    return root


def test_a_run_begins_with_the_scan_and_counts_it_apart(runs):
    run = load_run(runs / "with")
    first = run.rounds[0]
    memory = SpatialMemory.load(runs / "with" / "memory.npz")
    kept = memory.scanned & (memory.columns.round == 0)
    assert first["scanned"] == int(kept.sum()) > 0
    assert first["observed"] + first["scanned"] == first["points"]
    assert first["scan"]["stations"] == 1 and first["scan"]["colored_by"] == "intensity"
    assert first["scan"]["placement"]["scale"] == pytest.approx(1 / SCALE)
    covered = [load_run(runs / name).rounds[1]["coverage_before"] for name in ("with", "without")]
    assert covered[0] > 0.95 > covered[1] + 0.2
    # In its place: the depth that the target has.
    figures = json.loads((runs / "with" / "metrics.json").read_text())
    assert figures["depth_rel_valid"] < 0.01


def test_a_given_placement_that_the_photographs_contradict_is_said(runs, tmp_path, capsys):
    options = ["--context", "first:1", "--targets", "range:4-5", "--refine", "0", "--rounds", "0"]
    words = ["--cloud", str(runs / "scan.laz"), "--cloud-placement", "identity"]
    main(["reconstruct", str(runs / "project"), *options, *words, "--out", str(tmp_path / "run")])
    assert "of the same places: is the matrix of another unit" in capsys.readouterr().err


def test_colours_that_the_photographs_contradict_are_said(runs, tmp_path, capsys):
    scan = far_scan(tmp_path / "scan.las", colored=True)
    options = ["--context", "range:4-5", "--targets", "first:1", "--refine", "0", "--rounds", "0"]
    words = ["--cloud", str(scan), "--cloud-placement", str(runs / "placement.txt")]
    main(["reconstruct", str(runs / "project"), *options, *words, "--out", str(tmp_path / "run")])
    said = capsys.readouterr().err
    assert "red and blue are the other way round" in said and "as bright" not in said


def test_pages_and_pictures_name_what_is_scanned(runs):
    page = (runs / "with" / "report.html").read_text()
    assert "of them scanned" in page and "scan.laz" in page
    assert "of them scanned" not in (runs / "without" / "report.html").read_text()
    from PIL import Image

    levels = set()
    for path in (runs / "with" / "round_001").glob("valid_*.png"):
        levels |= set(np.unique(np.asarray(Image.open(path))).tolist())
    assert 192 in levels


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--cloud", "{root}/few.las"], "20 points of the scan"),
        (["--cloud", "{root}/none.laz"], "no such file"),
        (["--cloud", "{root}/scan.laz", "--cloud-placement", "1,2"], "12 or 16 numbers"),
        (["--cloud-placement", "identity"], "without a scan"),
        (
            ["--cloud", "{root}/scan.laz", "--cloud-placement", "1,0,0,1e9,0,1,0,0,0,0,1,0"],
            "points lie beyond",
        ),
    ],
)
def test_what_cannot_be_placed_is_refused_in_one_line(runs, tmp_path, capsys, options, said):
    options = [option.format(root=runs) for option in options]
    project, out = str(runs / "project"), str(tmp_path / "out")
    status = main(
        ["reconstruct", project, "--context", "first:2", "--refine", "0", "--out", out, *options]
    )
    lines = capsys.readouterr().err.strip().splitlines()
    assert status == 2 and said in lines[-1] and not (tmp_path / "out").exists()
