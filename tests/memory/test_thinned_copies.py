"""Thinned copies against a plain count, and what far tiles cost."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from memory_scenes import camera, plane_view, random_points

from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory, TiledMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.store import tile_set
from gvtools.memory.store.tile import DOUBLINGS, thinned_copy
from gvtools.memory.store.tile_set import TileSet


@pytest.mark.parametrize("doublings", DOUBLINGS)
def test_each_segment_keeps_one_observation_a_cube(doublings):
    memory = SpatialMemory(0.02)
    for i in range(3):
        memory.fuse(random_points(np.random.default_rng(i), 800, name=f"{i}"), round=0)
    copy = thinned_copy(memory.whole, doublings)
    columns, segments = memory.columns, memory.segments
    assert copy.start[-1] == len(copy.rows.positions) < len(memory)
    for s in range(segments.count):
        first, length = segments.start[s], segments.length[s]
        cubes = defaultdict(list)
        for row in range(first, first + length):
            edge = 0.02 * 2.0 ** columns.level[row]
            voxel = np.floor(columns.positions[row].astype(float) * (1 / edge)).astype(int)
            cubes[tuple((voxel >> doublings).tolist())].append(row)
        rows = slice(copy.start[s], copy.start[s + 1])
        assert rows.stop - rows.start == len(cubes)
        for k, members in enumerate(cubes.values()):
            weight = columns.confidence[members].astype(float)
            mean = np.average(columns.positions[members], axis=0, weights=weight)
            np.testing.assert_allclose(copy.rows.positions[rows][k], mean, rtol=1e-5, atol=1e-6)
            spacing = np.average(columns.spacing[members], weights=weight)
            edge = 0.02 * 2.0 ** columns.level[members[0]] * 2**doublings
            assert copy.rows.spacing[rows][k] == pytest.approx(max(spacing, edge), rel=1e-5)
            assert copy.rows.confidence[rows][k] == columns.confidence[members].max()


def test_far_tiles_are_drawn_from_thinned_copies(tmp_path, monkeypatch):
    monkeypatch.setattr(tile_set, "SMALLEST", 1)
    memory = TiledMemory(0.01, options=MemoryOptions(budget="1MB"), scratch=tmp_path)
    source = camera(width=160, height=120, focal=150)
    color = np.zeros((120, 160, 3), np.uint8)
    color[..., 0] = np.linspace(50, 200, 160)
    for x in (-0.5, 0.0, 0.5):
        near = camera(width=160, height=120, focal=150, center=(x, 0, 0))
        memory.fuse(plane_view(near, 2.0, color=color), round=0)
    assert not memory.in_ram
    drawn = []
    gathered = TileSet.gather

    def counted(self, segments, chosen, **options):
        found = gathered(self, segments, chosen, **options)
        drawn.append(len(found.columns.positions))
        return found

    monkeypatch.setattr(TileSet, "gather", counted)
    far = camera(width=160, height=120, focal=150, center=(0, 0, -8))
    whole = memory.project(far)
    every, drawn[:] = sum(drawn), []
    thin = memory.project(far, options=SplatOptions(far_detail_px=1.0))
    assert sum(drawn) < every / 5
    both = whole.valid & thin.valid
    assert both.sum() > 0.9 * whole.valid.sum() > 100
    assert np.abs(whole.rgb - thin.rgb)[both].mean() < 0.02
    np.testing.assert_allclose(thin.depth[both], whole.depth[both], rtol=0.01)
    drawn[:] = []
    memory.project(source, options=SplatOptions(far_detail_px=1.0))
    close = memory.project(source)
    assert close.coverage > 0.9
