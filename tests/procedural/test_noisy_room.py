from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from gvtools.cameras import Cameras
from gvtools.errors import OptionError, ProjectError
from gvtools.procedural.noisy_room import (
    SensorView,
    jitter_poses,
    measured_depth,
    range_noise,
    write_noisy_room,
)
from gvtools.procedural.room_sample import write_room
from gvtools.procedural.sample_workspace import WrittenSample
from gvtools.scenes.inspection import inspect
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Scene
from gvtools.similarity import align_poses
from pipelines.cli import main

SIZE = {"views": 10, "width": 160, "height": 120}
CONTEXT = 4


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> WrittenSample:
    return write_noisy_room(tmp_path_factory.mktemp("noisy") / "seed0", seed=0, **SIZE)


@pytest.fixture(scope="module")
def scene(sample: WrittenSample) -> Scene:
    return open_project(sample.folder)


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return open_project(write_room(tmp_path_factory.mktemp("room") / "room", seed=0, **SIZE).folder)


def wall(z: float, *, albedo: float = 0.8, glossy: bool = False, size: int = 240) -> SensorView:
    shape = (size, size)
    camera = Cameras.pinhole(size, size, focal=400.0)
    return SensorView(
        np.full(shape, z, np.float32),
        np.full(shape, albedo, np.float32),
        np.full(shape, glossy),
        camera.rays(),
    )


@pytest.mark.parametrize("z", [0.8, 1.5, 2.5, 4.0])
def test_range_noise_grows_with_the_square_of_range(z: float) -> None:
    depth = measured_depth(wall(z), np.random.default_rng(0))
    known = depth[depth > 0]
    step = z * z / (580 * 0.075 * 8)  # of z where disparity moves by an eighth of a pixel
    expected = np.hypot(0.0015 + 0.0025 * (z - 0.4) ** 2, step / np.sqrt(12))
    assert known.std() == pytest.approx(expected, rel=0.08)
    assert known.mean() == pytest.approx(z, abs=0.2 * expected + 0.05 * step)


def test_noise_is_common_to_neighbours_and_comes_in_eighths_of_a_pixel() -> None:
    depth = measured_depth(wall(2.5), np.random.default_rng(0))[:, :220]
    error = depth - 2.5
    near, far = (
        np.corrcoef(error[:, step:].ravel(), error[:, :-step].ravel())[0, 1] for step in (1, 20)
    )
    assert 0.35 < near < 0.55 and abs(far) < 0.05
    eighths = 580 * 0.075 * 8 / depth[depth > 0]
    np.testing.assert_allclose(eighths, np.rint(eighths), atol=1e-3)


def test_dark_far_and_glossy_surfaces_have_holes() -> None:
    rng = np.random.default_rng(0)

    def share(**options: float) -> float:
        return float((measured_depth(wall(**options), rng)[:, :200] == 0).mean())  # type: ignore[arg-type]

    assert share(z=2.0) == 0
    assert share(z=2.0, albedo=0.005) > 0.9
    assert share(z=2.0, albedo=0.02) < 0.5 < share(z=4.0, albedo=0.02)
    assert 0.1 < share(z=2.0, glossy=True) < 1
    assert share(z=7.0) > 0.9


def test_edges_have_a_shadow_on_the_left_and_depth_between_front_and_back() -> None:
    surfaces = wall(3.0)
    surfaces.depth[:, 120:160] = 1.5
    depth = measured_depth(surfaces, np.random.default_rng(0))
    # Disparity of the front less that of the back, at this focal length.
    shadow = 400 * 0.075 * (1 / 1.5 - 1 / 3.0)
    lost = (depth == 0).mean(0)
    assert lost[:100].max() == 0
    assert lost[121 - int(shadow) : 119].min() == 1
    assert lost[165:220].max() == 0
    right = depth[:, 159:161]
    between = (right > 1.65) & (right < 2.7)
    assert 0.2 < between.mean() < 0.4


def test_context_is_noisy_by_the_stated_amounts(scene: Scene, twin: Scene) -> None:
    holes, scaled, exposure = [], [], []
    for view, true in zip(scene.views[:CONTEXT], twin.views[:CONTEXT], strict=True):
        frame, exact = view.load(), true.load()
        depth, truth = frame.depth, exact.depth
        assert depth is not None and truth is not None
        # A strip on the right has no depth.
        assert not depth[:, -round(0.04 * SIZE["width"]) :].any()
        exposure.append(frame.rgb.mean() / exact.rgb.mean())
        holes.append((depth == 0).mean())
        flat = maximum_filter(truth, 3) - minimum_filter(truth, 3) < 0.04 * truth
        use = flat & (depth > 0)
        scaled.append((depth - truth)[use] / range_noise(truth[use]))
    assert 0.1 < np.mean(holes) < 0.35
    spread = 1.4826 * np.median(np.abs(np.concatenate(scaled)))
    assert 1.0 < spread < 1.3  # rounding of disparity adds to the noise
    assert 0.001 < np.std(exposure) < 0.04
    assert np.abs(np.array(exposure) - 1).max() < 0.1


def test_targets_are_the_truth_at_the_true_poses(scene, twin, sample):
    assert scene.names == sample.context + sample.targets
    report = inspect(scene)
    assert report.ok and report.metric and report.kind == "rgbd"
    assert [finding.message for finding in report.findings if finding.level != "info"] == []
    np.testing.assert_allclose(scene.cameras.K, twin.cameras.K, rtol=1e-8)
    poses, true = scene.cameras.cam_from_world, twin.cameras.cam_from_world
    np.testing.assert_allclose(poses[CONTEXT:], true[CONTEXT:], atol=1e-9)
    assert np.abs(poses[:CONTEXT] - true[:CONTEXT]).max((1, 2)).min() > 1e-3
    np.testing.assert_allclose(align_poses(poses[:CONTEXT], true[:CONTEXT]), np.eye(4), atol=1e-9)
    for view, other in zip(scene.views[CONTEXT:], twin.views[CONTEXT:], strict=True):
        frame, exact = view.load(), other.load()
        assert frame.depth is not None and exact.depth is not None
        np.testing.assert_allclose(frame.depth, exact.depth, atol=6e-4)
        # Kernels that were just compiled and kernels from the cache round a few pixels otherwise.
        assert np.abs(frame.rgb.astype(int) - exact.rgb).max() <= 1


def test_pose_errors_have_the_stated_size_and_drift() -> None:
    poses = np.tile(np.eye(4), (4000, 1, 1))
    moved = jitter_poses(poses, np.random.default_rng(0))
    centers = -np.einsum("vji,vj->vi", moved[:, :3, :3], moved[:, :3, 3])
    assert np.sqrt((centers**2).sum(1).mean()) == pytest.approx(0.01, rel=0.05)
    cosine = (np.trace(moved[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.sqrt((degrees**2).mean()) == pytest.approx(0.5, rel=0.05)
    neighbours = np.corrcoef(centers[1:, 0], centers[:-1, 0])[0, 1]
    assert 0.3 < neighbours < 0.6
    assert abs(np.corrcoef(centers[30:, 0], centers[:-30, 0])[0, 1]) < 0.1


@pytest.mark.parametrize(("write", "files"), [(write_room, 2), (write_noisy_room, 3)])
def test_same_seed_same_bytes_and_others_are_refused(tmp_path, write, files):
    small = {"views": 4, "width": 64, "height": 48}
    first, again = (write(tmp_path / name, seed=0, **small).folder for name in ("first", "again"))
    mine, theirs = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (first, again)
    )
    assert mine == theirs and len(mine) >= files * 4 + 2
    times = [path.stat().st_mtime_ns for path in sorted(first.rglob("*"))]
    assert write(first, seed=0, **small).folder == first
    assert times == [path.stat().st_mtime_ns for path in sorted(first.rglob("*"))]
    with pytest.raises(ProjectError, match="another sample"):
        write(first, seed=1, **small)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "note.txt").touch()
    with pytest.raises(ProjectError, match="something other than a sample"):
        write(tmp_path / "mine", seed=0, **small)
    for bad in ({"seed": -1}, {"views": 3}, {"width": 8}):
        with pytest.raises(OptionError, match="expected a seed of 0 or more"):
            write(tmp_path / "none", **{**small, **bad})
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_demo_takes_the_sample_by_name(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert main(["demo", "--sample", "noisy-room", "--out", str(out), "--dry-run", "--quiet"]) == 0
    assert open_project(tmp_path / "run-sample").kind == "rgbd"
