from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from memory_scenes import points, random_memory, saved_bytes

from gvtools.errors import GvError, MemoryFileError, ProjectError
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


def _survivors(changed, original: bytes, folder: Path) -> int:
    """Load altered files: each is refused, or is exactly the memory; returns how many load."""
    path = folder / "altered.npz"
    loaded = 0
    for name, data in changed:
        path.write_bytes(data)
        try:
            memory = SpatialMemory.load(path)
        except MemoryFileError as error:
            message = str(error)
            assert message.startswith(str(path)), (name, message)
            assert "\n" not in message, (name, message)
            continue
        assert saved_bytes(memory, folder) == original, name
        loaded += 1
    return loaded


def _flipped(data: bytes, positions, rng):
    for at in positions:
        altered = bytearray(data)
        altered[at] ^= 1 << int(rng.integers(8))
        yield f"byte {at}: {data[at]} -> {altered[at]}", bytes(altered)


def test_a_flipped_bit_is_refused_or_without_meaning(tmp_path):
    original = saved_bytes(_small(), tmp_path)
    rng = np.random.default_rng(0)
    # The directory at the end holds most of what is not covered by a checksum.
    directory = range(len(original) - 1500, len(original), 4)
    positions = [*rng.choice(len(original), 500, replace=False).tolist(), *directory]
    loaded = _survivors(_flipped(original, positions, rng), original, tmp_path)
    assert loaded < len(positions) / 3  # time stamps and the like


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_every_byte_flipped_is_refused_or_without_meaning(seed, tmp_path):
    original = saved_bytes(_small(), tmp_path)
    rng = np.random.default_rng(seed)
    _survivors(_flipped(original, range(len(original)), rng), original, tmp_path)


def test_bytes_of_any_value_and_blocks_of_zeros_are_refused_or_without_meaning(tmp_path):
    original = saved_bytes(_small(), tmp_path)
    rng = np.random.default_rng(1)
    changed = []
    for _ in range(200):
        altered = bytearray(original)
        at = int(rng.integers(len(original)))
        length = int(rng.integers(1, 64))
        altered[at : at + length] = rng.bytes(length) if rng.random() < 0.7 else bytes(length)
        changed.append((f"{length} bytes at {at}", bytes(altered[: len(original)])))
    _survivors(changed, original, tmp_path)


def test_a_truncated_file_is_refused(tmp_path):
    original = saved_bytes(_small(), tmp_path)
    lengths = [*range(0, len(original), 97), *range(len(original) - 60, len(original))]
    changed = [(f"first {n} bytes", original[:n]) for n in lengths]
    assert _survivors(changed, original, tmp_path) == 0


def test_an_extended_file_is_refused_or_the_same(tmp_path):
    original = saved_bytes(_small(), tmp_path)
    rng = np.random.default_rng(2)
    tails = [b"\0", b"\0" * 100, b"PK\5\6", rng.bytes(1000), original, original[-22:]]
    changed = [(f"{len(tail)} more bytes", original + tail) for tail in tails]
    changed += [(f"{len(tail)} bytes before", tail + original) for tail in tails]
    _survivors(changed, original, tmp_path)


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


def test_a_failed_write_leaves_the_earlier_file_whole(tmp_path, monkeypatch):
    path = tmp_path / "memory.npz"
    memory = _small()
    memory.save(path)
    before = path.read_bytes()

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gvtools.memory.files.np.save", full)
    with pytest.raises(ProjectError, match="No space left"):
        memory.save(path)
    assert issubclass(ProjectError, GvError)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["memory.npz"]
