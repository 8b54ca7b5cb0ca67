"""Confidence from nothing to the largest float32, a million fusions, and views from far away."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from extreme_scenes import SIZE, finite
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import camera, plane_view, points, saved_bytes
from reference_splat import reference_project

from gvtools.errors import MemoryFileError, OptionError
from gvtools.memory.back_projection import back_project
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.splat.cpu import FAINTEST
from gvtools.ply import read_ply, write_ply

BACKENDS = ("cpu", "torch", "nearest")
LARGEST = float(np.finfo(np.float32).max)
MILLION = 1_000_000
COLOR = (0, 99, 200)


def _wall(confidence, **more) -> SpatialMemory:
    source = camera(**SIZE, focal=60)
    memory = SpatialMemory(0.02, **more)
    lifted = plane_view(source, 4.0, color=COLOR)
    trust = np.full(len(lifted), confidence, np.float32)
    memory.fuse(dataclasses.replace(lifted, confidence=trust), round=0)
    return memory


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("confidence", [1e-45, 1e-40, 1e-38, 1e-30, 1.0, 1e30, LARGEST])
def test_any_positive_confidence_gives_the_colour_and_the_depth(confidence, backend):
    seen = _wall(confidence).project(
        camera(**SIZE, focal=60), options=SplatOptions(backend=backend)
    )
    assert seen.valid.all()
    np.testing.assert_allclose(seen.depth, 4, rtol=1e-5)
    np.testing.assert_allclose(seen.rgb * 255, np.broadcast_to(COLOR, seen.rgb.shape), atol=1e-3)
    faintest = 0 if backend == "nearest" else FAINTEST
    known = np.float32(confidence)
    np.testing.assert_allclose(seen.confidence, np.clip(known, faintest, 100), rtol=1e-5)


@pytest.mark.parametrize("confidence", [0.0, -0.0, -1.0, np.nan, np.inf])
def test_no_confidence_is_no_point_and_is_counted(confidence):
    memory = SpatialMemory(0.1)
    report = memory.fuse(points([(0, 0, 2)] * 3, confidence=confidence), round=0)
    assert (report.added, report.out_of_reach, len(memory)) == (0, 3, 0)
    assert memory.project(camera()).coverage == 0


@pytest.mark.parametrize("column", ["confidence", "spacing"])
def test_a_point_cloud_without_a_usable_point_is_refused(column, tmp_path):
    """It gave a memory of nothing, and empty pictures."""
    memory = SpatialMemory(0.1)
    memory.fuse(points([(0, 0, 2), (1, 0, 2), (0, 1, 2)]), round=0)
    path = tmp_path / "cloud.ply"
    export_memory_ply(memory, path)
    vertices = read_ply(path)
    vertices[column] = 0
    write_ply(path, vertices)
    with pytest.raises(MemoryFileError, match="none of its 3 points has a positive"):
        SpatialMemory.from_ply(path)


@pytest.mark.parametrize("trust", [0.0, 1e-45, 1e-38, 1e30, LARGEST])
def test_the_confidence_of_a_source_is_kept_or_counted(trust):
    source = camera(**SIZE, focal=60)
    depth = np.full((SIZE["height"], SIZE["width"]), 4, np.float32)
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    lifted = back_project(rgb, depth, source, confidence=np.full_like(depth, trust))
    assert len(lifted) + lifted.dropped["no depth"] == depth.size
    assert (lifted.confidence > 0).all()
    assert np.isfinite(lifted.confidence).all()
    if trust > 1e-44:
        assert len(lifted) == depth.size


@settings(max_examples=30, deadline=None)
@given(powers=st.lists(st.floats(-44.8, 38.5), min_size=2, max_size=30), seed=st.integers(0, 999))
def test_mixed_confidences_average_as_in_float64(powers, seed):
    """Weights over eighty decades in one voxel."""
    rng = np.random.default_rng(seed)
    weight = (10 ** np.array(powers)).astype(np.float32).clip(None, LARGEST)
    count = len(weight)
    where = rng.uniform((0.1, 0.1, 2.1), (0.9, 0.9, 2.9), (count, 3)).astype(np.float32)
    color = rng.integers(0, 256, (count, 3))
    memory = SpatialMemory(1.0)
    memory.fuse(points(where, colors=color, confidence=weight), round=0)
    # Powers of two keep the sums of the oracle within float64, too.
    w = weight.astype(np.float64) / float(weight.max())
    np.testing.assert_allclose(memory.positions[0], w @ where / w.sum(), rtol=1e-6)
    assert np.abs(memory.columns.colors[0] - w @ color / w.sum()).max() <= 0.5 + 1e-6
    assert memory.confidence[0] == min(weight.max(), np.float32(100))


def test_huge_confidences_saturate_within_and_across_rounds(tmp_path):
    memory = SpatialMemory(1.0)
    place = [(0.5, 0.5, 2.5)]
    for round_ in (0, 0, 1, 1, 2):
        memory.fuse(points(place, confidence=LARGEST, colors=COLOR), round=round_)
    assert memory.confidence.tolist() == [100]
    np.testing.assert_array_equal(memory.columns.colors[0], COLOR)
    seen = memory.project(camera())
    assert finite(seen)
    np.testing.assert_allclose(seen.confidence[seen.valid], 100, rtol=1e-5)
    memory.save(tmp_path / "m.npz")
    loaded = SpatialMemory.load(tmp_path / "m.npz")
    assert saved_bytes(loaded, tmp_path) == saved_bytes(memory, tmp_path)
    for round_ in (2, 1):
        memory.forget(round=round_)
    assert np.isfinite(memory.confidence).all()


@pytest.mark.parametrize("cap", [0.0, 1e-21, 1e21, np.inf, np.nan])
def test_caps_that_a_picture_cannot_hold_are_refused(cap):
    with pytest.raises(OptionError, match=r"memory\.weight_cap .*; expected at least 1e-20"):
        MemoryOptions(weight_cap=cap)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("cap", [1e-20, 1e20])
def test_pictures_are_finite_at_either_end_of_the_cap(cap, backend):
    memory = _wall(LARGEST, options=MemoryOptions(weight_cap=cap))
    seen = memory.project(camera(**SIZE, focal=60), options=SplatOptions(backend=backend))
    assert finite(seen)
    np.testing.assert_allclose(seen.confidence, cap, rtol=1e-5)
    np.testing.assert_allclose(seen.depth, 4, rtol=1e-5)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("depths", [1.0, 3.3, 3.5, 4.0, 20.0])
def test_what_only_a_far_view_saw_is_neither_lost_nor_nan(depths, backend):
    """exp(-proximity x distance) leaves float32 some four typical depths away."""
    half = np.full((SIZE["height"], SIZE["width"]), 4, np.float32)
    half[:, SIZE["width"] // 2 :] = 0
    near = camera(**SIZE, focal=60, center=(0.05, 0, 0))
    far = camera(**SIZE, focal=60, center=(0, 0, -4 * depths))
    memory = SpatialMemory(0.02)
    memory.fuse(plane_view(near, half), round=0)
    memory.fuse(plane_view(far, 4 + 4 * depths, color=COLOR), round=0)
    target = camera(**SIZE, focal=60)
    seen = memory.project(target, options=SplatOptions(backend=backend))
    reference = reference_project(memory, target)
    assert finite(seen)
    np.testing.assert_array_equal(seen.valid, reference.valid)
    np.testing.assert_allclose(seen.rgb, reference.rgb, atol=1e-5)
    np.testing.assert_allclose(seen.depth, reference.depth, rtol=1e-5)
    trust = np.where(seen.valid, np.maximum(reference.confidence, FAINTEST), 0)
    np.testing.assert_allclose(seen.confidence, trust, rtol=1e-4)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_an_occluder_that_only_a_far_view_saw_is_let_through(backend):
    """Its weight beside the nearest view's is below every float32."""
    near = camera(**SIZE, focal=60, center=(0.02, 0, 0))
    witness = camera(**SIZE, focal=60, center=(0, 0, -40.0), name="witness")
    wall = dataclasses.replace(plane_view(near, 4.0, color=(0, 0, 255)), free_depth=None)
    grid = np.linspace(-0.3, 0.3, 40)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    where = np.stack([x, y, np.full(x.size, 2.0)], 1)
    memory = SpatialMemory(0.02)
    memory.fuse(wall, round=0)
    memory.fuse(points(where, source=witness, colors=(255, 0, 0), spacing=0.03), round=0)
    target = camera(**SIZE, focal=60)
    options = SplatOptions(nearest_views=1, backend=backend)
    seen = memory.project(target, options=options)
    thing = (abs(2 * target.rays()[..., :2]) < 0.27).all(-1)
    assert (seen.rgb[0, ..., 0] > 0.9)[thing].all()
    np.testing.assert_allclose(seen.depth[0][thing], 2, rtol=1e-5)


def test_a_million_points_of_one_view_in_one_voxel():
    """Summed in float64: the mean is that of numpy, and equal points stay what they are."""
    rng = np.random.default_rng(0)
    where = rng.uniform((0.1, 0.1, 2.1), (0.9, 0.9, 2.9), (MILLION, 3)).astype(np.float32)
    color = rng.integers(0, 256, (MILLION, 3)).astype(np.uint8)
    memory = SpatialMemory(1.0)
    report = memory.fuse(points(where, colors=color, confidence=0.3), round=0)
    assert (report.added, report.merged) == (1, MILLION - 1)
    np.testing.assert_allclose(memory.positions[0], where.mean(0, dtype=np.float64), rtol=6e-8)
    np.testing.assert_array_equal(memory.columns.colors[0], np.rint(color.mean(0)))
    assert memory.confidence[0] == np.float32(0.3)
    same = SpatialMemory(1.0)
    place = np.array((0.1, 0.7, 2.3), np.float32)
    same.fuse(points(np.tile(place, (MILLION, 1)), colors=COLOR, confidence=0.3), round=0)
    np.testing.assert_array_equal(same.columns.positions[0], place)
    np.testing.assert_array_equal(same.columns.colors[0], COLOR)


@pytest.mark.parametrize("own", [1e-30, 0.3, LARGEST])
def test_hundreds_of_equal_fusions_drift_nowhere(own):
    memory, place = SpatialMemory(1.0), np.array((0.1, 0.7, 2.3), np.float32)
    for _ in range(400):
        memory.fuse(points(place, colors=COLOR, confidence=own), round=0)
    np.testing.assert_array_equal(memory.columns.positions, [place])
    np.testing.assert_array_equal(memory.columns.colors, [COLOR])
    assert memory.confidence[0] == pytest.approx(min(400 * own, 100.0), rel=0.01)


def test_hundreds_of_noisy_fusions_stay_with_the_mean():
    """The last hundred confidences' worth counts: a running mean of as many views."""
    rng = np.random.default_rng(1)
    memory = SpatialMemory(1.0)
    memory.fuse(points((0.2, 0.2, 2.2), colors=(0, 0, 255), confidence=1.0), round=0)
    for _ in range(600):
        where = rng.uniform((0.1, 0.1, 2.1), (0.9, 0.9, 2.9))
        color = rng.integers(100, 200, 3)
        memory.fuse(points(where, colors=color, confidence=1.0), round=0)
    bound = 5 * 0.8 / np.sqrt(12) / np.sqrt(200)
    assert np.abs(memory.positions[0] - (0.5, 0.5, 2.5)).max() < bound
    # Besides, a stored colour is a whole number.
    color = memory.columns.colors[0].astype(float)
    assert np.abs(color - 149.5).max() < 5 * 29 / np.sqrt(200) + 11


def test_many_agreements_of_later_rounds_add_up():
    memory = SpatialMemory(1.0)
    memory.fuse(points([(0.5, 0.5, 2.5)], confidence=1e-4), round=0)
    row = np.zeros(1, np.int32)
    for _ in range(10_000):
        memory.whole.agree(row, np.full(1, 1e-2, np.float32), round=1)
    assert memory.confidence[0] == pytest.approx(100, rel=0.01)
    memory.whole.agree(row, np.full(1, LARGEST, np.float32), round=1)
    assert memory.confidence[0] == 100
