"""A memory's own frame: what is stored and shown goes with it, wherever the world lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from memory_scenes import camera, plane_view, points, random_points, saved_bytes
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras
from gvtools.errors import OptionError, ShapeError
from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.store.local_frame import LocalFrame

OPTIONS = MemoryOptions(observations_per_voxel=3, merge_angle_deg=8)


def _rounds(seed: int, rounds: int) -> list[list[tuple]]:
    """For each round, point sets and whether they are generated; places overlap."""
    rng = np.random.default_rng(seed)
    return [
        [
            (random_points(rng, 60, name=f"r{number}v{view}"), bool(number and view == 1))
            for view in range(3)
        ]
        for number in range(rounds)
    ]


def _fused(rounds, *, start=0, memory: SpatialMemory | None = None) -> SpatialMemory:
    memory = memory or SpatialMemory(0.4, options=OPTIONS)
    for number, views in enumerate(rounds, start):
        for fresh, generated in views:
            memory.fuse(fresh, round=number, generated=generated)
    return memory


@pytest.mark.parametrize("seed", range(3))
def test_forgetting_the_last_round_leaves_no_trace(seed, tmp_path):
    rounds = _rounds(seed, 3)
    before = saved_bytes(_fused(rounds[:2]), tmp_path)
    memory = _fused(rounds)
    added = len(memory)
    assert saved_bytes(memory, tmp_path) != before
    assert memory.agreements[2]
    removed = memory.forget(round=2)
    assert removed == added - len(memory) > 0
    assert saved_bytes(memory, tmp_path) == before
    # What comes after is that of a memory that never saw the round.
    again = _fused(rounds[2:], start=2, memory=memory)
    assert saved_bytes(again, tmp_path) == saved_bytes(_fused(rounds), tmp_path)


@pytest.mark.parametrize("forgotten", [0, 1])
def test_forgetting_an_earlier_round_keeps_what_later_ones_stored(forgotten, tmp_path):
    memory = _fused(_rounds(4, 3))
    n = len(memory)
    stays = memory.views.round[memory.columns.view[:n]] != forgotten
    columns = {
        name: getattr(memory.columns, name)[stays].copy()
        for name in ("positions", "colors", "spacing")
    }
    own = memory.own_confidence()[stays]
    assert memory.forget(round=forgotten) == n - stays.sum()
    for name, column in columns.items():
        np.testing.assert_array_equal(getattr(memory.columns, name), column)
    np.testing.assert_array_equal(memory.own_confidence(), own)
    assert forgotten not in memory.rounds
    # The confidence that other rounds added is what is left of the log.
    for log in memory.agreements.values():
        for rows, weights, _ in log:
            np.add.at(own, rows, weights)
    np.testing.assert_allclose(memory.confidence, np.minimum(own, 100), rtol=1e-6)
    assert (memory.confidence > memory.own_confidence()).any()
    runs, records = memory.segments, memory.columns
    run = np.repeat(np.arange(runs.count), runs.length[: runs.count])
    assert len(run) == len(memory)
    assert (records.positions >= runs.box[run, :3]).all()
    assert (records.positions <= runs.box[run, 3:6]).all()
    cells = np.floor(records.positions.astype(float) * (1.0 / memory.voxel))
    assert memory.voxels == len(np.unique(cells, axis=0))
    # All of it forgotten is an empty memory.
    for number in memory.rounds:
        memory.forget(round=number)
    assert saved_bytes(memory, tmp_path) == saved_bytes(
        SpatialMemory(0.4, options=OPTIONS), tmp_path
    )


def test_generated_points_do_not_enter_space_that_was_seen_to_be_free():
    source = camera(width=64, height=48, focal=60)
    memory = SpatialMemory(0.02)
    memory.fuse(plane_view(source, 4.0), round=0)
    made = points([(0, 0, 2), (0.1, 0, 3.8), (0.1, 0.1, 3.95), (0, 0, 5), (30, 0, 4)])
    report = memory.fuse(made, round=1, generated=True)
    assert report.rejected_free == 2
    assert report.added == 3
    # Observed points may: the surface may have been seen from elsewhere.
    assert memory.fuse(made, round=1).rejected_free == 0


def test_what_cannot_be_stored_is_counted():
    memory = SpatialMemory(0.001)
    bad = points(
        [(np.nan, 0, 1), (1e9, 0, 1), *[(0, 0, 1)] * 7],
        confidence=(1, 1, 0, -0.0, -1, np.nan, np.inf, 1, 1),
        spacing=(*[1] * 7, np.nan, 1),
    )
    report = memory.fuse(bad, round=0)
    assert (report.points, report.added, report.out_of_reach) == (9, 1, 8)
    assert report.rejected == 8


def test_points_of_another_origin_and_earlier_rounds_are_refused():
    memory = SpatialMemory(0.1, origin=(1, 2, 3))
    with pytest.raises(ShapeError, match="back-project with the memory's frame"):
        memory.fuse(points([(0, 0, 1)]), round=0)
    memory.fuse(points([(0, 0, 1)], origin=(1, 2, 3)), round=2)
    with pytest.raises(OptionError, match="rounds only go forward"):
        memory.fuse(points([(0, 0, 1)], origin=(1, 2, 3)), round=1)
    with pytest.raises(OptionError, match="round 1 is not in the memory"):
        memory.forget(round=1)


EDGE = r"positive length in scene units, 1e-25 to 1e\+25"
POINT = "three finite numbers"


@pytest.mark.parametrize(
    ("error", "said", "voxel", "frame"),
    [
        *((OptionError, EDGE, voxel, {}) for voxel in (0, -1, np.nan, np.inf, 9e-26, 2e25)),
        *((ShapeError, POINT, 1, {"origin": origin}) for origin in ((0, 0), (0, np.nan, 0))),
        *(
            (ShapeError, "rotation", 1, {"axes": axes})
            for axes in (np.eye(2), 2 * np.eye(3), np.diag([1, 1, -1.0]))
        ),
    ],
)
def test_a_grid_that_numbers_cannot_hold_is_refused_in_a_line(error, said, voxel, frame):
    with pytest.raises(error, match=said) as e:
        SpatialMemory(voxel, **frame)
    assert "\n" not in str(e.value)


def test_an_observation_takes_at_most_45_bytes():
    """Runs, voxels and views included, for a surface that several views saw."""
    memory = SpatialMemory(0.01)
    for x in (0, 0.3, 0.6):
        source = camera(width=200, height=150, focal=200, center=(x, 0, 0))
        memory.fuse(plane_view(source, 2.0), round=0)
    assert len(memory) > 60_000
    assert memory.nbytes / len(memory) <= 45
    assert f"{len(memory):,} observations (0 generated)" in repr(memory)


TURN = Rotation.from_rotvec([0.4, -0.9, 0.2]).as_matrix()
PLACE = np.array([3.0, -20.0, 7.0])


def world(turned: bool) -> LocalFrame:
    return LocalFrame.at(PLACE, TURN) if turned else LocalFrame.at()


def placed(cameras: Cameras, frame: LocalFrame) -> Cameras:
    """Cameras given in a frame, in the world."""
    local_from_cam = cameras.world_from_cam
    pose = local_from_cam.copy()
    pose[:, :3, :3] = frame.axes @ local_from_cam[:, :3, :3]
    pose[:, :3, 3] = frame.to_world(local_from_cam[:, :3, 3])
    return replace(cameras, cam_from_world=np.linalg.inv(pose).astype(np.float64))


def filled(frame: LocalFrame) -> SpatialMemory:
    """Random pictures and depths of three views, the last of them generated."""
    memory = SpatialMemory(0.05, origin=frame.origin, axes=frame.axes)
    rng = np.random.default_rng(0)
    for number in range(3):
        source = placed(
            camera(center=(0.2 * number, 0.1, -0.1 * number), rotation=(0, 0.1 * number, 0)), frame
        )
        shape = int(source.height[0]), int(source.width[0])
        rgb = rng.integers(0, 256, (*shape, 3), np.uint8)
        depth = rng.choice([2.0, 2.03, 3.1], shape).astype(np.float32)
        points = back_project(rgb, depth, source, frame=memory.frame)
        memory.fuse(points, round=number, generated=number == 2)
    return memory


def test_the_same_scene_in_another_world_is_the_same_memory():
    here, there = filled(world(False)), filled(world(True))
    assert len(here) == len(there) and here.voxels == there.voxels
    np.testing.assert_allclose(here.columns.positions, there.columns.positions, atol=2e-5)
    assert np.array_equal(here.columns.colors[: len(here)], there.columns.colors[: len(there)])
    np.testing.assert_allclose(world(True).to_world(here.positions), there.positions, atol=2e-5)
    # And not that of a grid along the world's axes.
    assert len(filled(LocalFrame.at(PLACE))) != len(here) or not np.allclose(
        filled(LocalFrame.at(PLACE)).positions, there.positions, atol=1e-3
    )


@pytest.mark.parametrize("backend", ["cpu", "torch", "nearest", "open3d"])
def test_it_shows_the_same_pictures(backend):
    options = SplatOptions(backend=backend, device="cpu")
    target = camera(center=(0.1, 0.15, 0.05), rotation=(0.02, 0.08, 0))
    one = filled(world(False)).project(target, options=options)
    two = filled(world(True)).project(placed(target, world(True)), options=options)
    same = one.valid == two.valid
    assert same.mean() > 0.995 and one.valid.mean() > 0.2
    apart = np.abs(one.rgb - two.rgb).max(-1)[same]
    assert (apart < 1e-3).mean() > 0.995


def test_a_turned_memory_is_saved(tmp_path):
    memory = filled(world(True))
    memory.save(tmp_path / "memory.npz")
    loaded = SpatialMemory.load(tmp_path / "memory.npz")
    assert loaded.frame.same_as(memory.frame)
    assert np.array_equal(loaded.positions, memory.positions)
    assert saved_bytes(loaded, tmp_path) == saved_bytes(memory, tmp_path)


def test_a_cameras_frame_is_the_cameras_with_an_exact_rotation():
    seen = placed(camera(), world(True))
    crooked = seen.cam_from_world.copy()
    crooked[0, :3, :3] += 1e-7
    found = LocalFrame.of_camera(replace(seen, cam_from_world=crooked))
    np.testing.assert_allclose(found.axes.T @ found.axes, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(found.axes, seen.world_from_cam[0, :3, :3], atol=1e-6)
    there = found.from_world(found.to_world([[1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(there, [[1, 2, 3]], atol=1e-12)


def test_what_two_parts_of_a_view_know_is_free_as_far_as_both_saw():
    """The nearer surface ends it; a cell that one part does not know is the other's."""
    memory = SpatialMemory(0.1)
    source = camera()
    rgb = np.zeros((24, 32, 3), np.uint8)
    for value, columns in ((3.0, np.s_[:24]), (2.0, np.s_[8:])):
        mask = np.zeros((24, 32), np.bool_)
        mask[:, columns] = True
        depth = np.full((24, 32), value, np.float32)
        memory.fuse(back_project(rgb, depth, source, mask=mask), round=0)
    assert len(memory.views) == 1
    assert memory.views[0].free_depth[0].tolist() == [3, 3, 2, 2, 2, 2, 2, 2]
