"""A memory in tiles does what one in RAM does, to the bit."""

from __future__ import annotations

import errno
import gc
import os

import numpy as np
import pytest
from memory_scenes import assert_equal_pictures, random_camera, random_points, saved_bytes

from gvtools.errors import MemoryFileError, OptionError, ProjectError
from gvtools.guidance import IMAGES
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory, TiledMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.store import array_file, tile_set
from gvtools.memory.store.observations import ATTRIBUTES
from gvtools.ply import read_ply

VOXEL, ORIGIN, VIEWS, BUDGET = 0.01, (1.0, 2.0, 3.0), 10, 1_000_000
CAMERAS = [random_camera(np.random.default_rng(i), name=f"{i}") for i in range(3)]


@pytest.fixture(autouse=True, scope="module")
def small_tiles():
    """As if the budget, a million bytes at least, were a third."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tile_set, "SMALLEST", 1)
        for name in ("IN_RAM", "CACHE", "LARGEST", "GATHERED"):
            patch.setattr(tile_set, name, getattr(tile_set, name) / 3)
        yield


def fuse_views(memory, views=range(VIEWS)):
    """Views of four rounds; from the second round on, every third is generated; one is a scan's."""
    reports = []
    for i in views:
        rng = np.random.default_rng(i)
        points = random_points(rng, 700, origin=ORIGIN, name=f"v{i}")
        generated = i >= 3 and i % 3 == 0
        reports.append(memory.fuse(points, round=i // 3, generated=generated, scanned=i == 2))
    return reports


def in_ram(views=range(VIEWS)):
    memory = SpatialMemory(VOXEL, origin=ORIGIN)
    return memory, fuse_views(memory, views)


def in_tiles(scratch, views=range(VIEWS), budget=BUDGET):
    options = MemoryOptions(budget=budget)
    memory = TiledMemory(VOXEL, origin=ORIGIN, options=options, scratch=scratch)
    return memory, fuse_views(memory, views)


@pytest.fixture(scope="module")
def expected():
    return in_ram()


@pytest.fixture(scope="module")
def tiled(tmp_path_factory, small_tiles):
    """Not to be changed."""
    return in_tiles(tmp_path_factory.mktemp("tiles"))


def assert_same(memory, expected, *, order=True):
    """Same observations, segments, agreements and pictures."""
    assert not memory.in_ram
    assert (len(memory), memory.voxels) == (len(expected), expected.voxels)
    whole = memory.overview(10**9)
    rows, other = (
        np.arange(len(m)) if order else np.lexsort(m.columns.positions.T) for m in (whole, expected)
    )
    for name in ATTRIBUTES:
        found, wanted = (getattr(m.columns, name) for m in (whole, expected))
        np.testing.assert_array_equal(found[rows], wanted[other], err_msg=name)
    np.testing.assert_array_equal(whole.own_confidence()[rows], expected.own_confidence()[other])
    for camera in CAMERAS:
        found, wanted = memory.project(camera), expected.project(camera)
        assert wanted.coverage > 0.5
        if order:
            assert_equal_pictures(found, wanted)
        for name in IMAGES:
            np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-5)


def test_observations_reports_and_pictures_are_those_of_a_memory_in_ram(tiled, expected):
    memory, reports = tiled
    assert reports == expected[1]
    assert len(list(memory.tiles)) > 4
    assert memory.tiles.resident <= tile_set.CACHE * BUDGET
    on_disk = [tile for _, tile in memory.tiles if tile.store is None]
    assert on_disk and all(tile.file.exists() for tile in on_disk)
    assert_same(memory, expected[0])
    assert memory.generated_count == expected[0].generated.sum() > 0
    assert memory.scanned_count == expected[0].scanned.sum() > 0
    assert f"({len(memory):,} observations" in repr(memory)


def test_it_stays_in_ram_while_it_fits(expected, tmp_path):
    memory, _ = in_tiles(tmp_path, budget=100_000_000)
    assert memory.in_ram
    assert saved_bytes(memory, tmp_path) == saved_bytes(expected[0], tmp_path)
    assert not list(tmp_path.glob("gvtools-tiles-*"))


@pytest.mark.parametrize(("backend", "gathered"), [("cpu", 1e-9), ("torch", tile_set.GATHERED)])
def test_pictures_in_parts_and_by_torch_are_the_same(
    tiled, expected, monkeypatch, backend, gathered
):
    monkeypatch.setattr(tile_set, "GATHERED", gathered)
    options = SplatOptions(backend=backend, device="cpu")
    assert_equal_pictures(
        *(m.project(CAMERAS[0], options=options) for m in (tiled[0], expected[0]))
    )


def test_tiles_out_of_view_are_not_read(tiled):
    memory = tiled[0]
    for number, _ in list(memory.tiles):
        memory.tiles.evict(number)
    away = random_camera(np.random.default_rng(0))
    pose = away.cam_from_world.copy()
    pose[0] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ pose[0]
    behind = type(away)(away.K, pose, away.width, away.height, away.names)
    assert memory.project(behind).coverage < 0.5
    read = [tile for _, tile in memory.tiles if tile.resident]
    assert len(read) < len(list(memory.tiles))


@pytest.mark.parametrize("round", [3, 1, 0])
def test_a_round_is_forgotten_as_in_ram(tmp_path, round):
    memory, _ = in_tiles(tmp_path)
    expected, _ = in_ram()
    assert memory.forget(round=round) == expected.forget(round=round) > 0
    assert_same(memory, expected)
    later = random_points(np.random.default_rng(99), 1000, origin=ORIGIN, name="later")
    assert memory.fuse(later, round=4) == expected.fuse(later, round=4)
    assert_same(memory, expected)


def test_a_view_none_of_whose_points_is_usable_changes_nothing(tmp_path):
    memory, _ = in_tiles(tmp_path)
    before = len(memory)
    none = random_points(np.random.default_rng(0), 9, origin=ORIGIN, name="none")
    none.positions[:] = np.nan
    report = memory.fuse(none, round=9)
    assert (report.added, len(memory), len(memory.views)) == (0, before, VIEWS + 1)


def test_compaction_joins_tiles_and_changes_nothing_else(tmp_path, monkeypatch):
    memory, _ = in_tiles(tmp_path)
    expected, _ = in_ram()
    for round in (3, 2, 1):
        memory.forget(round=round)
        expected.forget(round=round)
    before = len(list(memory.tiles))
    # As if tiles were much larger than these: all of a family is little.
    monkeypatch.setattr(tile_set, "LARGEST", 0.5)
    assert memory.compact() == before - len(list(memory.tiles)) > 0
    assert_same(memory, expected)
    later = random_points(np.random.default_rng(99), 1000, origin=ORIGIN, name="later")
    assert memory.fuse(later, round=4) == expected.fuse(later, round=4)
    assert_same(memory, expected)


def test_blocks_cut_by_tiles_change_the_order_alone(tmp_path):
    """Coarse content that comes into tiles smaller than its blocks."""
    memory, _ = in_tiles(tmp_path)
    expected, _ = in_ram()
    far = random_points(np.random.default_rng(5), 1500, origin=ORIGIN, name="far")
    far.spacing[:] = 1.3
    assert min(node[0] for node in memory.tiles.octree.leaves) < 4
    assert memory.fuse(far, round=4) == expected.fuse(far, round=4)
    assert_same(memory, expected, order=False)


def test_an_overview_thins_each_view(tiled):
    memory = tiled[0]
    thin = memory.overview(len(memory) // 2)
    assert 0 < len(thin) <= len(memory) // 2
    assert set(thin.rounds) == set(memory.rounds)
    np.testing.assert_allclose(
        thin.positions.mean(axis=0), memory.overview(10**9).positions.mean(axis=0), atol=0.2
    )
    assert np.array_equal(np.unique(thin.columns.view), np.arange(VIEWS))


def test_whole_columns_are_refused_with_what_to_do(tiled):
    for ask in (lambda m: m.positions, lambda m: m.cloud, lambda m: m.to("cpu"),
                lambda m: m.confidence):  # fmt: skip
        with pytest.raises(OptionError, match=r"memory\.overview\(MOST\)"):
            ask(tiled[0])
    with pytest.raises(OptionError, match="does not project a memory in tiles"):
        tiled[0].project(CAMERAS[0], options=SplatOptions(backend="nearest"))


def test_a_ply_of_tiles_holds_the_same_observations(tiled, expected, tmp_path):
    for observed in (False, True):
        tables = []
        for memory in (tiled[0], expected[0]):
            path = tmp_path / "m.ply"
            count, _ = export_memory_ply(memory, path, observed=observed)
            tables.append(np.sort(read_ply(path)))
            assert len(tables[-1]) == count
        np.testing.assert_array_equal(tables[0], tables[1])


def test_a_full_disk_loses_nothing(tmp_path, expected, monkeypatch):
    memory, reports = in_tiles(tmp_path, range(VIEWS - 1))

    def full(*args, **kwargs):
        raise ProjectError("no space") from OSError(errno.ENOSPC, "no space")

    with monkeypatch.context() as patch:
        patch.setattr("gvtools.memory.store.tile.write_arrays", full)
        with pytest.raises(ProjectError, match="no space"):
            for number, tile in list(memory.tiles):
                tile.dirty = True
                memory.tiles.load(number)
                memory.tiles.evict(number)
    reports += fuse_views(memory, [VIEWS - 1])
    assert reports == expected[1]
    assert_same(memory, expected[0])


def test_what_was_saved_is_read_back(tiled, expected, tmp_path):
    folder = tiled[0].save(tmp_path / "memory.npz")
    assert folder == tmp_path / "memory.tiles"
    for path in (tmp_path / "memory.npz", folder):
        assert_same(TiledMemory.load(path), expected[0])
    again = TiledMemory.load(folder, scratch=tmp_path / "other")
    later = random_points(np.random.default_rng(99), 1000, origin=ORIGIN, name="later")
    more, _ = in_ram()
    assert again.fuse(later, round=4) == more.fuse(later, round=4)
    assert_same(again, more)
    # Saved states are independent of what comes later.
    assert_same(TiledMemory.load(folder), expected[0])
    assert again.save(folder) == folder
    assert_same(TiledMemory.load(folder), more)
    names = {path.name for path in folder.glob("*.tile")}
    assert not again.in_ram and len(names) == len(list(again.tiles))
    assert {path.name for path in folder.iterdir()} == {*names, "memory.index"}


def test_a_memory_that_is_read_back_again_and_again_loses_no_tile(expected, tmp_path):
    """As in a run that is killed and goes on, again and again: names of files stay distinct."""
    memory, _ = in_tiles(tmp_path / "scratch", ())
    for i in range(VIEWS):
        fuse_views(memory, [i])
        saved = memory.save(tmp_path / "memory.npz")
        memory = TiledMemory.load(saved, budget=BUDGET, scratch=tmp_path / f"scratch_{i}")
    assert_same(memory, expected[0], order=False)


def test_a_file_of_a_memory_in_ram_is_read_into_tiles(expected, tmp_path):
    path = expected[0].save(tmp_path / "memory.npz")
    assert_same(TiledMemory.load(path, budget=BUDGET), expected[0])


def test_the_working_folder_goes_with_the_memory(tmp_path):
    scratch = tmp_path / "scratch"
    memory, _ = in_tiles(scratch)
    assert list(scratch.glob("*/*.tile"))
    del memory
    gc.collect()
    assert not scratch.exists()


@pytest.mark.parametrize("moment", range(0, 30, 6))
def test_a_kill_while_saving_leaves_the_state_before_or_after(tmp_path, moment):
    """A child saves a later state over an earlier one and dies at the n-th step on files."""
    memory, _ = in_tiles(tmp_path / "scratch", range(5))
    folder = memory.save(tmp_path / "memory.npz")
    before = len(memory)
    fuse_views(memory, [5])
    child = os.fork()
    if not child:
        steps = 0

        def counted(real):
            def call(*args, **kwargs):
                nonlocal steps
                if steps == moment:
                    os._exit(9)
                steps += 1
                return real(*args, **kwargs)

            return call

        for name in ("link", "rename", "replace", "unlink", "mkdir"):
            setattr(os, name, counted(getattr(os, name)))
        memory.save(folder)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    found = TiledMemory.load(folder)
    assert len(found) in (before, len(memory))
    if os.waitstatus_to_exitcode(status) == 0:
        assert len(found) == len(memory)
    assert len(found.overview(10**9).columns.positions) == len(found)
    # The next save ends what was left.
    memory.save(folder)
    assert len(TiledMemory.load(folder)) == len(memory)


@pytest.mark.parametrize("name", ["positions", "view", "segment_box", "thinned2_colors"])
def test_a_flipped_bit_is_named(tiled, tmp_path, name):
    folder = tiled[0].save(tmp_path / "memory.npz")
    path = max(folder.glob("*.tile"), key=lambda p: p.stat().st_size)
    data = bytearray(path.read_bytes())
    file = array_file.ArrayFile(path)
    data[file._data + file._table[name][2]] ^= 1
    path.unlink()
    path.write_bytes(data)
    with pytest.raises(MemoryFileError, match=rf"{path.name}.*array {name}.*checksum"):
        TiledMemory.load(folder).overview(1 if name.startswith("thinned") else 10**9)


@pytest.mark.parametrize("name", ["positions", "thinned2_spacing", "segment_box"])
def test_numbers_that_are_none_are_refused_in_spite_of_a_sound_checksum(tiled, tmp_path, name):
    folder = tiled[0].save(tmp_path / "memory.npz")
    path = max(folder.glob("*.tile"), key=lambda p: p.stat().st_size)
    file = array_file.ArrayFile(path)
    arrays = {key: file.array(key).copy() for key in file.names}
    arrays[name][0] = np.nan
    path.unlink()
    array_file.write_arrays(path, file.meta, arrays)
    # As one would who also changes what the index says of the tile.
    index = array_file.ArrayFile(folder / "memory.index")
    meta, others = index.meta, {key: index.array(key).copy() for key in index.names}
    for entry in meta["tiles"]:
        entry[2] = array_file.ArrayFile(folder / entry[1]).checksum
    (folder / "memory.index").unlink()
    array_file.write_arrays(folder / "memory.index", meta, others)
    with pytest.raises(MemoryFileError, match=r"do not fit together|not finite"):
        TiledMemory.load(folder).overview(1 if name.startswith("thinned") else 10**9)


@pytest.mark.parametrize("damage", ["cut", "header", "gone", "other", "index"])
def test_damaged_folders_are_refused(tiled, tmp_path, damage):
    folder = tiled[0].save(tmp_path / "memory.npz")
    path = folder / "memory.index" if damage == "index" else sorted(folder.glob("*.tile"))[0]
    data = path.read_bytes()
    path.unlink()
    if damage in ("cut", "index"):
        path.write_bytes(data[:-64])
    elif damage == "header":
        path.write_bytes(data[:40] + bytes([data[40] ^ 1]) + data[41:])
    elif damage == "other":
        path.write_bytes(sorted(folder.glob("*.tile"))[0].read_bytes())
    with pytest.raises(MemoryFileError, match=path.name):
        TiledMemory.load(folder)


@pytest.mark.parametrize(
    ("text", "count"),
    [("4GB", 4 * 10**9), ("1.5 GiB", 3 * 2**29), ("2000000", 2_000_000), ("400mb", 4 * 10**8)],
)
def test_a_budget_is_bytes_with_a_unit(text, count):
    assert MemoryOptions(budget=text).budget == count


@pytest.mark.parametrize("text", ["much", "4 GX", "-1GB", "1KB", "GB"])
def test_other_budgets_are_refused(text):
    with pytest.raises(OptionError, match=r"memory\.budget"):
        MemoryOptions(budget=text)


def test_a_memory_without_a_budget_is_none():
    with pytest.raises(OptionError, match=r"memory\.budget none"):
        TiledMemory(0.1)
