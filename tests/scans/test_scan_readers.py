from __future__ import annotations

import numpy as np
import pytest
from memory_scenes import camera, points
from scan_files import FAR, surface, write_e57, write_las
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from gvtools.errors import GvError, MemoryFileError, OptionError
from gvtools.glb import pack_glb
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.ply import write_ply
from gvtools.scans.read import open_scan, read_scan
from gvtools.scans.tables import unpack_lzf


def same(path, positions, colors, *, atol=1e-6):
    """Whether a file is read as these points, in their order."""
    scan = read_scan(path)
    np.testing.assert_allclose(scan.positions + scan.origin, positions, atol=atol)
    if colors is not None:
        np.testing.assert_array_equal(scan.colors, colors)
        assert scan.colored_by == "colour"
    assert scan.count == len(positions)
    return scan


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_of_every_encoding_with_faces_behind_the_points(tmp_path, text, order):
    plyfile = pytest.importorskip("plyfile")
    positions, colors = surface(500)
    positions = positions + FAR
    vertex = np.zeros(500, [("x", "f8"), ("nx", "f4"), ("y", "f8"), ("z", "f8"), ("red", "u1"),
                            ("green", "u1"), ("blue", "u1")])  # fmt: skip
    for k, (axis, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertex[axis], vertex[color] = positions[:, k], colors[:, k]
    faces = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "O")])
    elements = [plyfile.PlyElement.describe(vertex, "vertex")]
    elements.append(plyfile.PlyElement.describe(faces, "face"))
    path = tmp_path / "scan.ply"
    plyfile.PlyData(elements, text=text, byte_order=order).write(str(path))
    same(path, positions, colors)


@pytest.mark.parametrize("options", [{"write_ascii": True}, {}, {"compressed": True}])
def test_pcd_of_every_encoding(tmp_path, options):
    o3d = pytest.importorskip("open3d")
    positions, colors = surface(500)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(positions.astype(np.float32)))
    cloud.point.colors = o3d.core.Tensor(colors)
    path = tmp_path / "scan.pcd"
    assert o3d.t.io.write_point_cloud(str(path), cloud, **options)
    same(path, positions, colors, atol=1e-5)


def test_pcd_keeps_double_coordinates_and_colours_packed_as_float(tmp_path):
    positions, colors = surface(50)
    table = np.zeros(50, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("gap", "u1", 4), ("rgb", "f4")])
    for k, axis in enumerate("xyz"):
        table[axis] = positions[:, k] + FAR[k]
    packed = colors.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    table["rgb"] = packed.astype(np.uint32).view(np.float32)
    lines = ["# .PCD v0.7", "VERSION 0.7", "FIELDS x y z _ normal rgb", "SIZE 8 8 8 1 4 4",
             "TYPE F F F U F F", "COUNT 1 1 1 4 0 1", "WIDTH 25", "HEIGHT 2",
             "VIEWPOINT 0 0 0 1 0 0 0", "POINTS 50", "DATA binary", ""]  # fmt: skip
    path = tmp_path / "scan.pcd"
    path.write_bytes("\n".join(lines).encode() + table.tobytes())
    same(path, positions + FAR, colors)


@pytest.mark.parametrize(("suffix", "bits"), [(".las", 8), (".laz", 16)])
def test_las_with_colours_of_8_and_16_bits_keeps_far_coordinates(tmp_path, suffix, bits):
    positions, colors = surface(500)
    path = write_las(tmp_path / f"scan{suffix}", positions + FAR, colors, bits=bits)
    scan = same(path, positions + FAR, colors, atol=6e-5)
    assert np.abs(scan.positions).max() < 10


def test_las_without_colour_is_grey_by_intensity_and_loses_noise(tmp_path):
    positions, _ = surface(400)
    kinds = np.where(np.arange(400) < 10, 7, 2)
    withheld = np.arange(400) >= 390
    path = write_las(
        tmp_path / "scan.las", positions, None, intensity=np.arange(400) * 10,
        classification=kinds, withheld=withheld,
    )  # fmt: skip
    scan = read_scan(path)
    assert (len(scan), scan.colored_by) == (380, "intensity")
    assert scan.dropped == {"withheld or noise": 20}
    assert (np.diff(scan.colors[:, 0].astype(int)) >= 0).all()
    assert scan.colors[0, 0] == 0 and scan.colors[-1, 0] == 255


def test_what_a_completer_made_is_no_scan(tmp_path):
    memory = SpatialMemory(0.1)
    memory.fuse(points(surface(50)[0], source=camera()), round=0)
    memory.fuse(points(surface(50)[0] + 20, source=camera(name="b")), round=1, generated=True)
    export_memory_ply(memory, tmp_path / "memory.ply")
    scan = read_scan(tmp_path / "memory.ply")
    assert scan.dropped == {"generated": int(memory.generated.sum())}
    assert len(scan) == int((~memory.generated).sum())


def test_e57_of_several_scans_cartesian_and_spherical_with_their_poses(tmp_path):
    pytest.importorskip("pye57")
    positions, colors = surface(600)
    turn = Rotation.from_euler("zyx", [0.7, 0.2, -0.1])
    place = FAR + np.array([1, 2, 1])
    own = turn.inv().apply(positions[:300] + FAR - place)
    first = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), own.T, strict=True))
    rgb = zip(("colorRed", "colorGreen", "colorBlue"), colors[:300].T, strict=True)
    first |= {name: values.astype(np.int64) * 257 for name, values in rgb}
    first["cartesianInvalidState"] = (np.arange(300) < 7) * 2
    first["pose"] = (np.roll(turn.as_quat(), 1), place)
    own = positions[300:] - [0.5, 0.5, 1.5]
    ranges = np.linalg.norm(own, axis=1)
    second = {
        "sphericalRange": ranges,
        "sphericalAzimuth": np.arctan2(own[:, 1], own[:, 0]),
        "sphericalElevation": np.arcsin(own[:, 2] / ranges),
        "intensity": np.arange(300.0),
        "pose": ([1, 0, 0, 0], FAR + np.array([0.5, 0.5, 1.5])),
    }
    path = write_e57(tmp_path / "scan.e57", [first, second])
    scan = read_scan(path)
    assert scan.dropped == {"invalid": 7}
    np.testing.assert_allclose(scan.positions + scan.origin, (positions + FAR)[7:], atol=1e-7)
    np.testing.assert_array_equal(scan.colors[:293], colors[7:300])
    # The second station has intensity alone: it is grey.
    assert (np.ptp(scan.colors[293:], axis=1) == 0).all() and np.ptp(scan.colors[293:, 0]) == 255
    np.testing.assert_array_equal(scan.station, [0] * 293 + [1] * 300)
    assert [station.name for station in scan.stations] == ["station 0", "station 1"]
    center = scan.stations[1].center
    assert center is not None
    np.testing.assert_allclose(center, FAR + np.array([0.5, 0.5, 1.5]))


def test_more_points_than_are_kept_are_thinned_evenly(tmp_path):
    positions, colors = surface(20_000)
    path = write_las(tmp_path / "scan.las", positions, colors)
    scan = read_scan(path, most=3000)
    assert 1000 < len(scan) <= 3000 and scan.dropped == {"thinned out": 20_000 - len(scan)}
    # Every part of the surface keeps points.
    away, _ = KDTree(scan.positions + scan.origin).query(positions)
    assert away.max() < 0.2


def patched(path, first, data):
    whole = bytearray(path.read_bytes())
    whole[first : first + len(data)] = data
    path.write_bytes(whole)
    return path


def refused(path):
    """The one line by which a file is refused."""
    with pytest.raises(GvError) as found:
        read_scan(path)
    message = str(found.value)
    assert str(path) in message and "\n" not in message
    return message


def test_a_count_beyond_the_file_is_refused_before_anything_is_allocated(tmp_path):
    positions, colors = surface(300)
    for suffix in (".las", ".laz"):
        path = write_las(tmp_path / f"scan{suffix}", positions, colors)
        # Number of points: the last header field before those of returns, 64 bits in LAS 1.4.
        patched(path, 247, (1 << 60).to_bytes(8, "little"))
        assert "truncated or damaged" in refused(path)
    ply = tmp_path / "scan.ply"
    for kind in ("ascii", "binary_little_endian"):
        lines = ["ply", f"format {kind} 1.0", "element vertex 999999999999"]
        lines += [f"property float {axis}" for axis in "xyz"]
        ply.write_bytes(("\n".join([*lines, "end_header", "1 2 3", "4 5 6", ""])).encode())
        assert "its header says 999999999999 points" in refused(ply)
    pcd = tmp_path / "scan.pcd"
    for kind in ("ascii", "binary", "binary_compressed"):
        lines = ["FIELDS x y z", "SIZE 4 4 4", "TYPE F F F", "WIDTH 999999999", "HEIGHT 1",
                 "POINTS 999999999", f"DATA {kind}", ""]  # fmt: skip
        pcd.write_bytes("\n".join(lines).encode() + b"1 2 3 4 5 6 7 8 9")
        refused(pcd)


@pytest.mark.parametrize(
    "packed",
    [b"\x05ab", b"\x20\x00", b"\x00a\x20\x01", b"\x00a\x20", b"\x00a\xe0", b"\x00a\xe0\xff",
     b"\x1f" + bytes(32)],
)  # fmt: skip
def test_damaged_lzf_is_refused(packed):
    assert unpack_lzf(np.frombuffer(packed, np.uint8), np.zeros(31, np.uint8)) == -1


def test_lzf_copies_reach_far_back():
    literal = bytes(range(32))
    # 264 bytes at once, from 32 and from 8192 bytes back.
    near, far, window = b"\xe0\xff\x1f", b"\xff\xff\xff", 1 << 13
    expected = bytearray(literal)
    tokens = [b"\x1f" + literal]
    rng = np.random.default_rng(0)
    while len(expected) < 1 << 18:
        token, back = (far, window) if rng.random() < 0.5 and len(expected) > window else (near, 32)
        tokens.append(token)
        start = len(expected) - back
        expected += bytes(expected[start + k % back] for k in range(264))
        more = rng.integers(0, 256, 7, np.uint8).tobytes()
        tokens.append(b"\x06" + more)
        expected += more
    out = np.zeros(len(expected), np.uint8)
    assert unpack_lzf(np.frombuffer(b"".join(tokens), np.uint8), out) == len(expected)
    assert out.tobytes() == bytes(expected)


def test_unknown_suffixes_missing_files_and_missing_packages_are_named(tmp_path, monkeypatch):
    with pytest.raises(OptionError, match=r"ends with \.ply, \.las"):
        open_scan(tmp_path / "scan.rar")
    with pytest.raises(MemoryFileError, match="no such file"):
        open_scan(tmp_path / "scan.laz")
    path = write_las(tmp_path / "scan.las", surface(10)[0], None)
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(OptionError, match=r"gvtools\[scan\]"):
        open_scan(path)


KINDS = {
    "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "i4": "int", "u4": "uint",
    "f4": "float", "f8": "double",
}  # fmt: skip
RED = ("red", "green", "blue")


def write_points(path, positions, colors, *, names=RED, text=False, change=lambda text: text):
    """A PLY or PCD of points with channels of any type."""
    kind = colors.dtype.str[1:]
    fields = [(axis, "f8") for axis in "xyz"] + [(name, kind) for name in names]
    table = np.zeros(len(positions), fields)
    for (name, _), values in zip(fields, [*positions.T, *colors.T], strict=True):
        table[name] = values
    count = len(table)
    if path.suffix == ".ply":
        head = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0"]
        head += [f"element vertex {count}"]
        head += [*(f"property {KINDS[kind]} {name}" for name, kind in fields), "end_header"]
    else:
        rows = zip(*((name, kind[1], kind[0].upper(), "1") for name, kind in fields), strict=True)
        keys = zip(("FIELDS", "SIZE", "TYPE", "COUNT"), rows, strict=True)
        head = ["VERSION 0.7", *(" ".join([key, *words]) for key, words in keys),
                f"WIDTH {count}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}",
                f"DATA {'ascii' if text else 'binary'}"]  # fmt: skip
    whole = "\n".join([*head, ""])
    lines = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist())
    path.write_bytes(change(whole + lines).encode() if text else whole.encode() + table.tobytes())
    return path


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize(
    ("kind", "factor", "names"),
    [
        ("i1", 1, RED),  # bytes above 127 are negative
        ("u2", 16, RED),
        ("u2", 257, ("r", "g", "b")),
        ("i2", 128, RED),  # their half is white
        ("i4", 257, RED),
        ("f4", 4095 / 255, RED),
        ("f4", 1, ("diffuse_red", "diffuse_green", "diffuse_blue")),
        ("f4", 1 / 255, ("R", "G", "B")),
        ("f8", 257, ("scalar_Red", "scalar_Green", "scalar_Blue")),
    ],
)
@pytest.mark.parametrize("outliers", [0, 4])
def test_colours_of_every_type_range_and_name(
    tmp_path, suffix, text, kind, factor, names, outliers
):
    positions, colors = surface(500)
    stored = (colors * np.float64(factor)).astype("u1" if kind == "i1" else kind).astype(kind)
    if kind not in ("u1", "i1", "i2"):
        stored[:outliers] = np.nan if outliers and kind[0] == "f" else 65535
        stored[outliers // 2 : outliers] = 65535
    path = write_points(tmp_path / f"scan{suffix}", positions, stored, names=names, text=text)
    scan = read_scan(path)
    np.testing.assert_allclose(scan.colors[outliers:].astype(int), colors[outliers:], atol=1)
    lost = outliers // 2 * (kind[0] == "f")
    assert scan.colors[:lost].all() and (f"{lost / 500:.2%} of the points" in scan.color_range) == (
        lost > 0
    )
    usual = kind in ("u1", "i1") or (kind, factor) in (("u2", 257), ("f4", 1 / 255))
    assert bool(scan.color_range) != (usual and not lost)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_colours_in_one_number_or_grey_and_fractions_that_were_cut(tmp_path, suffix):
    positions, colors = surface(500)
    packed = (colors.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(
        axis=1, dtype=np.uint32
    )
    for name, stored in (("RGB", packed.view(np.float32)), ("rgba", packed | 0xFF000000)):
        path = write_points(tmp_path / f"a{suffix}", positions, stored[:, None], names=(name,))
        assert np.array_equal(read_scan(path).colors, colors)
    for name in ("Intensity", "scalar_Reflectance", "gray"):
        grey = colors[:, :1].astype(np.float32)
        path = write_points(tmp_path / f"a{suffix}", positions, grey, names=(name,))
        assert read_scan(path).colored_by == "intensity"
    path = write_points(tmp_path / f"a{suffix}", positions, colors // 128, names=RED)
    scan = read_scan(path)
    assert np.array_equal(scan.colors, colors // 128 * 255) and "from 0 to 1" in scan.color_range
    white = np.minimum(colors * 1.3, 255)
    for hundredths in (white / 2.55, np.rint(white / 2.55).astype(np.int32)):
        path = write_points(tmp_path / f"a{suffix}", positions, hundredths, names=RED)
        np.testing.assert_allclose(read_scan(path).colors.astype(int), white, atol=2)
    path = write_points(tmp_path / f"a{suffix}", positions, colors / 127.5 - 1, names=RED)
    assert "are below 0: cut off" in read_scan(path).color_range


def test_gaussians_given_as_a_scan_are_their_opaque_centres(tmp_path):
    positions, colors = surface(300)
    names = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
             *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)))  # fmt: skip
    opacity = np.where(np.arange(300) < 100, -3.0, 3.0)
    values = np.column_stack(
        [positions, (colors / 255 - 0.5) / 0.28209479, opacity, np.ones((300, 7))]
    )
    path = tmp_path / "splats.ply"
    table = values.astype("<f4").view([(name, "<f4") for name in names])[:, 0]
    write_ply(path, table, comments=("origin 4e5 5e6 0",))
    scan = read_scan(path)
    np.testing.assert_allclose(scan.colors.astype(int), colors[100:], atol=1)
    placed = positions[100:] + np.array([4e5, 5e6, 0])
    np.testing.assert_allclose(scan.positions + scan.origin, placed, atol=1e-6)
    assert scan.dropped == {"transparent Gaussians": 100} and scan.colored_by == "colour"


def written(path, change=lambda text: text, *, places=None):
    """A PLY or PCD as text, of 300 coloured points; colours of the latter are whole floats."""
    positions, colors = surface(300)
    channels, names = colors, [*RED]
    if path.suffix == ".pcd":
        channels, names = (colors @ [[1 << 16], [1 << 8], [1]]).astype("i4"), ["rgb"]
    write_points(
        path, positions if places is None else places, channels, names=names, text=True,
        change=lambda text: change(text.replace("F F F I", "F F F F")),
    )  # fmt: skip
    return path, positions, colors


@pytest.mark.parametrize(
    ("head", "divisor"), [("", 1), ("//X Y Z R G B\n", 1), ("# made by hand\n", 255)]
)
def test_points_as_text_with_colours(tmp_path, head, divisor):
    positions, colors = surface(300)
    path = tmp_path / "points.xyz"
    with path.open("w") as file:
        file.write(head)
        np.savetxt(file, np.hstack([positions + FAR, colors / divisor]))
    same(path, positions + FAR, colors)


@pytest.mark.parametrize("columns", [3, 6])
def test_points_as_text_without_colours(tmp_path, columns):
    """Normals are not taken for colours, even where none of them points backwards."""
    positions, colors = surface(300)
    normals = (colors + 1) / np.linalg.norm(colors + 1.0, axis=1, keepdims=True)
    path = tmp_path / "points.txt"
    np.savetxt(path, np.hstack([positions, normals])[:, :columns], fmt="%.5f")
    assert same(path, positions, None, atol=1e-5).colored_by == "nothing"
    path.write_text("1 2 3 4 5\n")
    with pytest.raises(MemoryFileError, match="5 numbers a line; expected x y z"):
        read_scan(path)


def test_glb_of_points_in_a_scene_of_other_things(tmp_path):
    """Points before meshes, else coloured vertices; light is linear, but bytes are sRGB."""
    trimesh = pytest.importorskip("trimesh")
    rng = np.random.default_rng(0)
    points, colors = rng.random((50, 3)), rng.integers(0, 256, (50, 4), dtype=np.uint8)
    scene = trimesh.Scene(trimesh.creation.box())
    moved = np.diag([2.0, 2.0, 2.0, 1.0])
    moved[:3, 3] = 1, 2, 3
    scene.add_geometry(trimesh.PointCloud(points, colors), transform=moved)
    scene.export(tmp_path / "points.glb")
    scan = read_scan(tmp_path / "points.glb")
    np.testing.assert_allclose(scan.positions + scan.origin, 2 * points + [1, 2, 3], atol=1e-5)
    np.testing.assert_array_equal(scan.colors, colors[:, :3])
    mesh = trimesh.Trimesh(points, [[0, 1, 2]], vertex_colors=colors, process=False)
    for name, data in trimesh.exchange.gltf.export_gltf(mesh.scene()).items():
        (tmp_path / name).write_bytes(data)
    assert len(read_scan(tmp_path / "model.gltf")) >= 3
    mesh.export(tmp_path / "mesh.glb")
    assert len(read_scan(tmp_path / "mesh.glb")) >= 3
    linear = np.full((1, 3), 0.2159, np.float32)
    arrays = {"POSITION": np.zeros((1, 3), np.float32), "COLOR_0": linear}
    (tmp_path / "one.glb").write_bytes(pack_glb(arrays, node={}, primitive={"mode": 0}))
    assert read_scan(tmp_path / "one.glb").colors.tolist() == [[128] * 3]
    trimesh.creation.box().export(tmp_path / "bare.glb")
    with pytest.raises(MemoryFileError, match="no points in it"):
        read_scan(tmp_path / "bare.glb")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("a.ply", lambda text: "\ufeff" + text),
        (
            "a.ply",
            lambda text: text.replace("end_header", "end_header  ").replace(
                "ascii 1.0", "ascii 1.0 "
            ),
        ),
        ("a.ply", lambda text: text.replace(" x", " X").replace(" y", " Y").replace(" z", " Z")),
        ("a.ply", lambda text: text.replace("header\n", "header\n\n") + "\n \n"),
        ("a.pcd", lambda text: text),
        ("a.pcd", lambda text: text.replace("F F F F", "f f f f").replace("ascii", "ASCII")),
        ("a.pcd", lambda text: text.replace("FIELDS", "COLUMNS").replace("POINTS 300\n", "")),
    ],
)
def test_text_as_other_programs_write_it(tmp_path, name, change):
    same(*written(tmp_path / name, change))


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("a.ply", lambda text: text.replace("x 300", "x 200"), "more lines than the 200 points"),
        ("a.pcd", lambda text: text.replace(" 300", " 200"), "more lines than the 200 points"),
        ("a.ply", lambda text: text.replace("ascii", "binary_little_endian"), "points as text"),
        ("a.ply", lambda text: text.replace("0.", "0,"), "with decimal points"),
        (
            "a.ply",
            lambda text: text.replace(" x", " packed_position"),
            "expected a whole compressed.ply",
        ),
    ],
)
def test_headers_that_contradict_the_points(tmp_path, name, change, said):
    with pytest.raises(MemoryFileError, match=said):
        read_scan(written(tmp_path / name, change)[0])


@pytest.mark.parametrize("nowhere", [0, -9999])
def test_rays_without_return_are_left_out(tmp_path, nowhere):
    row = np.arange(300.0)
    places = np.column_stack([row + 1, row % 7, row % 5])
    places[row % 3 > 0] = nowhere
    scan = read_scan(written(tmp_path / "a.ply", places=places)[0])
    assert len(scan) == 100
    assert scan.dropped == {"at one place (no return)": 200}


def test_coordinates_that_were_rounded_are_named(tmp_path):
    points = np.random.default_rng(0).uniform(0, 1, (300, 3))
    single = (points + np.array([5e5, 5.4e6, 100])).astype(np.float32).astype(np.float64)
    for k, (rows, said) in enumerate(
        [(single, "single precision, in steps of 0.5"), (points.round(), "only 8 places")]
    ):
        path = written(tmp_path / f"{k}.ply", places=rows)[0]
        (note,) = read_scan(path).notes
        assert said in note
        assert not read_scan(written(tmp_path / "fine.ply")[0]).notes
    with pytest.raises(MemoryFileError, match="all of its 300 points lie at"):
        read_scan(written(tmp_path / "one.ply", places=np.tile([1.0, 2, 3], (300, 1)))[0])


def test_a_viewpoint_that_is_not_applied_is_named(tmp_path):
    path, *_ = written(tmp_path / "a.pcd", lambda text: text.replace("NT 0 0 0 1", "NT 1 2 3 1"))
    assert "VIEWPOINT 1 2 3 1 0 0 0 is not applied" in read_scan(path).notes[0]


def test_a_las_whose_header_was_not_completed(tmp_path):
    laspy = pytest.importorskip("laspy")
    las = laspy.create(point_format=2, file_version="1.2")
    las.x, las.y, las.z = surface(300)[0].T
    las.write(str(tmp_path / "a.las"))
    path = patched(tmp_path / "a.las", 107, (100).to_bytes(4, "little"))
    with pytest.raises(MemoryFileError, match="room for 300"):
        read_scan(path)
