from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from memory_scenes import camera, points, random_memory, saved_bytes

from gvtools.cameras import Cameras, rigid_poses
from gvtools.errors import MemoryFileError
from gvtools.memory import files
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.spatial_memory import MemoryOptions, SpatialMemory
from gvtools.memory.store.observations import LAYOUT
from gvtools.ply import read_ply, write_ply

COLUMNS = (
    "x", "y", "z", "red", "green", "blue", "confidence", "spacing", "round", "view", "generated",
    "scanned",
)  # fmt: skip
COLOR = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
XYZ = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]


@pytest.fixture
def exported(tmp_path):
    memory, path = random_memory(3), tmp_path / "memory.ply"
    assert export_memory_ply(memory, path) == (len(memory), 0.0)
    return memory, path


def test_plyfile_reads_what_the_memory_holds(exported):
    plyfile = pytest.importorskip("plyfile")
    memory, path = exported
    vertex = plyfile.PlyData.read(str(path))["vertex"].data
    ours = read_ply(path)
    assert ours.dtype.names == vertex.dtype.names == COLUMNS
    for name in COLUMNS:
        np.testing.assert_array_equal(vertex[name], ours[name], err_msg=name)
    n, view = len(memory), memory.columns.view[: len(memory)]
    where = np.stack([vertex[axis] for axis in "xyz"], 1)
    np.testing.assert_allclose(where, memory.positions, atol=1e-6)
    color = np.stack([vertex[name] for name in ("red", "green", "blue")], 1)
    np.testing.assert_array_equal(color, memory.columns.colors[:n])
    np.testing.assert_array_equal(vertex["confidence"], memory.confidence)
    np.testing.assert_array_equal(vertex["spacing"], memory.columns.spacing[:n])
    np.testing.assert_array_equal(vertex["round"], memory.views.round[view])
    np.testing.assert_array_equal(vertex["view"], view)
    np.testing.assert_array_equal(vertex["generated"], memory.generated)


@pytest.mark.parametrize(("far", "kind"), [(0.0, "f4"), (5e6, "f8")])
def test_far_origins_get_double_coordinates(far, kind, tmp_path):
    rng = np.random.default_rng(0)
    origin = np.full(3, far)
    where = origin + rng.uniform(-3, 3, (100, 3))
    memory = SpatialMemory(0.001, origin=origin)
    memory.fuse(points(where, source=camera(center=origin), origin=origin), round=0)
    export_memory_ply(memory, tmp_path / "far.ply")
    read = read_ply(tmp_path / "far.ply")
    assert read.dtype["x"].str[1:] == kind
    found = np.stack([read[axis] for axis in "xyz"], 1).astype(float)
    order, expected = np.lexsort(found.T), np.lexsort(where.T)
    assert abs(found[order] - where[expected]).max() < 1e-5


@pytest.mark.parametrize("most", [200, 50, 7, 1])
def test_thinning_keeps_the_most_confident_of_each_larger_voxel(most, tmp_path):
    memory = random_memory(3)
    assert len(memory) > 200
    written, edge = export_memory_ply(memory, tmp_path / "thin.ply", max_points=most)
    kept = read_ply(tmp_path / "thin.ply")
    assert len(kept) == written <= most
    assert edge >= memory.voxel
    positions = memory.columns.positions.astype(float)
    cells = np.floor((positions - positions.min(axis=0)) / edge)
    best: dict[tuple, float] = {}
    for cell, trust in zip(map(tuple, cells), memory.confidence, strict=True):
        best[cell] = max(best.get(cell, 0.0), float(trust))
    assert len(best) == written
    np.testing.assert_allclose(np.sort(kept["confidence"]), np.sort(list(best.values())))


def test_no_length_but_the_right_one_is_accepted(exported, tmp_path):
    _, path = exported
    data = path.read_bytes()
    bad = tmp_path / "bad.ply"
    for size in (*range(0, 400, 7), len(data) // 2, len(data) - 1):
        bad.write_bytes(data[:size])
        with pytest.raises(MemoryFileError, match=r"bad\.ply"):
            read_ply(bad)
    for tail in (b"\0", b"\n", data):
        bad.write_bytes(data + tail)
        with pytest.raises(MemoryFileError, match="truncated or damaged"):
            read_ply(bad)


def test_a_garbled_header_is_refused_or_reads_the_same_numbers(exported, tmp_path):
    """Any byte of the header replaced: renamed columns aside, nothing else may come out."""
    _, path = exported
    data, right = path.read_bytes(), read_ply(path)
    bad = tmp_path / "bad.ply"
    rng = np.random.default_rng(0)
    refused = 0
    end = data.index(b"end_header\n") + 11
    for at in range(end):
        altered = bytearray(data)
        altered[at] = rng.choice([c for c in range(32, 127) if c != data[at]])
        bad.write_bytes(bytes(altered))
        try:
            read = read_ply(bad)
        except MemoryFileError:
            refused += 1
            continue
        assert len(read) == len(right)
        for one, two in zip(read.dtype.names or (), COLUMNS, strict=True):
            if read.dtype[one] == right.dtype[two]:
                np.testing.assert_array_equal(read[one], right[two])
            else:
                assert read.dtype[one].itemsize == right.dtype[two].itemsize
    assert refused > end / 2


def _header(kind: str = "binary_little_endian", axes: str = "xyz", more: str = "") -> str:
    properties = "".join(f"property float {axis}\n" for axis in axes)
    return f"ply\nformat {kind} 1.0\nelement vertex 0\n{properties}{more}end_header\n"


@pytest.mark.parametrize(
    "header",
    [
        _header("ascii"),
        _header("binary_big_endian"),
        _header(axes="xy"),
        _header(more="element face 3\nproperty list uchar int vertex_indices\n"),
        "ply\nelement vertex -1\nend_header\n",
        "",
    ],
)
def test_other_kinds_of_ply_are_refused(header, tmp_path):
    (tmp_path / "other.ply").write_text(header)
    with pytest.raises(MemoryFileError, match=r"other\.ply"):
        read_ply(tmp_path / "other.ply")
    with pytest.raises(MemoryFileError, match="cannot be read"):
        read_ply(tmp_path / "absent.ply")


def wall(offset: float = 0.0) -> np.ndarray:
    """A grid of points 1 cm apart on the plane z = 2."""
    x, y = np.meshgrid(np.arange(-60, 61) * 0.01, np.arange(-60, 61) * 0.01)
    vertices = np.zeros(x.size, XYZ + COLOR)
    vertices["x"], vertices["y"], vertices["z"] = x.ravel() + offset, y.ravel(), 2.0
    vertices["red"], vertices["green"], vertices["blue"] = 200, 100, 50
    return vertices


@pytest.mark.parametrize("offset", [0.0, 4.0e6])
def test_a_wall_is_seen_where_it_stands(tmp_path, offset):
    path = tmp_path / "wall.ply"
    write_ply(path, wall(offset))
    memory = SpatialMemory.from_ply(path)
    assert memory.voxel == pytest.approx(0.01, rel=1e-3)
    pose = rigid_poses(np.eye(3), (-offset, 0, 0))
    seen = memory.project(Cameras.pinhole(48, 48, focal=100.0, cam_from_world=pose))
    assert seen.coverage == 1.0
    np.testing.assert_allclose(seen.depth, 2.0, atol=1e-5)
    np.testing.assert_allclose(seen.rgb[0, 20, 20] * 255, [200, 100, 50], atol=1e-3)


def test_what_is_no_coloured_cloud_is_refused(tmp_path):
    path = tmp_path / "cloud.ply"
    write_ply(path, np.zeros(5, XYZ))
    with pytest.raises(MemoryFileError, match="red"):
        SpatialMemory.from_ply(path)
    write_ply(path, np.zeros(5, XYZ + COLOR))
    with pytest.raises(MemoryFileError, match="distinct"):
        SpatialMemory.from_ply(path)
    write_ply(path, wall())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(MemoryFileError, match="truncated"):
        SpatialMemory.from_ply(path)


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


@pytest.mark.parametrize("seed", range(3))
def test_what_is_loaded_is_what_was_saved(seed, tmp_path):
    memory = random_memory(seed, options=MemoryOptions(merge_angle_deg=7.5, weight_cap=9))
    memory.save(tmp_path / "memory.npz")
    loaded = SpatialMemory.load(tmp_path / "memory.npz")
    assert loaded.options == memory.options
    assert loaded.voxels == memory.voxels
    for name in LAYOUT:
        np.testing.assert_array_equal(
            getattr(loaded.columns, name), getattr(memory.columns, name), err_msg=name
        )
    assert saved_bytes(loaded, tmp_path) == saved_bytes(memory, tmp_path)


def test_an_empty_memory_survives(tmp_path):
    memory = SpatialMemory(0.1)
    assert export_memory_ply(memory, tmp_path / "empty.ply") == (0, 0.0)
    assert len(read_ply(tmp_path / "empty.ply")) == 0
    memory.save(tmp_path / "memory.npz")
    loaded = SpatialMemory.load(tmp_path / "memory.npz")
    assert len(loaded) == 0
    assert saved_bytes(loaded, tmp_path) == saved_bytes(memory, tmp_path)


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


# Of flipped bits, those of time stamps and the like.
@pytest.mark.parametrize(
    ("kind", "most"), [("bits", 1 / 3), ("blocks", 1), ("cut", 0), ("extended", 1)]
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
