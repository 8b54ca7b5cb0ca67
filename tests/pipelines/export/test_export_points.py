from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from box_project import fused
from command_line import run_command
from export_runs import Y_UP, export_run
from plyfile import PlyData
from scan_files import write_las
from scipy.spatial.transform import Rotation

from gvtools.errors import OptionError
from gvtools.glb import join_glb, split_glb
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.thinning import thin
from gvtools.scans.read import read_scan
from gvtools.splat_files import read_splats
from pipelines.export import points

ORIGIN = (431_000.0, 5_650_000.0, 120.0)


@pytest.fixture
def far(scene, tmp_path):
    """A memory in a georeferenced frame, and where its points are."""
    memory = fused(scene, [0])
    positions = memory.positions[thin(memory, None).rows] + ORIGIN
    memory.frame = memory.views.frame = LocalFrame.at(ORIGIN)
    memory.save(tmp_path / "far.npz")
    return tmp_path / "far.npz", positions


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_laspy_reads_points_colours_and_what_is_known_of_each(bare_run, tmp_path, suffix):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    out = tmp_path / f"out{suffix}"
    export_run(bare_run.folder, "las", out)
    cloud = laspy.read(out)
    memory, rows = bare_run.memory, thin(bare_run.memory, None).rows
    assert cloud.header.version == "1.4" and cloud.header.are_points_compressed == (
        suffix == ".laz"
    )
    assert len(cloud.points) == len(rows) == memory.voxels
    step = float(cloud.header.scales[0])
    assert memory.voxel / 100 < step <= memory.voxel / 10
    np.testing.assert_allclose(cloud.xyz, memory.positions[rows], atol=0.51 * step)
    colors = np.stack([cloud.red, cloud.green, cloud.blue], axis=1)
    np.testing.assert_array_equal(colors >> 8, memory.columns.colors[rows])
    assert ((colors & 255) == colors >> 8).all()
    for name in ("confidence", "spacing", "round", "generated"):
        np.testing.assert_array_equal(cloud[name], getattr(memory.columns, name)[rows])
    np.testing.assert_array_equal(np.asarray(cloud.synthetic), memory.generated[rows])
    assert memory.generated[rows].any()


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_pxr_reads_the_points(bare_run, tmp_path, suffix):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    out = tmp_path / f"out{suffix}"
    export_run(bare_run.folder, "usd", out, "--up", 0, 0, 1)
    assert sorted(tmp_path.iterdir()) == [out]
    stage = Usd.Stage.Open(str(out))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and stage.HasAuthoredMetadata("upAxis")
    (cloud,) = (UsdGeom.Points(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Points))
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(cloud.GetPrim()))
    local = np.array(cloud.GetPointsAttr().Get(), np.float64)
    memory, rows = bare_run.memory, thin(bare_run.memory, None).rows
    np.testing.assert_allclose(
        local @ world[:3, :3] + world[3, :3], memory.positions[rows], atol=1e-5
    )
    widths = np.array(cloud.GetWidthsAttr().Get())
    assert len(widths) == len(rows) and (widths >= memory.voxel * 0.999).all()
    light = np.array(cloud.GetDisplayColorAttr().Get(), np.float64)
    back = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(back * 255, memory.columns.colors[rows], atol=0.01)
    generated = UsdGeom.PrimvarsAPI(cloud).GetPrimvar("generated").Get()
    np.testing.assert_array_equal(np.array(generated), memory.generated[rows])


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
@pytest.mark.parametrize("form", ["usd", "splat"])
def test_usd_passes_every_validator(bare_run, tmp_path, form, suffix):
    validation = pytest.importorskip("pxr.UsdValidation")
    from pxr import Usd

    out = tmp_path / f"out{suffix}"
    export_run(bare_run.folder, form, out)
    every = validation.ValidationRegistry().GetOrLoadAllValidators()
    told = validation.ValidationContext(every).Validate(Usd.Stage.Open(str(out)))
    assert len(every) > 10
    assert [each.GetMessage() for each in told] == []


def far_las(path):
    cloud = pytest.importorskip("laspy").read(path)
    assert cloud.header.scales[0] <= 0.003 and cloud.header.global_encoding.wkt
    return cloud.xyz


def far_usd(path):
    """The parent's translation is double, what it moves is near 0."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    cloud = UsdGeom.Points(stage.GetPrimAtPath("/gvtools/memory"))
    local = np.array(cloud.GetPointsAttr().Get(), np.float64)
    assert np.abs(local).max() < 5
    return local + np.array(UsdGeom.XformCache().GetLocalToWorldTransform(cloud.GetPrim()))[3, :3]


def far_glb(path):
    """Likewise the node's translation, which its extras repeat."""
    loaded = pytest.importorskip("trimesh").load_scene(path)
    matrix, name = loaded.graph[loaded.graph.nodes_geometry[0]]
    local = np.asarray(loaded.geometry[name].vertices)
    assert np.abs(local).max() < 5
    data = path.read_bytes()
    header = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (node,) = (node for node in header["nodes"] if "mesh" in node)
    assert node["extras"]["origin"] == node["translation"] == matrix[:3, 3].tolist()
    return local @ matrix[:3, :3].T + matrix[:3, 3]


def far_splat(path):
    """Positions count from a point that the header names."""
    data = PlyData.read(path)
    (line,) = (line for line in data["vertex"].comments if line.startswith("origin"))
    xyz = np.stack([np.asarray(data["vertex"][axis], float) for axis in "xyz"], axis=1)
    return xyz + np.array(line.split()[1:], float)


def recorded(path, name):
    """What a recording holds of a name, chunk by chunk."""
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    batches = [chunk.to_record_batch() for chunk in RrdReader(path).store().stream()]
    return [batch.column(name)[0].as_py() for batch in batches if name in batch.schema.names]


def far_rrd(path):
    """Positions count from the memory's origin."""
    return np.concatenate(recorded(path, "Points3D:positions")) + ORIGIN


@pytest.mark.parametrize(
    ("name", "read", "off"),
    [("out.las", far_las, 2e-3), ("out.usdc", far_usd, 1e-5), ("out.glb", far_glb, 1e-5),
     ("out.ply", far_splat, 1e-5), ("out.rrd", far_rrd, 1e-5)],
)  # fmt: skip
def test_positions_far_from_the_origin_keep_their_digits(far, tmp_path, name, read, off):
    memory, positions = far
    forms = {".usdc": "usd", ".ply": "splat"}
    out = tmp_path / name
    export_run(memory, forms.get(out.suffix, out.suffix[1:]), out, *Y_UP)
    found = np.asarray(read(out))
    assert found.shape == positions.shape
    np.testing.assert_allclose(found, positions, atol=off)


@pytest.mark.parametrize("form", ["ply", "las", "glb"])
def test_observed_leaves_out_what_was_generated(bare_run, tmp_path, form):
    trimesh = pytest.importorskip("trimesh")
    out = tmp_path / f"out.{form}"
    export_run(bare_run.folder, form, out, "--observed")
    memory = bare_run.memory
    expected = len(thin(memory, None, among=~memory.generated).rows)
    if form == "las":
        cloud = pytest.importorskip("laspy").read(out)
        assert not np.asarray(cloud.generated).any()
        assert len(cloud.points) == expected
    else:
        whole = int((~memory.generated).sum())
        (cloud,) = trimesh.load_scene(out).dump()
        assert len(cloud.vertices) == (whole if form == "ply" else expected)


def test_nothing_observed_is_said(scene, tmp_path):
    fused(scene, [0], generated=(0,)).save(tmp_path / "memory.npz")
    for form, name in (("splat", "out.ply"), ("ply", "cloud.ply")):
        with pytest.raises(OptionError, match="observed"):
            export_run(tmp_path / "memory.npz", form, tmp_path / name, "--observed")
        assert not (tmp_path / name).exists()


def told_in(path):
    """The line of a text, or of a header, that begins with "up"."""
    lines = path.read_bytes()[:4096].decode("latin1").splitlines()
    (words,) = (line.split() for line in lines if {"up"} & {*line.split()[:2]})
    return [float(word) for word in words[-3:]]


def told_in_las(path):
    records = pytest.importorskip("laspy").read(path).header.vlrs
    (record,) = (each for each in records if each.user_id == "gvtools")
    return [float(word) for word in record.record_data.split()[1:]]


def told_in_usd(path):
    usd = pytest.importorskip("pxr.Usd")
    stage = usd.Stage.Open(str(path))
    assert stage.GetMetadata("upAxis") == "Y"
    return [*stage.GetRootLayer().customLayerData["up"]]


def told_in_rrd(path):
    """The axis that is nearest, as rerun codes it."""
    (codes,) = recorded(path, "ViewCoordinates:xyz")
    return [{1: 1, 2: -1}.get(code, 0) for code in codes[0]]


@pytest.mark.parametrize(
    ("form", "name", "told"),
    [("ply", "a.ply", told_in), ("splat", "a.ply", told_in), ("mesh", "a.ply", told_in),
     ("mesh", "a.obj", told_in), ("las", "a.las", told_in_las), ("usd", "a.usdc", told_in_usd),
     ("rrd", "a.rrd", told_in_rrd),
     *((form, name, None) for form, name in
       [("glb", "a.glb"), ("mesh", "a.glb"), ("splat", "a.glb"), ("transforms", "a.json")])],
)  # fmt: skip
def test_every_format_tells_what_is_up(bare_run, tmp_path, capsys, form, name, told):
    out = tmp_path / name
    run_command("export", bare_run.folder, "--format", form, "--out", out, "--up", 0, -2, 0)
    assert "; up is 0 -1 0\n" in capsys.readouterr().out
    if told is None:
        data = out.read_bytes()
        tree = json.loads(data if form == "transforms" else data[20:].partition(b"BIN\0")[0][:-4])
        found = tree["up"] if form == "transforms" else tree["nodes"][0]["extras"]["up"]
    else:
        found = told(out)
    assert found == [0, -1, 0]


def upright_glb(path):
    """Matrix from the node's frame, in which the input's axes are, to the scene's."""
    loaded = pytest.importorskip("trimesh").load_scene(path)
    return loaded.graph[loaded.graph.nodes_geometry[0]][0]


def upright_usd(path):
    """Likewise, of the prim."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    (prim,) = (prim for prim in stage.Traverse() if prim.GetName() not in {"gvtools"})
    return np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T


UP = np.array([2.0, -6, 3]) / 7


@pytest.mark.parametrize(
    ("form", "name", "read"),
    [("glb", "a.glb", upright_glb), ("mesh", "a.glb", upright_glb), ("splat", "a.glb", upright_glb),
     ("usd", "a.usdc", upright_usd), ("splat", "a.usdc", upright_usd)],
)  # fmt: skip
def test_gltf_and_usd_stand_upright_in_other_programs(bare_run, tmp_path, form, name, read):
    run_command("export", bare_run.folder, "--format", form, "--out", tmp_path / name, "--up", *UP)
    np.testing.assert_allclose(read(tmp_path / name)[:3, :3] @ UP, [0, 1, 0], atol=1e-6)


def twice(nodes, meshes, scene):
    meshes[0]["primitives"] *= 2


def beside_another(nodes, meshes, scene):
    nodes.append({"mesh": 0, "translation": [5, 0, 0], "rotation": nodes[1]["rotation"]})
    scene["nodes"].append(2)


def with_others_extras(nodes, meshes, scene):
    nodes[0]["extras"] = {"up": "y", "turn": 90}


@pytest.mark.parametrize(
    ("name", "change"),
    [("a.usdc", None), ("a.glb", None), ("a.glb", twice), ("a.glb", beside_another),
     ("a.glb", with_others_extras)],
)  # fmt: skip
def test_upright_splats_are_read_in_the_inputs_axes_also_saved_again(
    bare_run, tmp_path, name, change
):
    plain, turned = tmp_path / "a.ply", tmp_path / name
    for out in (plain, turned):
        run_command("export", bare_run.folder, "--format", "splat", "--out", out, "--up", *UP)
    expected = read_splats(plain)
    if change is not None:
        tree, body = split_glb(turned.read_bytes())
        change(tree["nodes"], tree["meshes"], tree["scenes"][0])
        turned.write_bytes(join_glb(tree, body))
    found = read_splats(turned)
    if change is None:
        np.testing.assert_allclose(found.quaternions, expected.quaternions, atol=1e-6)
    assert found.up is not None
    np.testing.assert_allclose(found.up, UP, atol=1e-9)
    there = expected.positions + expected.origin
    *more, here = (found.positions + found.origin).reshape(-1, *there.shape)
    np.testing.assert_allclose(here, there, atol=1e-5)
    for others in more:
        # What is 5 beside it on the screen is so in the input's axes; that node moves nothing else.
        turn = Rotation.from_quat(tree["nodes"][1]["rotation"])
        aside = turn.inv().apply([5, 0, 0]) - tree["nodes"][0]["translation"]
        off = aside if change is beside_another else np.zeros(3)
        np.testing.assert_allclose(others, there + off, atol=1e-5)


WKT = 'LOCAL_CS["site",UNIT["metre",1]]'
NAMED = "the scan's coordinate system"


@pytest.mark.parametrize(
    ("crs", "placement", "carried", "said"),
    [
        (WKT, np.eye(4), WKT, f"in {NAMED}"),
        (WKT, np.diag([2.0, 2, 2, 1]), None, f"not in {NAMED}"),
        ("EPSG:25832", np.eye(4), None, "EPSG:25832 is left out: WKT of it needs pyproj"),
        # Of a map, with a number of heights that newer lists have not; one that no list has.
        ("EPSG:25832+5103", np.eye(4), "map 25832", f"in {NAMED}"),
        ("EPSG:9999", np.eye(4), None, "pyproj knows no such number"),
        ("", np.eye(4), None, "coordinates in steps"),
    ],
)
def test_las_carries_the_coordinate_system_of_a_scan_that_lies_in_it(
    far, tmp_path, monkeypatch, capsys, crs, placement, carried, said
):
    laspy = pytest.importorskip("laspy")
    exceptions = SimpleNamespace(CRSError=type("CRSError", (RuntimeError,), {}))

    def lookup(code):
        if code != "EPSG:25832":
            raise exceptions.CRSError(code)
        return SimpleNamespace(to_wkt=lambda version: "map 25832")

    package = SimpleNamespace(CRS=SimpleNamespace(from_user_input=lookup))
    monkeypatch.setitem(sys.modules, "pyproj", None if crs == "EPSG:25832" else package)
    monkeypatch.setitem(sys.modules, "pyproj.exceptions", exceptions)
    write_las(tmp_path / "scan.las", np.eye(4, 3), None, crs=crs)
    placed = {"world_from_scan": placement.tolist()}
    scan = {"crs": read_scan(tmp_path / "scan.las").crs, "placement": placed}
    run = SimpleNamespace(rounds=({"scan": scan},))
    monkeypatch.setattr(points, "load_run", lambda path: run)
    out = tmp_path / "out.las"
    run_command("export", far[0], "--format", "las", "--out", out)
    assert said in capsys.readouterr().out
    found = [record.string for record in laspy.read(out).header.vlrs if hasattr(record, "string")]
    assert found == ([carried] if carried else [])
