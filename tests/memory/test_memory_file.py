from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from memory_scenes import points, random_memory, saved_bytes

from gvtools.errors import MemoryFileError
from gvtools.memory import files
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from gvtools.memory.store.observations import LAYOUT


def _small() -> SpatialMemory:
    """Two views in two rounds, with a free-space grid, an agreement and generated content."""
    memory = SpatialMemory(0.5, origin=(1e6, 2, 3))
    near = np.array([(0, 0, 2), (1, 0, 2), (1, 1, 3)])
    grid = np.full((2, 2), 1.5, np.float32)

    def seen(where, **columns):
        return points(where + memory.origin, origin=memory.origin, free_depth=grid, **columns)

    memory.fuse(seen(near, colors=(1, 2, 3)), round=0)
    memory.fuse(seen(near[:1]), round=1)
    memory.fuse(seen(near + np.array((0, 0, 5))), round=1, generated=True)
    return memory


def _same(one: SpatialMemory, two: SpatialMemory, folder: Path) -> bool:
    return saved_bytes(one, folder) == saved_bytes(two, folder)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_loaded_is_what_was_saved(seed, tmp_path):
    memory = random_memory(seed, options=MemoryOptions(merge_angle_deg=7.5, weight_cap=9))
    memory.save(tmp_path / "memory.npz")
    loaded = SpatialMemory.load(tmp_path / "memory.npz")
    assert loaded.voxel == memory.voxel
    assert loaded.options == memory.options
    np.testing.assert_array_equal(loaded.origin, memory.origin)
    assert len(loaded) == len(memory)
    assert loaded.voxels == memory.voxels
    for name in LAYOUT:
        np.testing.assert_array_equal(
            getattr(loaded.columns, name), getattr(memory.columns, name), err_msg=name
        )
    for name in memory.segments.LAYOUT:
        one, two = (getattr(m.segments, name)[: m.segments.count] for m in (loaded, memory))
        np.testing.assert_array_equal(one, two, err_msg=name)
    for i in range(len(memory.views)):
        ours, theirs = loaded.views[i], memory.views[i]
        assert ours.camera.names == theirs.camera.names
        np.testing.assert_array_equal(ours.camera.K, theirs.camera.K)
        np.testing.assert_array_equal(ours.camera.cam_from_world, theirs.camera.cam_from_world)
        np.testing.assert_array_equal(ours.free_depth, theirs.free_depth)
        assert (ours.round, ours.generated) == (theirs.round, theirs.generated)
    assert _same(loaded, memory, tmp_path)


def test_an_empty_memory_survives(tmp_path):
    memory = SpatialMemory(0.1)
    memory.save(tmp_path / "memory.npz")
    loaded = SpatialMemory.load(tmp_path / "memory.npz")
    assert len(loaded) == 0
    assert _same(loaded, memory, tmp_path)


def _flipped(data: bytes, positions, rng):
    for at in positions:
        yield data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]


def _altered(kind: str, data: bytes, rng):
    if kind == "bits":
        # The directory at the end holds most of what is not covered by a checksum.
        directory = range(len(data) - 1500, len(data), 15)
        yield from _flipped(data, [*rng.choice(len(data), 120, replace=False), *directory], rng)
    elif kind == "blocks":
        for _ in range(80):
            at, length = int(rng.integers(len(data))), int(rng.integers(1, 64))
            block = rng.bytes(length) if rng.random() < 0.7 else bytes(length)
            yield (data[:at] + block + data[at + length :])[: len(data)]
    elif kind == "cut":
        for n in (*range(0, len(data), 197), *range(len(data) - 60, len(data))):
            yield data[:n]
    else:
        for more in (b"\0", b"\0" * 100, b"PK\5\6", rng.bytes(1000), data, data[-22:]):
            yield data + more
            yield more + data


@pytest.mark.parametrize(
    ("kind", "most"),
    [
        # Time stamps and the like.
        ("bits", 1 / 3),
        ("blocks", 1),
        ("cut", 0),
        ("extended", 1),
    ],
)
def test_an_altered_file_is_refused_or_exactly_the_memory(kind, most, tmp_path):
    original, path = saved_bytes(_small(), tmp_path), tmp_path / "altered.npz"
    loaded = []
    for data in _altered(kind, original, np.random.default_rng(0)):
        path.write_bytes(data)
        try:
            memory = SpatialMemory.load(path)
        except MemoryFileError as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error)
            loaded.append(False)
        else:
            assert saved_bytes(memory, tmp_path) == original
            loaded.append(True)
    assert np.mean(loaded) <= most


def _rewritten(path: Path, change) -> None:
    """Write the archive again with another header; its checksums are right."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = json.loads(members["header.json"])
    change(header)
    members["header.json"] = json.dumps(header).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda h: h.update(version=5), "version 5; this gvtools reads version 4"),
        (lambda h: h.update(version=3), "version 3; this gvtools reads version 4"),
        (lambda h: h.update(format="other"), "not a gvtools memory"),
        (lambda h: h["names"].append("x"), "do not fit together"),
        (lambda h: h.pop("voxel"), "do not fit together"),
        (lambda h: h["arrays"]["positions"].__setitem__(0, "<f8"), "positions is not what"),
        (lambda h: h["arrays"].pop("segment_box"), "segment_box|do not fit together"),
        (lambda h: h.update(voxel="-0x1p+0"), "positive length"),
    ],
)
def test_a_file_of_another_make_is_refused_by_name(change, complaint, tmp_path):
    path = tmp_path / "memory.npz"
    _small().save(path)
    _rewritten(path, change)
    with pytest.raises(MemoryFileError, match=complaint):
        SpatialMemory.load(path)


@pytest.mark.parametrize("kind", [np.int8, np.int64, np.float64])
def test_levels_of_another_kind_are_refused(kind, tmp_path, monkeypatch):
    arrays = files._arrays(memory := _small())
    arrays["level"] = arrays["level"].astype(kind)
    arrays["level"][0] = -1
    monkeypatch.setattr(files, "_arrays", lambda _: arrays)
    memory.save(tmp_path / "memory.npz")
    with pytest.raises(MemoryFileError, match="of a level that is not there"):
        SpatialMemory.load(tmp_path / "memory.npz")


def test_other_files_are_refused(tmp_path):
    with pytest.raises(MemoryFileError, match="no such memory file"):
        SpatialMemory.load(tmp_path / "absent.npz")
    with pytest.raises(MemoryFileError, match="no such memory file"):
        SpatialMemory.load(tmp_path)
    np.savez(tmp_path / "arrays.npz", a=np.zeros(3))
    with pytest.raises(MemoryFileError, match="damaged or truncated"):
        SpatialMemory.load(tmp_path / "arrays.npz")
