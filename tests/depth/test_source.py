"""Recorded depth that other views look through."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes_workspace import workspace
from tiny_scan import without_depth, write_scan

from gvtools.cameras import Cameras, rigid_poses
from gvtools.depth import choice
from gvtools.depth.choice import ColmapPatchMatch, choose_source, rough_source
from gvtools.depth.options import StereoOptions
from gvtools.depth.shown import depth_from_memory
from gvtools.depth.source import (
    LEAST,
    DepthMap,
    MixedDepth,
    RecordedDepth,
    contradictions,
    disagrees,
    is_recorded,
    scale_to_points,
)
from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo
from gvtools.errors import CheckpointError, DegenerateError, OptionError, ProjectError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.procedural.stereo_sample import write_motorcycle
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.images import write_depth_map
from gvtools.scenes.project import open_project
from gvtools.scenes.rgbd_layouts import SEVENSCENES
from gvtools.scenes.scene import Frame, Scene, SparsePoints, View
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("unpainted")

HEIGHT, WIDTH, FAR = 40, 60, 3.0


def camera(
    x: float = 0.0, name: str = "one", *, size: tuple[int, int] = (WIDTH, HEIGHT), focal: float = 50
) -> Cameras:
    pose = rigid_poses(np.eye(3), (-x, 0, 0))
    return Cameras.pinhole(*size, focal=focal, cam_from_world=pose, name=name)


def wall(depth: float = FAR) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), depth, np.float32)


def with_blob(depth: float = 2.0) -> np.ndarray:
    """A wall with a square that floats at another depth."""
    out = wall()
    out[10:20, 25:35] = depth
    return out


OTHERS = [camera(0.1), camera(-0.1), camera(0.15)]


def seen(depth: np.ndarray, cameras: list[Cameras]) -> list[tuple[np.ndarray, Cameras]]:
    return [(depth, each) for each in cameras]


SMALL = [each.resized(WIDTH // 2, HEIGHT // 2) for each in OTHERS]


@pytest.mark.parametrize(
    ("depth", "witnesses", "wrong"),
    [
        (with_blob(), seen(wall(), OTHERS), True),
        (with_blob(), seen(wall()[::2, ::2], SMALL), True),
        (with_blob(), seen(wall(), OTHERS[: LEAST - 1]), False),
        (with_blob(), seen(wall(0.0), OTHERS), False),
        # As many confirm it, and fewer than look through.
        (with_blob(), seen(wall(2.0), OTHERS[:2]) + seen(wall(), OTHERS[:2]), False),
        (with_blob(), seen(wall(2.0), OTHERS[:2]) + seen(wall(), OTHERS), True),
        # Hidden by something nearer; noise.
        (wall(), seen(wall(1.0), OTHERS), False),
        (with_blob(0.97 * FAR), seen(wall(), OTHERS), False),
    ],
)
def test_what_more_views_look_through_than_confirm_is_contradicted(depth, witnesses, wrong):
    found = contradictions(depth, camera(), witnesses)
    np.testing.assert_array_equal(found, wrong & (with_blob() < FAR))


def test_a_real_object_in_front_of_a_wall_stays():
    # A square of 0.4 at depth 2, as each camera sees it; its rim hides and shows the wall.
    def seen(x: float) -> np.ndarray:
        out = wall()
        u = (np.arange(WIDTH) + 0.5 - 30) / 50 * 2.0 + x
        v = (np.arange(HEIGHT) + 0.5 - 20) / 50 * 2.0
        out[np.ix_(np.abs(v) < 0.2, np.abs(u) < 0.2)] = 2.0
        return out

    others = [(seen(x), camera(x)) for x in (0.1, -0.1, 0.15, -0.15)]
    wrong = contradictions(seen(0.0), camera(), others)
    assert wrong.sum() <= 0.1 * (seen(0.0) < FAR).sum()


def test_beside_something_thin_a_view_does_not_look_through():
    bar = wall()
    bar[:, 30] = 2.0
    # Its pose is off by a pixel, so that it shows the wall where the bar is.
    off = wall()
    off[:, 31] = 2.0
    witnesses = [(off, camera()), (off, camera()), (off, camera())]
    assert not contradictions(bar, camera(), witnesses).any()


def view_of(name: str, x: float, depth: np.ndarray, *, use: bool = True) -> View:
    frame = Frame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth, np.full(depth.shape, use))
    return View(name, camera(x, name), lambda: frame, has_depth=True)


@pytest.mark.parametrize(("first", "others"), [(True, False), (False, True), (True, True)])
def test_recorded_depth_is_dropped_and_counted_where_masks_let_it_speak(first, others):
    views = (
        view_of("a", 0.0, with_blob(), use=first),
        view_of("b", 0.1, wall(), use=others),
        view_of("c", -0.1, wall(), use=others),
        replace(view_of("d", 0.2, wall()), has_depth=False),
    )
    scene = Scene(Path("."), "rgbd", views)
    alone = RecordedDepth().depth(scene, views[0], views[0].load())
    np.testing.assert_array_equal(alone.depth, with_blob())
    checked = RecordedDepth(scene.names).depth(scene, views[0], views[0].load())
    wrong = (with_blob() < FAR) & first & others
    assert (alone.contradicted, checked.contradicted) == (0, wrong.sum())
    np.testing.assert_array_equal(checked.depth, np.where(wrong, 0, with_blob()))


class Computed:
    """A source that always has 2."""

    name = "computed"

    def covers(self, view: View) -> bool:
        return True

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        depth = np.full(frame.rgb.shape[:2], 2, np.float32)
        return DepthMap(depth, np.ones_like(depth), self.name)


@pytest.fixture
def scan(tmp_path) -> Scene:
    return SEVENSCENES.read(write_scan(tmp_path / "scan"))


def with_points(scene: Scene, positions=(), xy=()) -> Scene:
    """The scene with sparse points (N, 3) that its first view sees at (N, 2) pixels."""
    count = len(positions)
    points = SparsePoints(
        np.reshape(positions, (-1, 3)), np.zeros((count, 3), np.uint8),
        np.zeros(count, np.float32), np.arange(count, dtype=np.int32),
        np.zeros(count, np.int32), np.reshape(xy, (-1, 2)),
    )  # fmt: skip
    return replace(scene, points=points)


def test_auto_takes_recorded_depth_and_computes_the_rest(scan, monkeypatch):
    chosen = choose_source(scan, scan.names, "auto")
    assert isinstance(chosen.source, RecordedDepth) and "every context view" in chosen.reason
    monkeypatch.setattr(choice, "_stereo", lambda *_: Computed())
    partly = without_depth(scan, 1, 3)
    chosen = choose_source(partly, partly.names, "auto")
    assert isinstance(chosen.source, MixedDepth)
    assert chosen.reason.startswith("4 of 6 views have recorded depth")
    for i, view in enumerate(partly):
        found = chosen.source.depth(partly, view, view.load())
        assert found.source == ("computed" if i in (1, 3) else "recorded")
        assert is_recorded(chosen.source, view) == (i not in (1, 3))
    bare = without_depth(scan)
    chosen = choose_source(bare, bare.names, "auto")
    assert chosen.source.name == "computed" and "plane-sweep" in chosen.reason


def test_settings_that_a_source_ignores_are_said(scan, tmp_path, capsys):
    bare = without_depth(scan)
    given = StereoOptions(window=5, planes=64)
    assert set(choose_source(scan, scan.names, "auto", stereo=given).ignored) == {
        "stereo.window=5",
        "stereo.planes=64",
    }
    assert not choose_source(scan, scan.names, "auto", stereo=StereoOptions()).ignored
    assert not choose_source(bare, bare.names[:2], "auto", stereo=given).ignored
    words = f"--refine 0 --dry-run --context first:2 --targets range:3-4 --out {tmp_path / 'run'}"
    words += " --set stereo.window=5"
    assert main(["reconstruct", str(scan.root), *words.split()]) == 0
    assert capsys.readouterr().err.splitlines() == [
        "warning: stereo.window=5 changes nothing: no plane sweep computes depth here, but recorded"
    ]


def test_a_rough_source_is_a_small_sweep_without_posing(scan, tmp_path):
    bare = without_depth(scan, *range(1, 6))
    given = StereoOptions(window=5, align=True)
    chosen = choose_source(bare, bare.names, "auto", stereo=given)
    rough = rough_source(bare, chosen.source)
    assert isinstance(rough, PlaneSweepStereo)
    assert (rough.options.window, rough.options.align) == (5, False)
    assert rough.options.max_side <= 160
    assert rough.views == bare.names
    patch_match = rough_source(bare, ColmapPatchMatch(with_points(bare), bare.names))
    assert isinstance(patch_match, PlaneSweepStereo)
    assert patch_match.views == bare.names
    recorded = RecordedDepth()
    assert rough_source(scan, recorded) is recorded


def test_patch_match_comes_first_where_there_is_cuda(tmp_path, monkeypatch):
    workspace(tmp_path)
    scene = read_colmap(tmp_path)
    monkeypatch.setattr(choice, "has_patch_match", lambda: True)
    for asked in ("auto", "colmap"):
        assert isinstance(choose_source(scene, scene.names, asked).source, ColmapPatchMatch)
    # Without sparse points, it could not run.
    monkeypatch.setattr(choice, "_stereo", lambda *_: Computed())
    bare = replace(scene, points=None)
    assert choose_source(bare, bare.names, "auto").source.name == "computed"


def test_what_a_project_cannot_give_is_refused(scan, tmp_path):
    bare = without_depth(scan)
    workspace(tmp_path / "colmap")
    colmap = read_colmap(tmp_path / "colmap")
    for scene, count, asked, error, said in (
        (scan, 6, "colmap", OptionError, "rgbd"),
        (scan, 6, "guess", OptionError, "plane-sweep"),
        (scan, 6, "da3", CheckpointError, "needs weights"),
        (bare, 6, "sensor", ProjectError, "add depth maps"),
        (bare, 1, "auto", ProjectError, "at least 2 views"),
        (colmap, 6, "sensor", OptionError, "colmap project"),
        (colmap, 6, "colmap", ProjectError, r"no CUDA.*patch_match_stereo"),
    ):
        with pytest.raises(error, match=said):
            choose_source(scene, scene.names[:count], asked)


def test_patch_match_gets_a_workspace_of_the_given_views_alone(tmp_path, monkeypatch):
    """The workspace is a real one, that pycolmap reads; its maps come back as depth."""
    import pycolmap

    workspace(tmp_path / "project")
    scene = read_colmap(tmp_path / "project")
    given = scene.names[:3]
    seen: list[Path] = []

    def fake(folder, **_):
        folder = Path(folder)
        seen.append(folder)
        model = pycolmap.Reconstruction(folder / "sparse")
        assert {image.name for image in model.images.values()} == set(given)
        assert scene.points is not None
        assert len(model.points3D) == len(scene.points.positions)
        assert model.compute_mean_reprojection_error() < 0.5
        assert all(len(point.track.elements) == 3 for point in model.points3D.values())
        lines = (folder / "stereo" / "patch-match.cfg").read_text().split("\n")
        assert lines[:2] == [given[0], "__auto__, 20"]
        assert sorted(p.name for p in (folder / "images").rglob("*.*")) == sorted(
            Path(name).name for name in given
        )
        for view in scene.views[:2]:
            size = int(view.camera.height[0]), int(view.camera.width[0])
            write_depth_map(
                folder / "stereo/depth_maps" / f"{view.name}.geometric.bin", np.full(size, 3.0)
            )

    monkeypatch.setattr(pycolmap, "patch_match_stereo", fake)
    source = ColmapPatchMatch(scene, given)
    view = scene.views[0]
    for _ in range(2):
        found = source.depth(scene, view, view.load())
    assert len(seen) == 1
    assert not seen[0].exists()
    assert (found.depth == 3).all()
    assert found.source == "colmap-patch-match"
    assert not source.covers(scene.views[3])
    with pytest.raises(DegenerateError, match="gave no depth"):
        source.depth(scene, scene.views[2], scene.views[2].load())


def test_patch_match_that_fails_is_said(tmp_path, monkeypatch):
    import pycolmap

    def fails(*_, **__):
        raise RuntimeError("out of memory")

    workspace(tmp_path / "project")
    scene = read_colmap(tmp_path / "project")
    monkeypatch.setattr(pycolmap, "patch_match_stereo", fails)
    with pytest.raises(ProjectError, match="out of memory"):
        ColmapPatchMatch(scene, scene.names).depth(scene, scene.views[0], scene.views[0].load())
    with pytest.raises(ProjectError, match="sparse points"):
        ColmapPatchMatch(replace(scene, points=None), scene.names)


@pytest.mark.parametrize("factor", [1.0, 1.3])
def test_the_scale_of_depth_is_that_of_the_sparse_points(scan, factor):
    view = scan.views[0]
    frame = view.load()
    assert frame.depth is not None
    rng = np.random.default_rng(0)
    xy = np.stack([rng.uniform(1, 95, 60), rng.uniform(1, 71, 60)], axis=1)
    z = frame.depth[xy[:, 1].astype(int), xy[:, 0].astype(int)].astype(float)
    rays = np.column_stack([xy, np.ones(60)]) @ np.linalg.inv(view.camera.K[0]).T
    world = np.column_stack([rays * z[:, None], np.ones(60)]) @ view.camera.world_from_cam[0].T
    scene = with_points(scan, world[:, :3], xy)
    fit = scale_to_points(scene, view.name, frame.depth / np.float32(factor))
    assert fit is not None
    assert fit.scale == pytest.approx(factor, rel=1e-3)
    assert disagrees(fit) == (factor != 1)
    few = scale_to_points(scene, scan.names[1], frame.depth)
    assert few is not None
    assert not few.ok
    assert not disagrees(few)
    assert scale_to_points(scan, view.name, frame.depth) is None


SHOWN = (60, 80)
CELLS = np.random.default_rng(3).integers(40, 200, (64, 64, 3), dtype=np.uint8)


def camera_at(x: float = 0.0) -> Cameras:
    return camera(x, size=SHOWN[::-1], focal=80)


def slanted_wall(x: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A slanted wall of coloured squares from a camera at x: its picture and its depth."""
    row, column = np.indices(SHOWN) + 0.5
    ray = (column - 40) / 80
    # The plane z = 2 + 0.2 x in the world.
    depth = (2 + 0.2 * x) / (1 - 0.2 * ray)
    u, v = ray * depth + x, (row - 30) / 80 * depth
    rgb = CELLS[np.floor(8 * v).astype(int) % 64, np.floor(8 * u).astype(int) % 64]
    return rgb, depth.astype(np.float32)


@pytest.fixture
def memory() -> SpatialMemory:
    out = SpatialMemory(0.02)
    for x in (-0.2, 0.2):
        rgb, depth = slanted_wall(x)
        out.observe(rgb, depth, camera_at(x), round=0)
    return out


@pytest.mark.parametrize("gain", [1.0, 0.8, 1.2])
def test_a_view_between_two_is_explained_at_any_exposure(memory, gain):
    rgb, depth = slanted_wall()
    found = depth_from_memory(memory, camera_at(), (rgb * gain).astype(np.uint8), least=0.9)
    assert found is not None and found.source == "memory"
    known = found.depth > 0
    assert known.mean() > 0.95
    assert np.median(np.abs(found.depth[known] / depth[known] - 1)) < 0.003
    assert (found.confidence > 0).all() and (found.confidence <= 1).all()


@pytest.mark.parametrize("what", ["black", "noise", "mirrored", "checks"])
def test_a_dark_photograph_of_something_else_is_not_explained(what):
    """Over a memory without much contrast, which a dark picture is near to in absolute terms."""
    row, column = np.indices(SHOWN)
    smooth = np.repeat((100 + 1.5 * column).astype(np.uint8)[..., None], 3, -1)
    depth = np.full(SHOWN, 2, np.float32)
    known = SpatialMemory(0.02)
    known.observe(smooth, depth, camera_at(), round=0)
    pictures: dict[str, np.ndarray] = {
        "black": np.zeros_like(smooth),
        "noise": np.random.default_rng(0).integers(0, 50, smooth.shape),
        "mirrored": smooth[:, ::-1] // 3,
        "checks": np.where((row // 8 + column // 8) % 2, 80, 20)[..., None].repeat(3, -1),
    }
    rgb = pictures[what].astype(np.uint8)
    assert depth_from_memory(known, camera_at(), rgb, least=0.85) is None
    assert depth_from_memory(known, camera_at(), smooth // 3, least=0.85) is not None


def test_what_looks_different_is_not_explained(memory):
    rgb, _ = slanted_wall()
    rgb = rgb.copy()
    rgb[10:50, 30:60] = np.where(rgb[10:50, 30:60] > 120, 0, 255)
    assert depth_from_memory(memory, camera_at(), rgb, least=0.9) is None
    found = depth_from_memory(memory, camera_at(), rgb, least=0.5)
    assert found is not None
    assert (found.depth[14:46, 34:56] == 0).mean() > 0.9
    assert (found.depth[:, :26] > 0).mean() > 0.9


def test_a_view_of_elsewhere_is_not_explained(memory):
    rgb, _ = slanted_wall(1.0)
    assert depth_from_memory(memory, camera_at(1.0), rgb, least=0.9) is None
    assert depth_from_memory(SpatialMemory(0.02), camera_at(), rgb, least=0.1) is None


def test_what_was_generated_explains_nothing():
    memory = SpatialMemory(0.02)
    rgb, depth = slanted_wall()
    memory.observe(rgb, depth, camera_at(), round=1, generated=True)
    assert depth_from_memory(memory, camera_at(), rgb, least=0.1) is None


def test_the_motorcycle_pair_has_its_recorded_depth(tmp_path):
    write_motorcycle(tmp_path)
    scene = open_project(tmp_path)
    view = scene.views[0]
    frame = view.load()
    assert frame.depth is not None
    source = PlaneSweepStereo(scene, options=StereoOptions(), views=scene.names)
    found = source.depth(scene, view, frame).depth
    both = (found > 0) & (frame.depth > 0)
    error = np.abs(found[both] / frame.depth[both] - 1)
    assert both.sum() > 0.8 * (frame.depth > 0).sum()
    assert np.median(error) < 0.003 and (error > 0.1).mean() < 0.06
