"""Voxels as wide as the footprints of what they hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import camera, plane_view, points, random_memory, saved_bytes

from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from gvtools.memory.store.views import PointSet
from gvtools.memory.store.voxel_index import (
    EMPTY_KEY,
    MAX_VOXEL,
    VoxelLevels,
    voxel_keys,
)
from gvtools.memory.thinning import thin
from viz.viewer.colors import view_counts

single = np.float32


# Level and place of a voxel.
Cell = tuple[int, int, int, int]


@dataclass
class Observation:
    position: np.ndarray
    color: np.ndarray
    confidence: float
    spacing: float
    view: int
    agreement: float = 0.0


class ReferenceMemory:
    """The definitions of fusion, one point set after the other."""

    def __init__(self, voxel: float, options: MemoryOptions) -> None:
        self.voxel, self.options = voxel, options
        self.chains: dict[Cell, list[Observation]] = {}
        self.centers: list[np.ndarray] = []
        self.rounds: list[int] = []
        self.made: list[bool] = []

    def fuse(self, points: PointSet, *, round: int, generated: bool = False) -> dict[str, int]:
        """Free space is not looked at."""
        self.centers.append(points.frame.from_world(points.camera.centers)[0])
        self.rounds.append(round)
        self.made.append(generated)
        cells: dict[Cell, list[int]] = {}
        for i, p in enumerate(points.positions.astype(float)):
            ratio = self.options.voxels_per_footprint * float(points.spacing[i]) / self.voxel
            level = max(0, min(7, int(np.floor(np.log2(max(ratio, 1e-9) * (1 + 2**-10))))))
            cells.setdefault(self._cell(p, level), []).append(i)
        tally = {"added": 0, "merged": 0, "rejected_observed": 0, "voxels": 0, "agreed": 0}
        blocks: dict[Cell, list[Cell]] = {}
        for level, x, y, z in cells:
            blocks.setdefault((level, x >> 4, y >> 4, z >> 4), []).append((level, x, y, z))
        for cell in (cell for members in blocks.values() for cell in members):
            rows = cells[cell]
            w = points.confidence[rows].astype(float)
            fresh = Observation(
                w @ points.positions[rows].astype(float) / w.sum(),
                w @ points.colors[rows].astype(float) / w.sum(),
                w.max(),
                max(w @ points.spacing[rows].astype(float) / w.sum(), self.voxel * 2 ** cell[0]),
                len(self.centers) - 1,
            )
            self._take(self.chains.setdefault(cell, []), fresh, len(rows), tally)
            if not self.chains[cell]:
                del self.chains[cell]
        return tally

    def _cell(self, p: np.ndarray, level: int) -> Cell:
        x, y, z = np.floor(p * (1.0 / self.voxel) / 2**level).astype(int).tolist()
        return level, x, y, z

    def _take(self, chain: list[Observation], fresh: Observation, count: int, tally) -> None:
        generated, options = self.made[-1], self.options
        if generated and self._observed_at(fresh.position.astype(single)):
            tally["rejected_observed"] += count
            return
        rivals = [o for o in reversed(chain) if generated or not self.made[o.view]]
        if rivals:
            best = max(rivals, key=lambda o: self._likeness(o, fresh)[0])
            same = self._likeness(best, fresh)[1] >= np.cos(np.radians(options.merge_angle_deg))
            fine = fresh.spacing >= options.min_detail_ratio * best.spacing
            if len(rivals) >= options.observations_per_voxel or (same and fine):
                tally["merged"] += count
                if self.rounds[best.view] == self.rounds[-1]:
                    old = best.position
                    self._average(best, fresh)
                    if generated and self._observed_at(best.position):
                        best.position = old
                else:
                    best.agreement += fresh.confidence
                    tally["agreed"] += 1
                return
        fresh.color = np.floor(fresh.color + 0.5)
        fresh.position = fresh.position.astype(single)
        fresh.confidence = min(fresh.confidence, options.weight_cap)
        tally["voxels"] += not chain
        chain.append(fresh)
        tally["added"] += 1
        tally["merged"] += count - 1

    def _observed_at(self, p: np.ndarray) -> bool:
        """Whether a voxel of any level around a point holds observed content."""
        around = (self.chains.get(self._cell(p.astype(float), level), []) for level in range(8))
        return any(not self.made[o.view] for there in around for o in there)

    def _likeness(self, old: Observation, fresh: Observation) -> tuple[float, float]:
        a = self.centers[fresh.view] - fresh.position
        b = self.centers[old.view] - fresh.position
        cosine = float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))
        ratio = max(old.spacing / fresh.spacing, fresh.spacing / old.spacing)
        return cosine - 0.01 * (ratio - 1), cosine

    def _average(self, old: Observation, fresh: Observation) -> None:
        share = fresh.confidence / (fresh.confidence + old.confidence)
        old.position = (old.position + share * (fresh.position - old.position)).astype(single)
        old.color = np.floor(old.color + share * (fresh.color - old.color) + 0.5)
        old.spacing += share * (fresh.spacing - old.spacing)
        if fresh.confidence > old.confidence:
            old.view = fresh.view
        old.confidence = min(old.confidence + fresh.confidence, self.options.weight_cap)


def chains_of(memory: SpatialMemory) -> dict[Cell, list[Observation]]:
    """The same dictionary, read from the real memory's arrays."""
    chains: dict[Cell, list[Observation]] = {}
    records, own = memory.columns, memory.own_confidence()
    agreed = np.zeros(len(memory))
    for log in memory.agreements.values():
        for rows, weights, _ in log:
            agreed[rows] += weights
    for i, p in enumerate(records.positions):
        level = int(records.level[i])
        x, y, z = np.floor(p.astype(float) * (1.0 / memory.voxel) / 2**level).astype(int).tolist()
        chains.setdefault((level, x, y, z), []).append(
            Observation(
                p,
                records.colors[i].astype(float),
                float(own[i]),
                float(records.spacing[i]),
                int(records.view[i]),
                float(agreed[i]),
            )
        )
    return chains


ONE_EDGE = MemoryOptions(voxels_per_footprint=0.0)


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    views=st.integers(1, 12),
    capacity=st.integers(1, 4),
    degrees=st.sampled_from([1.0, 5.0, 20.0]),
    footprints=st.sampled_from([0.0, 0.5, 1.0, 3.0]),
)
def test_fusion_does_what_a_plain_dictionary_does(seed, views, capacity, degrees, footprints):
    rng = np.random.default_rng(seed)
    options = MemoryOptions(
        merge_angle_deg=degrees, observations_per_voxel=capacity, weight_cap=4.0,
        voxels_per_footprint=footprints,
    )  # fmt: skip
    memory, reference = SpatialMemory(0.1, options=options), ReferenceMemory(0.1, options)
    for view in range(views):
        source = camera(center=rng.normal(0, 0.3, 3))
        count = int(rng.integers(1, 80))
        # Crowded into few voxels.
        fresh = points(
            rng.normal((0, 0, 2), 0.15, (count, 3)), source=source,
            colors=rng.integers(0, 256, (count, 3)), confidence=rng.uniform(0.1, 3, count),
            spacing=rng.uniform(0.02, 0.4, count),
        )  # fmt: skip
        generated = bool(rng.random() < 0.3)
        report = memory.fuse(fresh, round=view // 3, generated=generated)
        expected = reference.fuse(fresh, round=view // 3, generated=generated)
        assert {name: getattr(report, name) for name in expected} == expected
        assert report.added + report.merged + report.rejected == report.points == len(fresh)
    found = chains_of(memory)
    assert found.keys() == reference.chains.keys()
    assert memory.voxels == len(found)
    for cell, chain in reference.chains.items():
        assert [o.view for o in found[cell]] == [o.view for o in chain]
        for one, two in zip(found[cell], chain, strict=True):
            np.testing.assert_allclose(one.position, two.position, atol=2e-6)
            np.testing.assert_allclose(one.color, two.color, atol=1)
            assert one.confidence == pytest.approx(two.confidence, rel=1e-5)
            assert one.spacing == pytest.approx(two.spacing, rel=1e-5)
            assert one.agreement == pytest.approx(two.agreement, rel=1e-5)


def test_keys_tell_voxels_apart_and_mark_what_is_out_of_reach():
    edge = 0.5
    where = np.array(
        [(0, 0, 0), (-1e-6, 0, 0), (0.49, 0.49, 0.49), (0.5, 0, 0), (MAX_VOXEL * edge, 0, 0),
         (0, -MAX_VOXEL * edge * 1.01, 0), (np.inf, 0, 0), (0, np.nan, 0)], np.float32,
    )  # fmt: skip
    keys, places = np.empty(8, np.int64), np.zeros(8, np.uint16)
    assert voxel_keys(where, np.zeros(8, np.uint8), 1 / edge, keys, places) == 4
    assert (keys[4:] == EMPTY_KEY).all()
    assert (keys[:4] != EMPTY_KEY).all()
    names = list(zip(keys[:4].tolist(), places[:4].tolist(), strict=True))
    assert names[0] == names[2]
    assert len(set(names)) == 3
    # Voxels of the next level are twice as wide, go twice as far and are others.
    above, there = np.empty(8, np.int64), np.zeros(8, np.uint16)
    assert voxel_keys(where, np.ones(8, np.uint8), 1 / edge, above, there) == 2
    assert above[0] == above[3] and there[0] == there[3]
    assert not set(above[:6].tolist()) & set(keys[:4].tolist())


PLACE = (0.3, 0.3, 10.3)


@pytest.mark.parametrize("world", [1.0, 0.1, 1 / 3, 7.0, 1e-6, 1e6])
def test_levels_double_with_the_footprint_in_any_unit(world):
    """Whole ratios of depths belong to one level, however the world is scaled."""
    levels = VoxelLevels(0.01 * world, 1.0)
    shares = np.array([0.1, 1, 1.9, 2, 3.9, 4, 8, 127, 128, 1e9, 1e30])
    spacing = (shares * 0.01 * world).astype(np.float32)
    assert levels.of(spacing).tolist() == [0, 0, 0, 1, 1, 2, 3, 6, 7, 7, 7]
    assert not VoxelLevels(0.01 * world).of(spacing).any()
    twice = VoxelLevels(0.01 * world, 2.0)
    assert twice.of(spacing).tolist() == [0, 1, 1, 2, 2, 3, 4, 7, 7, 7, 7]


def _walls(options: MemoryOptions) -> SpatialMemory:
    """A wall at 1 and one at 8, seen by cameras a little apart."""
    depth = np.full((48, 64), 8.0, np.float32)
    depth[:, :32] = 1.0
    memory = SpatialMemory(1 / 60, options=options)
    for number, x in enumerate(np.linspace(-0.1, 0.1, 6)):
        source = camera(width=64, height=48, focal=60, center=(x, 0.3 * x, 0), name=f"v{number}")
        memory.fuse(plane_view(source, depth, color=(200, 90, 30)), round=0)
    return memory


def test_a_far_wall_is_kept_once_and_seen_whole():
    one, levels = _walls(ONE_EDGE), _walls(MemoryOptions())
    far = [memory.columns.positions[:, 2] > 4 for memory in (one, levels)]
    assert far[1].sum() < far[0].sum() / 3
    assert set(levels.columns.level[: len(levels)][far[1]].tolist()) == {3}
    near = [m.columns.positions[~mask] for m, mask in zip((one, levels), far, strict=True)]
    np.testing.assert_array_equal(near[0], near[1])
    for view in (one, levels):
        seen = view.project(camera(width=64, height=48, focal=60))
        assert seen.valid[0, 2:-2, 40:-3].all()
        np.testing.assert_allclose(seen.depth[0, 2:-2, 40:-3], 8.0, rtol=1e-5)
        assert np.abs(seen.rgb[0, 2:-2, 40:-3] * 255 - (200, 90, 30)).max() < 0.6


@pytest.mark.parametrize(("known", "made"), [(0.1, 0.9), (0.9, 0.1), (0.9, 0.3), (0.3, 0.9)])
def test_observed_content_of_any_level_shuts_generated_content_out(known, made):
    memory = SpatialMemory(0.1)
    memory.fuse(points([PLACE], spacing=known), round=0)
    aside = camera(center=(4, 0, 0), name="aside")
    report = memory.fuse(points([PLACE], spacing=made, source=aside), round=1, generated=True)
    assert (report.rejected_observed, report.added) == (1, 0)
    # Generated content shuts nothing out, and observed content passes it by.
    other = SpatialMemory(0.1)
    other.fuse(points([PLACE], spacing=made), round=0, generated=True)
    assert other.fuse(points([PLACE], spacing=known), round=0).added == 1


def test_generated_content_does_not_get_there_by_merging_or_rounding():
    memory = SpatialMemory(1.0)
    memory.fuse(points([(1.5, 0.5, 0.5)], spacing=1.0, source=camera(center=(0, 0, -9))), round=0)
    for number, x in enumerate((0.5, 2.5)):
        made = points([(x, 0.5, 0.5)], spacing=4.0, source=camera(center=(0, 0, -9), name=f"{x}"))
        assert memory.fuse(made, round=1, generated=True).merged == number
    assert memory.columns.positions[:2, 0].tolist() == [1.5, 0.5] and memory.confidence[1] == 2
    # The mean of both rounds into the observed voxel.
    rounds = points([(1 - 2.0**-24, 4.5, 0.5), (1.0, 4.5, 0.5)], spacing=4.0)
    memory = SpatialMemory(1.0)
    memory.fuse(points([(1.5, 4.5, 0.5)], spacing=1.0), round=0)
    assert memory.fuse(rounds, round=1, generated=True).rejected_observed == 2


@pytest.mark.parametrize("seed", range(3))
def test_no_generated_observation_lies_where_something_was_observed(seed):
    rng = np.random.default_rng(seed)
    memory = SpatialMemory(0.25)
    for view in range(24):
        where = rng.uniform((-2, -2, 3), (2, 2, 5), (150, 3))
        source = camera(center=rng.normal(0, 0.3, 3), name=f"{view}")
        spacing = rng.uniform(0.1, 3 if view >= 6 else 0.6, 150)
        fresh = points(where, spacing=spacing, source=source)
        memory.fuse(fresh, round=view // 6, generated=view >= 6)
    count = len(memory)
    level = memory.columns.level[:count].astype(int)
    cell = np.floor(memory.columns.positions.astype(float) * 4.0).astype(int)
    made = memory.generated
    assert made.sum() > 100
    for height in range(8):
        seen = {tuple(row) for row in cell[~made & (level == height)] >> height}
        assert not seen & {tuple(row) for row in cell[made] >> height}


def test_pictures_of_a_memory_are_those_of_its_file(tmp_path):
    """Also of observations that merging has moved and widened since their run was boxed."""
    memory = SpatialMemory(0.5)
    source = camera(name="a")
    for view in range(40):
        rng = np.random.default_rng(view % 20)
        where = rng.uniform((-3, -3, 4), (3, 3, 30), (60, 3))
        spacing = 0.5 + 0.4 * (view >= 20)
        fresh = points(where, spacing=spacing, source=camera(center=(0.001 * view, 0, 0),
                       name=f"{view}"))  # fmt: skip
        memory.fuse(fresh, round=0)
    memory.save(tmp_path / "memory.npz")
    loaded = SpatialMemory.load(tmp_path / "memory.npz")
    live, stored = (m.segments.group_box[: m.segments.groups] for m in (memory, loaded))
    np.testing.assert_array_equal(live, stored)
    one, two = memory.project(source), loaded.project(source)
    np.testing.assert_array_equal(one.rgb, two.rgb)


@pytest.mark.parametrize("seed", range(4))
def test_forgetting_and_loading_bring_every_level_back(seed, tmp_path):
    memory = random_memory(seed, voxel=0.04)
    assert memory.columns.level[: len(memory)].max() >= 2
    before = saved_bytes(memory, tmp_path)
    last = memory.rounds[-1]
    rng = np.random.default_rng(seed)
    fresh = points(rng.uniform((-2, -1.5, 1), (2, 1.5, 5), (200, 3)) + memory.origin,
                   origin=memory.origin, spacing=rng.uniform(0.02, 0.4, 200))  # fmt: skip
    loaded = SpatialMemory.load(tmp_path / "saved.npz")
    reports = [one.fuse(fresh, round=last + 1) for one in (memory, loaded)]
    assert reports[0] == reports[1] and reports[0].added
    assert saved_bytes(memory, tmp_path) == saved_bytes(loaded, tmp_path)
    memory.forget(round=last + 1)
    assert saved_bytes(memory, tmp_path) == before
    memory.fuse(fresh, round=last + 1)
    assert saved_bytes(memory, tmp_path) == saved_bytes(loaded, tmp_path)


def test_a_voxel_of_any_level_is_one_point_and_one_place():
    memory = SpatialMemory(0.1)
    for x, name in ((0, "a"), (3, "b"), (6, "c")):
        # Apart by more than an edge, within one voxel of level 3; a fine one lies inside it.
        where = np.array([(0.1 + 0.2 * x / 6, 0.1, 10.1), (0.05, 0.05, 9.65)])
        source = camera(center=(x, 0, 0), name=name)
        memory.fuse(points(where, spacing=(0.9, 0.1), source=source), round=0)
    assert len(memory) == 6 and memory.voxels == 2
    assert len(thin(memory, None).rows) == 2
    assert view_counts(memory).tolist() == [3] * 6
